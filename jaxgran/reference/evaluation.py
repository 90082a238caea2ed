"""Estimates from a table at any points in its range: of NumPy where the numbers are known, of JAX
where it traces them.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from jaxgran.model.checks import InputError, at_most, is_traced, refused
from jaxgran.reference.surface import coordinates
from jaxgran.reference.table import Table

PLANE = ("restitution", "packing_fraction")

_SINGLE = 1e-7  # rounding of a number in single precision


class Estimate(NamedTuple):
    """A value and the half-width of its 95 % interval, numbers or arrays of one shape."""

    value: Any
    ci95: Any


def from_log(log: Any, half: Any, xp: Any) -> Estimate:
    """The estimate whose logarithm has an interval of this half-width."""
    value = xp.exp(log)
    return Estimate(value, value * xp.sinh(half))


def over_range(
    table: Table, evaluate: Callable[[Any, Any], Any], restitution: Any, packing_fraction: Any
) -> Any:
    """A pytree of estimates at restitutions and packing fractions, after both.

    Args:
      table: the table whose range is accepted.
      evaluate: the estimates at coordinates in that range, and the module of arrays to calculate
        them with.
      restitution: α, a number or an array.
      packing_fraction: ν, a number or an array; the two broadcast.

    Returns:
      α, ν and the pytree. NaN where JAX traces a value that is outside the range, and so are the
      derivatives there.

    Raises:
      InputError: a value is outside the range, shapes do not broadcast, or JAX traces a value in
        single precision.
    """
    values, xp = (restitution, packing_fraction), module_of(restitution, packing_fraction)
    ranges = [table.range(name) for name in PLANE]
    if xp is np:
        values = [
            _in_range(name, value, *span)
            for name, value, span in zip(PLANE, values, ranges, strict=True)
        ]
    try:
        alpha, nu = xp.broadcast_arrays(*(xp.asarray(x, float) for x in values))
    except ValueError:
        shapes = " and ".join(f"{np.shape(x)}" for x in values)
        raise InputError(
            f"restitution and packing_fraction must have shapes that broadcast, not {shapes}."
        ) from None
    if xp is np:
        return alpha, nu, evaluate(coordinates(alpha, nu), np)
    import jax

    (low, high), (loosest, densest) = ranges
    inside = (low <= alpha) & (alpha <= high) & (loosest <= nu) & (nu <= densest)
    # 0 × and the factor 1 or NaN: derivatives outside are NaN as well, in both modes
    where = coordinates(
        xp.where(inside, alpha, (low + high) / 2 + 0 * alpha),
        xp.where(inside, nu, (loosest + densest) / 2 + 0 * nu),
        xp,
    )
    # one by one: ranks are promoted nowhere
    estimates = jax.vmap(lambda point: evaluate(point, xp))(where.reshape(-1, 2))
    known = xp.where(inside, 1.0, np.nan)
    return alpha, nu, jax.tree.map(lambda x: known * x.reshape(alpha.shape), estimates)


def module_of(*values: Any) -> Any:
    """The module of arrays: that of JAX if it traces a value, else NumPy."""
    if not any(type(value).__module__.startswith("jax") for value in values):
        return np  # without loading JAX
    if not is_traced(*values):
        return np
    import jax

    if not jax.config.jax_enable_x64:  # type: ignore[attr-defined]
        raise InputError(
            "the reference map needs double precision under jax.jit, jax.vmap and jax.grad: "
            'call jax.config.update("jax_enable_x64", True) first.'
        )
    return jax.numpy


def _in_range(name: str, value: Any, low: float, high: float) -> np.ndarray:
    """A value that is known, as an array of floats in the measured range."""
    try:
        numbers = np.asarray(value, float)
    except (TypeError, ValueError):
        numbers = np.array(np.nan)
    if isinstance(value, np.ma.MaskedArray):  # whose mask would be ignored
        numbers = np.array(np.nan)
    within = at_most(low, numbers, _SINGLE) & at_most(numbers, high, _SINGLE)
    if numbers.size == 0 or not np.all(within):
        wrong = numbers[~within].flat[0] if np.isfinite(numbers).any() else value
        raise refused(
            name, wrong, f"must be between {low:g} and {high:g}, the range of the reference map"
        )
    return np.clip(numbers, low, high)
