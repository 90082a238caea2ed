"""Text of an object: one line for ``repr``.

An array of many values is shown by its shape and its range, so a batch of a thousand replicas needs
no more space than one. A traced value is shown by its type.
"""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

_LONGEST_REPR = 100  # characters of a value that is not a number
_LEAST_SHOWN = 1e-6  # relative error; digits below it are not shown
_TWO_DIGITS = 3.55  # an error that begins with less has two digits
# Powers of ten of numbers without an exponent; the second where the error is smaller
_SMALLEST_PLAIN, _LARGEST_ROUNDED, _LARGEST_PLAIN = -4, 5, 9


def text_of(title: str, values: Mapping[str, Any], errors: Mapping[str, Any] | None = None) -> str:
    """One line: the title, then ``name=value`` of each value in brackets.

    A single number is shown with its error, if known. Many numbers are shown by shape and range.
    Any other value is shown by its ``repr``.
    """
    texts = (f"{name}={_text(value, (errors or {}).get(name))}" for name, value in values.items())
    return f"{title}({', '.join(texts)})"


def _text(value: Any, error: Any) -> str:
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


def counted(number: int, noun: str) -> str:
    """A number of things.

    Examples:
      >>> counted(1, "point"), counted(0, "batch")
      ('1 point', '0 batches')
    """
    ending = "" if number == 1 else "es" if noun.endswith("ch") else "s"
    return f"{number} {noun}{ending}"


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


def unit_text(unit: str) -> str:
    """A unit of the tables with its signs, such as ``mσ²/t²`` for ``m sigma^2 / t^2``; nothing for
    a pure number.
    """
    for word, sign in (
        ("shear rate", "γ̇"),
        ("m sigma", "mσ"),
        ("sigma", "σ"),
        ("^2", "²"),
        ("^3", "³"),
        (" / ", "/"),
    ):
        unit = unit.replace(word, sign)
    return "" if unit == "1" else unit


def _numbers(value: Any) -> np.ndarray | None:
    """The value as an array of numbers; None if it is not numeric, or traced."""
    if isinstance(value, (bool, str, bytes)) or value is None:
        return None
    try:
        array = np.asarray(value)
    except Exception:  # JAX raises for a traced value, NumPy for a value that is no array
        return None
    return array if array.dtype.kind in "iuf" else None


def rounded(value: Any) -> Any:
    """A single measured number to six digits; an array unchanged."""
    return float(f"{float(value):.6g}") if np.ndim(value) == 0 else value


def to_two_digits(value: float) -> str:
    """A number to two digits, without an exponent where it is short: 0.037, 5.6, 120."""
    return f"{float(f'{value:.2g}'):g}"


def are_numbers(*leaves: Any) -> bool:
    """Whether all leaves are numeric, and none is traced."""
    return all(_numbers(leaf) is not None for leaf in leaves)
