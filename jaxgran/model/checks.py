"""What a user gives is judged here: an InputError says in one sentence what is accepted."""

from reprlib import Repr
from typing import Any

import jax
import numpy as np
from jax.core import Tracer


class InputError(ValueError):
    """A mistake in what a user gave; the message is one sentence that says what is accepted."""


def known(value: Any) -> np.ndarray | None:
    """The value as an array, of numbers if it is a number or an array of them; None while it is traced."""
    if isinstance(value, Tracer):
        return None
    key = isinstance(value, jax.Array) and jax.dtypes.issubdtype(value.dtype, jax.dtypes.extended)
    number = isinstance(value, (bool, int, float, np.generic, np.ndarray, jax.Array)) and not key
    number = number and not isinstance(value, np.ma.MaskedArray)  # whose values need not mean anything
    return np.asarray(value if number else None)


def two_digits(value: float, up: bool) -> str:
    """A positive number as 1.2e-03, rounded to the side of a limit on which it is still accepted."""
    unit = 10.0 ** (np.floor(np.log10(value)) - 1)
    return f"{(np.ceil if up else np.floor)(value / unit) * unit:.1e}"


_BRIEF = Repr()
_BRIEF.maxother = _BRIEF.maxstring = 100


def shown(value: Any) -> str:
    """A value as one short line, for a sentence."""
    try:
        return " ".join(_BRIEF.repr(value).split())
    except ValueError:  # of a whole number with thousands of digits
        return f"this {type(value).__name__}"


def require(name: str, value, accepts, words: str) -> None:
    """Raise an InputError that says what is accepted, unless every known number of ``value`` is."""
    numbers = known(value)
    if numbers is None:
        return
    if numbers.dtype.kind not in "iuf" or numbers.size == 0 or not np.all(accepts(numbers)):
        raise InputError(f"{name} must be {words}, not {shown(value)}.")


def listed(values: Any) -> Any:
    """A list of numbers as the array it stands for; anything else, to be judged, as it is."""
    numbers = isinstance(values, (list, tuple)) and all(
        isinstance(x, (int, float, np.integer, np.floating)) and not isinstance(x, bool) and abs(x) < 1e300
        for x in values
    )
    return np.asarray(values, float) if numbers else values


def require_number(name: str, value, accepts, words: str) -> None:
    """The same for what must be a single number."""
    require(name, value, lambda x: (x.ndim == 0) & accepts(x), words)


def require_whole(name: str, value: Any, least: int, most: int, why: str) -> None:
    """Raise an InputError that says what is accepted, and why not more, unless the value is such a whole number."""
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < least:
        raise InputError(f"{name} must be a whole number of at least {least}, not {shown(value)}.")
    if value > most:
        raise InputError(f"{name} must be at most {most}, {why}, not {shown(value)}.")


def require_key(key: Any) -> None:
    """Raise an InputError unless this is one random key of JAX."""
    typed = isinstance(key, jax.Array) and jax.dtypes.issubdtype(key.dtype, jax.dtypes.prng_key) and key.ndim == 0
    raw = isinstance(key, (jax.Array, np.ndarray)) and key.dtype == np.uint32 and key.shape == (2,)
    if not typed and not raw:
        raise InputError(f"key must be a random key such as jax.random.key(0), not {shown(key)}.")
