"""What the commands print: tables and sentences for readers, JSON for programs.

An object of ``--json`` has, by name:

=======  ===========================================================================================
key      content
=======  ===========================================================================================
value    a number, a text, true or false, or nested lists of numbers; null for a number that is NaN
stderr   standard error in the form of the value; null where there is none
ci95     half-width of the 95 % interval with all errors; null where there is none
unit     in m, sigma and t, as in a map; "1" for a pure number, null for what is none
meaning  in words
=======  ===========================================================================================
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


def _console() -> Console:
    return Console(highlight=False, markup=False, emoji=False)


def print_text(text: str) -> None:
    """Print sentences in lines that fit the terminal."""
    _console().print(_letters(text))


def print_table(
    title: str, columns: Sequence[str], rows: Iterable[Sequence[str]], numbers: bool = True
) -> None:
    """Print a table that fits the terminal; a row of one string is a heading.

    All columns but the first are right-aligned, or left-aligned if ``numbers`` is False.
    """
    console = _console()
    table = Table(box=box.SIMPLE, header_style="")
    lines = [list(map(_letters, row)) for row in rows]
    longest_word = max((len(word) for line in lines for word in line[0].split()), default=0)
    for k, column in enumerate(columns):
        table.add_column(
            _letters(column),
            justify="right" if numbers and k else "left",
            overflow="fold",
            min_width=longest_word if k == 0 and console.width >= 80 else None,
        )
    for line in lines:
        if len(line) == 1:
            table.add_section()
        table.add_row(*line)
    print_text(title)
    console.print(table)


class Entry(NamedTuple):
    """A value with what is known of it."""

    value: Any
    meaning: str
    unit: str | None = "1"
    stderr: Any = None
    ci95: Any = None


def print_json(entries: Mapping[str, Entry]) -> None:
    """Print the entries on standard output."""
    keys = ("value", "stderr", "ci95", "unit", "meaning")
    plain = {
        name: {key: _plain(getattr(entry, key)) for key in keys} for name, entry in entries.items()
    }
    print(json.dumps(plain, indent=2, allow_nan=False))


def _plain(value: Any) -> Any:
    """Numbers as those of JSON, which has neither NaN nor infinity."""
    if value is None or isinstance(value, str):
        return value
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
