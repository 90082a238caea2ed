"""Text of an object: one line for ``repr``.

An array of many values is shown by its shape and its range, so a batch of a thousand replicas needs
no more space than one. A traced value is shown by its type.
"""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

_LONGEST_REPR = 100  # characters of a value that is not a number
_LEAST_SHOWN = 1e-6  # relative error; digits below it are not shown
_TWO_DIGITS = 3.55  # an error that begins with less has two digits
# Powers of ten of numbers without an exponent; the second where the error is smaller
_SMALLEST_PLAIN, _LARGEST_ROUNDED, _LARGEST_PLAIN = -4, 5, 9


class WithError(NamedTuple):
    """A value and its error, as ``text_of`` shows them; many values without their errors."""

    value: Any
    error: Any


def text_of(title: str, values: Mapping[str, Any]) -> str:
    """One line: the title, then ``name=value`` of each value in brackets.

    Many numbers are shown by shape and range. What is no number is shown by its ``repr``.
    """
    return f"{title}({', '.join(f'{name}={_text(value)}' for name, value in values.items())})"


def _text(value: Any) -> str:
    value, error = value if isinstance(value, WithError) else (value, None)
    numbers = _numbers(value)
    if numbers is None:
        words = " ".join(repr(value).split())
        return words if len(words) <= _LONGEST_REPR else f"{words[:_LONGEST_REPR]}…"
    if numbers.ndim == 0:
        return str(numbers[()]) if error is None else with_error(numbers.item(), float(error))
    shape = "×".join(map(str, numbers.shape))
    finite = numbers[np.isfinite(numbers)]
    if finite.size == 0:
        return f"<{shape} values>"
    low, high = finite.min().item(), finite.max().item()
    spread = f"{low:.4g}" if low == high else f"{low:.4g} to {high:.4g}"
    lost = f", {numbers.size - finite.size} not finite" if finite.size < numbers.size else ""
    return f"<{shape} values, {spread}{lost}>"


def _numbers(value: Any) -> np.ndarray | None:
    """The value as an array of numbers; None if it is not numeric, or traced."""
    if isinstance(value, (bool, str, bytes)) or value is None:
        return None
    try:
        array = np.asarray(value)
    except Exception:  # JAX raises for a traced value, NumPy for a value that is no array
        return None
    return array if array.dtype.kind in "iuf" else None


def with_error(value: float, error: float) -> str:
    """A value and its standard error as text, both to the digits that the error leaves.

    The error has two digits up to 3.5 in its first digit, and one above, as the Particle Data Group
    rounds.

    Examples:
      >>> with_error(58.724, 6.04), with_error(1.000123, 0.00019), with_error(-7.98e-7, 1e-6)
      ('59 ± 6', '1.00012 ± 0.00019', '(-0.8 ± 1.0)e-06')
    """
    if not (math.isfinite(value) and _LEAST_SHOWN * abs(value) < error < math.inf):
        return f"{value:.7g} ± {error:.2g}"
    digits, power = f"{error:.2e}".split("e")
    last = int(power) - (float(digits) < _TWO_DIGITS)  # power of ten of the last digit
    largest = math.floor(math.log10(max(abs(value), error)))
    plain = _SMALLEST_PLAIN <= largest <= min(max(last, _LARGEST_ROUNDED), _LARGEST_PLAIN)
    shared = 0 if plain or last <= 0 <= largest else largest  # power of ten behind the brackets
    value, error = (round(x, -last) / 10**shared for x in (value, error))
    places = max(0, shared - last)
    text = f"{value:.{places}f} ± {error:.{places}f}"
    return f"({text})e{shared:+03d}" if shared else text


def rounded(value: Any) -> Any:
    """A single measured number to six digits; an array unchanged."""
    return float(f"{float(value):.6g}") if np.ndim(value) == 0 else value


def to_two_digits(value: float) -> str:
    """A number to two digits, without an exponent where it is short: 0.037, 5.6, 120."""
    return f"{float(f'{value:.2g}'):g}"


def counted(number: int, noun: str) -> str:
    """A number of things.

    Examples:
      >>> counted(1, "point"), counted(0, "batch")
      ('1 point', '0 batches')
    """
    ending = "" if number == 1 else "es" if noun.endswith("ch") else "s"
    return f"{number} {noun}{ending}"
