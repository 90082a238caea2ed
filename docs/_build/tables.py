"""Docstrings as the site shows them: their tables between lines of ``====`` become tables of
Markdown.

A table has a line of ``=`` above and below, and one more below its head if it has one. The gaps of
that line are its columns. A row whose first column is empty goes on with the row before. Roles such
as ``:func:`` lose their name.
"""

import re
from typing import Any

import griffe

from jaxgran.maps.settings import table as parameters

_BORDER = re.compile(r"^ *=+( +=+)+ *$")
_ROLE = re.compile(r":(?:func|class|mod|meth|data):`~?([^`]+)`")


class Tables(griffe.Extension):
    """Rewrites every docstring that is loaded."""

    def on_instance(self, *, obj: griffe.Object, **kwargs: Any) -> None:
        if obj.docstring is not None:
            obj.docstring.value = in_markdown(
                obj.docstring.value.replace("{PARAMETERS}", parameters())
            )


def in_markdown(docstring: str) -> str:
    """The docstring with its tables and roles in Markdown."""
    done: list[str] = []
    lines = _ROLE.sub(r"`\1`", docstring).split("\n")
    while lines:
        line = lines.pop(0)
        if not _BORDER.match(line):
            done.append(line)
            continue
        borders = [k for k, other in enumerate(lines) if other.strip() == line.strip()]
        follows = len(borders) > 1 and not any(not row.strip() for row in lines[: borders[1]])
        end = borders[1] if follows else borders[0]
        head = lines[: borders[0]] if follows else []
        body = lines[borders[0] + 1 : end] if follows else lines[:end]
        done += ["", *table(line, head, body), ""]
        lines = lines[end + 1 :]
    return "\n".join(done)


def table(border: str, head: list[str], body: list[str]) -> list[str]:
    """A table of Markdown from the rows between borders."""
    edges = [found.start() for found in re.finditer("=+", border)]
    spans = list(zip(edges, [*edges[1:], None], strict=True))

    def cells(line: str) -> list[str]:
        return [line[start:stop].strip() for start, stop in spans]

    rows: list[list[str]] = []
    for line in filter(str.strip, body):
        row = cells(line)
        if rows and not row[0]:
            rows[-1] = [
                f"{above} {more}".strip() for above, more in zip(rows[-1], row, strict=True)
            ]
        else:
            rows.append(row)
    titles = (
        [" ".join(words).strip() for words in zip(*map(cells, head), strict=True)]
        if head
        else [""] * len(spans)
    )
    return [_row(titles), _row(["---"] * len(spans)), *map(_row, rows)]


def _row(cells: list[str]) -> str:
    return "| " + " | ".join(re.sub(r"(?<!\\)([|*])", r"\\\1", cell) for cell in cells) + " |"
