"""Checks of user input: an InputError says in one sentence what is accepted."""

from collections.abc import Callable
from contextlib import suppress
from decimal import Decimal
from fractions import Fraction
from reprlib import Repr
from typing import Any

import numpy as np


class InputError(ValueError):
    """Invalid input; the message is one sentence that says what is accepted.

    Names of parameters in the message are in backticks, unless the message begins with that of
    ``field``, so that the command line can replace them by its options.

    Attributes:
      field: the parameter at fault, or "".
      value: what was given for it.
      reason: what is wrong with it, such as "must be between 0 and 1", or "".
    """

    def __init__(self, message: str, *, field: str = "", value: Any = None, reason: str = ""):
        super().__init__(message)
        self.field, self.value, self.reason = field, value, reason

    def __reduce__(self):  # errors of other processes are pickled, whatever the value is
        return InputError, self.args, {"field": self.field, "reason": self.reason}


def refused(field: str, value: Any, reason: str) -> InputError:
    """The error of a parameter whose value is not accepted: "FIELD REASON, not VALUE."."""
    return InputError(
        f"{field} {reason}, not {short_repr(value)}.", field=field, value=value, reason=reason
    )


def concrete_or_none(value: Any) -> np.ndarray | None:
    """The value as an array; None while JAX traces it.

    Anything but a number or an array of numbers becomes ``array(None)``, which no check accepts.
    """
    if isinstance(value, (bool, int, float)):
        return np.asarray(value)
    import jax  # here, so that the command line checks its options without it

    if is_traced(value):
        return None
    known = isinstance(value, (np.generic, np.ndarray, jax.Array))
    if not known or isinstance(value, np.ma.MaskedArray):  # whose mask would be ignored
        return np.asarray(None)
    is_key = jax.dtypes.issubdtype(value.dtype, jax.dtypes.extended)
    array = np.asarray(None if is_key else value)
    is_small = array.dtype.kind == "V" and jax.numpy.issubdtype(array.dtype, np.floating)
    return array.astype(np.float32) if is_small else array  # such as bfloat16


def two_digits(value: float, up: bool) -> str:
    """A positive limit as 1.2e-03, rounded up or down so that the printed number is itself
    accepted.
    """
    unit = 10.0 ** (np.floor(np.log10(value)) - 1)
    return f"{(np.ceil if up else np.floor)(value / unit) * unit:.1e}"


_ROUNDING = 1e-5  # of a limit that is computed, stored in single precision or printed by ``:g``


def at_most(value: Any, limit: Any, rounding: float = _ROUNDING) -> Any:
    """Whether a value is at most a positive limit, but for the rounding of a message or of single
    precision.

    Examples:
      >>> 0.007 <= 0.7 / 100, at_most(0.007, 0.7 / 100), bool(at_most(np.float32(0.98), 0.98))
      (False, True, True)
    """
    return value <= limit * (1 + rounding)


_SHORT_REPR = Repr()
_SHORT_REPR.maxother = _SHORT_REPR.maxstring = 100
_FEW = 100  # numbers of an array that is quoted as a list


def short_repr(value: Any) -> str:
    """A value as one short line, for an error message."""
    try:
        few = isinstance(value, (np.ndarray, np.generic)) and value.size < _FEW
        return " ".join(_SHORT_REPR.repr(value.tolist() if few else value).split())
    except ValueError:  # Python refuses to print an integer of thousands of digits
        return f"this {type(value).__name__}"


def require(name: str, value: Any, accepts: Callable, accepted: str) -> None:
    """Raise an InputError unless all numbers of ``value`` are accepted; traced values pass.

    Args:
      name: the parameter.
      value: a number or an array of numbers.
      accepts: whether numbers are accepted, as a function of an array.
      accepted: the same in words, such as "between 0 and 1".
    """
    numbers = concrete_or_none(value)
    if numbers is None:
        return
    if numbers.dtype.kind == "O":
        reason = f"must be {accepted}, as a number or an array of numbers"
        given = f"{short_repr(value)} of type {type(value).__name__}"
        raise InputError(f"{name} {reason}, not {given}.", field=name, value=value, reason=reason)
    if numbers.dtype.kind not in "iuf" or numbers.size == 0 or not np.all(accepts(numbers)):
        raise refused(name, value, f"must be {accepted}")


