"""What the commands print: tables and sentences for readers, JSON for programs.

An object of ``--json`` has, by name:

=================  =================================================================================
key                content
=================  =================================================================================
value              a number, a text, true or false, or nested lists of numbers; null for a number
                   that is NaN
stderr             standard error in the form of the value; null where there is none
ci95               half-width of the 95 % interval with all errors; null where there is none
unit               in m, sigma and t, as in a map; "1" for a pure number, null for what is none
meaning            in words
effective_samples  number of independent samples, where it is known
ci95_by_source     parts of ci95 by the source of the error, where they are known
=================  =================================================================================
"""

import codecs
import json
import sys
from collections.abc import Iterable, Mapping, Sequence
from io import TextIOWrapper
from typing import Any, NamedTuple

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table

from jaxgran.maps.options import Option
from jaxgran.model.display import with_error

_BETWEEN = 3  # columns of the terminal between two columns of a table
JSON = Option("Print one JSON object instead of tables.", bool)
_IN_ASCII = str.maketrans(
    {
        "±": "+-",
        "σ": "sigma",
        "τ": "tau",
        "γ": "gamma",
        "\u0307": "-dot",
        "ν": "nu",
        "α": "alpha",
        "²": "^2",
    }
    | {"–": "-", "−": "-", "×": "x", "…": "...", "’": "'"}
)


def in_brackets(value: float, error: float) -> str:
    """A value with its standard error in units of the last digits.

    Examples:
      >>> in_brackets(1.2093, 0.0101), in_brackets(6.77, 0.23), in_brackets(58.7, 6.04)
      ('1.209(10)', '6.77(23)', '59(6)')
    """
    text = with_error(value, error)
    mean, _, half = text.partition(" ± ")
    digits = half if half[:1] not in ("0", "") else half.replace(".", "").lstrip("0")
    return text if "e" in text or not digits else f"{mean}({digits})"


def _console() -> Console:
    return Console(highlight=False, markup=False, emoji=False)


def print_text(text: str) -> None:
    """Print sentences in lines that fit the terminal."""
    _console().print(_letters(text))


def print_table(
    title: str, columns: Sequence[str], rows: Iterable[Sequence[str]], numbers: bool = True
) -> None:
    """Print a table that fits the terminal; a row of one string is a heading.

    All columns but the first are right-aligned, or left-aligned if ``numbers`` is False. A table of
    numbers that is too wide is printed in parts, so that none is broken.
    """
    console = _console()
    lines = [list(map(_letters, row)) for row in rows]
    heads = list(map(_letters, columns))
    print_text(title)
    for shown in _parts(heads, lines, console.width) if numbers else [range(1, len(heads))]:
        console.print(_table([0, *shown], heads, lines, numbers, console.width))


def _table(
    shown: Sequence[int],
    heads: Sequence[str],
    lines: Sequence[Sequence[str]],
    numbers: bool,
    width: int,
) -> Table:
    """The table of some of the columns."""
    table = Table(box=box.SIMPLE, header_style="")
    longest_word = max((len(word) for line in lines for word in line[0].split()), default=0)
    for k in shown:
        first_width = longest_word if width >= 80 else None
        number_width = _width(heads[k], lines, k) if numbers else None
        table.add_column(
            heads[k],
            justify="right" if numbers and k else "left",
            overflow="fold",
            min_width=number_width if k else first_width,
        )
    for line in lines:
        if len(line) == 1:
            table.add_section()
        table.add_row(*(line[k] for k in shown if k < len(line)))
    return table


def _parts(
    heads: Sequence[str], lines: Sequence[Sequence[str]], width: int
) -> Iterable[Sequence[int]]:
    """The columns of each part of a table, as many as fit into the width beside the first one."""

    widths = [_width(head, lines, k) + _BETWEEN for k, head in enumerate(heads)]
    widths[0] = max(widths[0], len(heads[0]) + _BETWEEN)
    part: list[int] = []
    for k in range(1, len(heads)):
        if part and widths[0] + sum(widths[j] for j in [*part, k]) + 1 > width:
            yield part
            part = []
        part.append(k)
    yield part


def _width(head: str, lines: Sequence[Sequence[str]], k: int) -> int:
    """The width of column ``k``, whose head may be broken between words."""
    words = max(map(len, head.split()), default=0)
    return max([words, *(len(line[k]) for line in lines if k < len(line))])


class Entry(NamedTuple):
    """A value with what is known of it."""

    value: Any
    meaning: str
    unit: str | None = "1"
    stderr: Any = None
    ci95: Any = None
    effective_samples: Any = None
    ci95_by_source: Any = None


class JsonObject:
    """Whether the object that ``--json`` asks for has been printed."""

    printed = False


def print_json(entries: Mapping[str, Entry]) -> None:
    """Print the entries on standard output."""
    always = ("value", "stderr", "ci95", "unit", "meaning")
    plain = {
        name: {
            key: _plain(value)
            for key in (*always, "effective_samples", "ci95_by_source")
            if (value := getattr(entry, key)) is not None or key in always
        }
        for name, entry in entries.items()
    }
    text = json.dumps(plain, indent=2, allow_nan=False)
    JsonObject.printed = True
    print(text)


def _plain(value: Any) -> Any:
    """Numbers as those of JSON, which has neither NaN nor infinity."""
    if value is None or isinstance(value, str):
        return value
    if isinstance(value, Mapping):
        return {name: _plain(x) for name, x in value.items()}
    if np.ndim(value):
        return [_plain(x) for x in value]
    number = np.asarray(value).item()
    return None if isinstance(number, float) and not np.isfinite(number) else number


def _letters(text: str) -> str:
    """The text in letters that the encoding of standard output has."""
    encoding = sys.stdout.encoding or "utf-8"
    return text.encode(encoding, "in_ascii").decode(encoding)


def use_plain_letters() -> None:
    """Replace letters that standard output and error cannot encode, instead of failing."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="in_ascii")


def _in_ascii(error: UnicodeError) -> tuple[str | bytes, int]:
    """Replacement of letters that cannot be encoded; undecodable bytes of a file name are kept."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    letters = error.object[error.start : error.end]
    if all("\udc80" <= letter <= "\udcff" for letter in letters):
        return letters.encode("ascii", "surrogateescape"), error.end
    return letters.translate(_IN_ASCII).encode("ascii", "replace"), error.end


codecs.register_error("in_ascii", _in_ascii)
