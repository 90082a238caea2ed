"""Averages of a table at any points in its range: of NumPy where the numbers are known, of JAX
where it traces them.
"""

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import numpy as np

from jaxgran.model.checks import InputError, at_most, refused
from jaxgran.model.choices import HALF_INTERVAL
from jaxgran.reference.surface import coordinates
from jaxgran.reference.table import LENGTH, MEASURED, Table, theory_of

PLANE = ("restitution", "packing_fraction")

_SINGLE = 1e-7  # rounding of a number in single precision


class Estimate(NamedTuple):
    """Logarithms: of an average over the theory's prediction, of the prediction, and the half-width
    of the 95 % interval.
    """

    log_ratio: Any
    log_theory: Any
    log_half: Any

    def value_and_ci95(self, xp: Any) -> tuple[Any, Any]:
        """The average, and the half-width of its 95 % interval."""
        value = xp.exp(self.log_ratio + self.log_theory)
        return value, value * xp.sinh(self.log_half)


def estimates(
    table: Table, where: Any, xp: Any = np, names: Iterable[str] = MEASURED
) -> dict[str, Estimate]:
    """Averages by name at coordinates in the measured range; that of ``LENGTH`` is over one."""
    logs = table.series(where, xp)
    by_name = {}
    for name in names:
        log_ratio, stderr = table.surfaces[name](where, xp)
        half = HALF_INTERVAL * stderr
        if name in table.bounds:
            half = xp.hypot(half, xp.exp(table.bounds[name].mean(where, xp)))
        log_theory = 0.0 if name == LENGTH else logs[theory_of(name)]
        by_name[name] = Estimate(log_ratio, log_theory, half)
    return by_name


def over_range(
    table: Table, evaluate: Callable[[Any, Any], Any], restitution: Any, packing_fraction: Any
) -> Any:
    """A pytree of averages at restitutions and packing fractions, after both.

    Args:
      table: the table whose range is accepted.
      evaluate: the averages at coordinates in that range, and the module of arrays to calculate
        them with.
      restitution: α, a number or an array.
      packing_fraction: ν, a number or an array; the two broadcast.

    Returns:
      α, ν and the pytree. NaN where JAX traces a value that is outside the range.

    Raises:
      InputError: a value is outside the range, shapes do not broadcast, or JAX traces a value in
        single precision.
    """
    values, xp = (restitution, packing_fraction), module_of(restitution, packing_fraction)
    if xp is np:
        values = [
            _checked(name, value, *table.range(name))
            for name, value in zip(PLANE, values, strict=True)
        ]
    try:
        alpha, nu = xp.broadcast_arrays(*(xp.asarray(x, float) for x in values))
    except ValueError:
        shapes = " and ".join(f"{np.shape(x)}" for x in values)
        raise InputError(
            f"restitution and packing_fraction must have shapes that broadcast, not {shapes}."
        ) from None
    (first, last), (loosest, densest) = (table.range(name) for name in PLANE)
    inside = (first <= alpha) & (alpha <= last) & (loosest <= nu) & (nu <= densest)
    middle = (first + last) / 2, (loosest + densest) / 2
    where = coordinates(xp.where(inside, alpha, middle[0]), xp.where(inside, nu, middle[1]), xp)
    if xp is np:
        return alpha, nu, evaluate(where, np)
    import jax

    # one by one: ranks are promoted nowhere
    averages = jax.vmap(lambda point: evaluate(point, xp))(where.reshape(-1, 2))
    shaped = jax.tree.map(lambda x: xp.where(inside, x.reshape(alpha.shape), np.nan), averages)
    return alpha, nu, shaped


def module_of(*values: Any) -> Any:
    """The module of arrays: that of JAX if it traces a value, else NumPy."""
    if not any(type(value).__module__.startswith("jax") for value in values):
        return np  # without loading JAX
    import jax
    import jax.numpy as jnp
    from jax.core import Tracer

    if not any(isinstance(value, Tracer) for value in values):
        return np
    if not jax.config.jax_enable_x64:  # type: ignore[attr-defined]
        raise InputError(
            "the reference map needs double precision under jax.jit, jax.vmap and jax.grad: "
            'call jax.config.update("jax_enable_x64", True) first.'
        )
    return jnp


def _checked(name: str, value: Any, low: float, high: float) -> np.ndarray:
    """A value that is known, as an array of floats in the measured range."""
    try:
        numbers = np.asarray(value, float)
    except (TypeError, ValueError):
        numbers = np.array(np.nan)
    within = at_most(low, numbers, _SINGLE) & at_most(numbers, high, _SINGLE)
    if numbers.size == 0 or not np.all(within):
        wrong = numbers[~within].flat[0] if np.isfinite(numbers).any() else value
        raise refused(
            name, wrong, f"must be between {low:g} and {high:g}, the range of the reference map"
        )
    return np.clip(numbers, low, high)