def as_array(values: Any) -> Any:
    """A list or tuple of numbers, or of equally long ones, as an array of floats; a number or an
    array of another library as one of Python or NumPy, in the byte order of this machine, which
    compiled functions require; any other value, such as a masked array, unchanged.

    Examples:
      >>> as_array([[1, 0], (0, 1)]).tolist(), as_array(["a"])
      ([[1.0, 0.0], [0.0, 1.0]], ['a'])
    """
    if isinstance(values, np.ndarray):
        return values.astype(values.dtype.newbyteorder("="), copy=False)
    if isinstance(values, (Decimal, Fraction)):
        return float(values)
    listed = isinstance(values, (list, tuple))
    if listed and not _are_numbers(values):
        return values
    foreign = hasattr(values, "__array__") and not isinstance(values, np.generic)
    if listed or (foreign and type(values).__module__[:3] != "jax" and not is_traced(values)):
        with suppress(TypeError, ValueError):  # such as a Dataset, and lists of several lengths
            array = np.asarray(values)
            if array.dtype.kind in "iuf":
                return array.astype(float) if listed else array
    return values


def _are_numbers(values: Any) -> bool:
    """Whether this is a number, or nested lists hold nothing but numbers."""
    if isinstance(values, (list, tuple)):
        return all(map(_are_numbers, values))
    number = isinstance(values, (int, float, np.integer, np.floating))
    return number and not isinstance(values, bool)


def require_native(name: str, tree: Any) -> None:
    """Raise an InputError if an array is in another byte order than that of this machine."""
    import jax

    if not all(np.dtype(getattr(x, "dtype", float)).isnative for x in jax.tree.leaves(tree)):
        raise InputError(
            f"{name} must have the byte order of this machine: "
            f"jax.tree.map(lambda x: x.astype(float), {name}) gives it."
        )


def require_number(name: str, value: Any, accepts: Callable, accepted: str) -> None:
    """The check ``require`` for a single number."""
    require(name, value, lambda x: (x.ndim == 0) & accepts(x), accepted)


def require_whole(name: str, value: Any, least: int, most: int, because: str = "") -> None:
    """Raise an InputError unless the value is a whole number in [least, most]; ``because`` explains
    the upper limit.
    """
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < least:
        raise refused(name, value, f"must be a whole number of at least {least}")
    if value > most:
        raise refused(name, value, f"must be at most {most}{', ' if because else ''}{because}")


def require_flag(name: str, value: Any) -> None:
    """Raise an InputError unless the value is True or False."""
    if not isinstance(value, bool):
        raise refused(name, value, "must be True or False")


def require_function(name: str, value: Any) -> None:
    """Raise an InputError unless the value is a function or None."""
    if value is not None and not callable(value):
        raise refused(name, value, "must be a function or None")


def require_static_function(name: str, value: Any) -> None:
    """Raise an InputError unless the value is None or a function that JAX can take as static."""
    require_function(name, value)
    try:
        hash(value)
    except TypeError:
        raise refused(name, value, "must be hashable") from None


def is_traced(*values: Any) -> bool:
    """Whether JAX traces a part of these pytrees, whose numbers are then unknown in Python."""
    import jax
    from jax.core import Tracer

    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(values))


def require_untraced(name: str, instead: str, *values: Any) -> None:
    """Raise an InputError if JAX traces a value that is needed in Python; ``instead`` says what to
    do.
    """
    if is_traced(*values):
        raise InputError(
            f"{name} cannot be transformed by jax.jit, jax.vmap or jax.grad: {instead}."
        )


def require_key(key: Any) -> None:
    """Raise an InputError unless this is a single JAX random key."""
    if key_shape(key) != ():
        raise refused("key", key, "must be a random key such as jax.random.key(0)")


def key_shape(key: Any) -> tuple[int, ...] | None:
    """The shape of an array of JAX random keys, () for one; None for anything else."""
    import jax

    if isinstance(key, jax.Array) and jax.dtypes.issubdtype(key.dtype, jax.dtypes.prng_key):
        return key.shape
    known = isinstance(key, (jax.Array, np.ndarray)) and key.dtype == np.uint32
    return key.shape[:-1] if known and key.shape[-1:] == (2,) else None
