"""How objects show themselves: one line for ``repr``, a small table in HTML for a notebook.

An object lists what it shows as rows, and both forms are made of the same rows. Many values are shown by their number
and their range, traced ones by their type: a batch of a thousand replicas takes no more room than one.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from html import escape
from typing import Any, NamedTuple

import numpy as np

from jaxgran.model.status import Status

_LONGEST = 100  # letters of a value that is no number
_CELL = "text-align: left; padding: 0.1em 0.8em"


class Row(NamedTuple):
    """What is shown of a property; "" is the unit of a number without dimension, None an error that is not known."""

    name: str
    value: Any
    unit: str = ""
    error: Any = None


def text_of(title: str, rows: Sequence[Row]) -> str:
    """One line: the title, and in brackets the rows as ``name=value``."""
    return f"{title}({', '.join(f'{row.name}={value_text(row.value, row.error)}' for row in rows)})"


def html_of(title: str, rows: Sequence[Row], note: str = "") -> str:
    """A table with a row for each property, and a note beneath it; whatever the values hold is escaped."""
    lines = [
        f'<tr><th style="{_CELL}">{escape(row.name.replace("_", " "))}</th>'
        f'<td style="{_CELL}">{escape(_plain_text(row))}</td>'
        f'<td style="{_CELL}">{escape(row.unit)}</td></tr>'
        for row in rows
    ]
    foot = f"<div>{escape(note)}</div>" if note else ""
    return f"<div><b>{escape(title)}</b><table>{''.join(lines)}</table>{foot}</div>"


def value_text(value: Any, error: Any = None) -> str:
    """A value in a few letters: a number, with its error if it is known; the range of many numbers; else its repr."""
    numbers = _numbers(value)
    if numbers is None:
        words = " ".join(repr(value).split())
        return words if len(words) <= _LONGEST else f"{words[:_LONGEST]}…"
    if numbers.ndim == 0:
        return str(numbers[()]) if error is None else f"{numbers.item():.4g} ± {float(error):.2g}"
    shape = "×".join(map(str, numbers.shape))
    finite = numbers[np.isfinite(numbers)]
    if finite.size == 0:
        return f"<{shape} values>"
    low, high = finite.min().item(), finite.max().item()
    spread = f"{low:.4g}" if low == high else f"{low:.4g} to {high:.4g}"
    lost = f", {numbers.size - finite.size} not finite" if finite.size < numbers.size else ""
    return f"<{shape} values, {spread}{lost}>"


def _plain_text(row: Row) -> str:
    return row.value if isinstance(row.value, str) else value_text(row.value, row.error)


def _numbers(value: Any) -> np.ndarray | None:
    """The value as an array if it is a number or an array of them; None where it is neither, or traced."""
    if isinstance(value, (bool, str, bytes)) or value is None:
        return None
    try:
        array = np.asarray(value)
    except Exception:  # what JAX raises of a traced value, and NumPy of what is no array
        return None
    return array if array.dtype.kind in "iuf" else None


def display_methods(title: str, rows: Callable[[Any], list[Row]]) -> tuple[Callable, Callable]:
    """The methods ``__repr__`` and ``_repr_html_`` of a class, from a function that lists the rows of an object."""
    return lambda self: text_of(title, rows(self)), lambda self: html_of(title, rows(self), _UNITS)


_UNITS = (
    "σ mean diameter, m mass of a grain of that diameter unless grains have their own, t unit of time (1/γ̇ at γ̇ = 1)"
)


def statuses(codes: np.ndarray) -> str:
    """The name of a status, or how many there are of each."""
    names = Counter(Status(int(code)).name for code in np.ravel(codes))
    return ", ".join(name if np.ndim(codes) == 0 else f"{name} ({count})" for name, count in names.most_common())


def rounded(value: Any) -> Any:
    """A number to six digits, as no more of a measured one is of interest; many numbers as they are."""
    return float(f"{float(value):.6g}") if np.ndim(value) == 0 else value


def arrays(*leaves: Any) -> list[np.ndarray]:
    """The leaves as arrays; none at all where one is traced or stands in the place of a number."""
    found = [_numbers(leaf) for leaf in leaves]
    known = [x for x in found if x is not None]
    return known if len(known) == len(found) else []
