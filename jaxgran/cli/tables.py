"""Tables on standard output: split into pages on a narrow terminal, and in ASCII where its encoding
needs it.
"""

import codecs
import os
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from io import TextIOWrapper
from textwrap import wrap

from rich import box
from rich.console import Console
from rich.table import Table as RichTable

_UNLIMITED = 10_000  # characters; width of a page that is not printed on a terminal
_NARROW_KEY = 22  # characters; width of the names of rows on a narrow terminal
_IN_ASCII = str.maketrans(
    {"±": "+-", "σ": "sigma", "γ": "gamma", "\u0307": "-dot", "ν": "nu", "α": "alpha", "²": "^2"}
    | {"–": "-", "−": "-", "×": "x", "…": "...", "’": "'"}
)


@dataclass
class Table:
    """A table of strings: title, column names and rows; a row of a single string is a group
    heading.

    The first column names a row and is repeated on every page. The others are right-aligned, or
    left-aligned if ``numbers`` is False.
    """

    title: str
    columns: Sequence[str]
    rows: list[list[str]] = field(default_factory=list)
    numbers: bool = True


def print_table(table: Table) -> None:
    """Print a table on standard output; columns that do not fit its width follow on further
    pages.
    """
    console = Console()
    if not console.is_terminal and "COLUMNS" not in os.environ:
        console = Console(width=_UNLIMITED)
    left = list(range(1, len(table.columns)))
    narrow = _width(_page(table, left)) > console.width
    while left:
        shown = len(left)
        while shown > 1 and _width(_page(table, left[:shown], narrow)) > console.width:
            shown -= 1
        console.print(_page(table, left[:shown], narrow))
        left = left[shown:]


def _width(page: RichTable) -> int:
    """The width of a page in full."""
    return Console(width=_UNLIMITED).measure(page).maximum


def _page(table: Table, columns: Iterable[int], narrow: bool = False) -> RichTable:
    """The names of the rows and some columns of a table; with ``narrow`` long names are wrapped."""
    page = RichTable(title=plain(table.title), box=box.SIMPLE, title_justify="left")
    places = [0, *columns]
    for k in places:
        widest = max((len(plain(row[k])) for row in table.rows if len(row) > 1), default=0)
        words = plain(table.columns[k]).split()
        head = "\n".join(wrap(" ".join(words), max(widest, *map(len, words))))
        page.add_column(head, no_wrap=True, justify="right" if table.numbers and k else "left")
    for row in table.rows:
        if len(row) == 1:
            page.add_section()
        cells = [plain(row[k]) for k in places if k < len(row)]
        cells[0] = "\n".join(wrap(cells[0], _NARROW_KEY if narrow else _UNLIMITED))
        page.add_row(*cells)
    return page


def plain(text: str) -> str:
    """The text in characters that the encoding of standard output has."""
    encoding = sys.stdout.encoding or "utf-8"
    return text.encode(encoding, "in_ascii").decode(encoding)


def use_plain_letters() -> None:
    """Replace characters that standard output and error cannot encode, instead of failing."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="in_ascii")


def _in_ascii(error: UnicodeError) -> tuple[str | bytes, int]:
    """Replacement of characters that cannot be encoded; undecodable bytes of a file name are
    kept.
    """
    if not isinstance(error, UnicodeEncodeError):
        raise error
    letters = error.object[error.start : error.end]
    if all("\udc80" <= letter <= "\udcff" for letter in letters):
        return letters.encode("ascii", "surrogateescape"), error.end
    return letters.translate(_IN_ASCII).encode("ascii", "replace"), error.end


codecs.register_error("in_ascii", _in_ascii)
