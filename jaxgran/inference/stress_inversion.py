"""The restitution of grains from the stresses of their flow, by inverting a closure."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxgran.inference.closure import (
    Closure,
    broadcast,
    elementwise,
    log_laws,
    require_closure,
    require_fraction,
    with_dtype,
)
from jaxgran.model.checks import as_array, require
from jaxgran.theory.steady_shear import Scalar

_GRID = 33  # restitutions at which the laws are evaluated
_FINER = 16  # steps of the interpolation between two of them
_REFINEMENTS = 10  # Gauss–Newton steps from the best point of the grid


class RestitutionEstimate(NamedTuple):
    """A restitution inferred from stresses.

    ===========  ===============================================================================================
    field        meaning; each has the shape (*flows)
    ===========  ===============================================================================================
    restitution  α, within the range of the closure
    stderr       root mean square deviation from the estimate over the range of α, weighted by the likelihood
                 exp(−χ²/2); the usual standard error for one sharp minimum, valid also for flat or double minima
    chi_squared  of pressure and friction about the closure, with one degree of freedom inside the range
    determined   whether the standard error is below that of a uniform guess, the range over √12; if not, the
                 stresses hardly depend on the restitution, as in dense flow with α < 0.6
    ===========  ===============================================================================================
    """

    restitution: Float[Array, "*flows"]
    stderr: Float[Array, "*flows"]
    chi_squared: Float[Array, "*flows"]
    determined: Bool[Array, "*flows"]


def restitution_from_stresses(
    closure: Closure,
    packing_fraction: Scalar,
    pressure: Scalar,
    shear_stress: Scalar,
    pressure_stderr: Scalar = 0.0,
    shear_stress_stderr: Scalar = 0.0,
    correlation: Scalar = 0.0,
) -> RestitutionEstimate:
    """Estimate the restitution of a flow from its stresses alone.

    α minimises the squared differences of the logarithms of pressure and friction within the range of the closure,
    weighted by the inverse of the covariance of measurement plus closure. The best α of a grid is refined by
    Gauss–Newton steps.

    Args:
      closure: as :func:`fit_closure` returns it.
      packing_fraction: 0 < ν ≤ 0.83.
      pressure, shear_stress: total and positive, in units of m = σ = γ̇ = 1.
      pressure_stderr, shear_stress_stderr: standard errors, in the same units.
      correlation: of the two errors, −1 to 1; about 0.95 for averages of one run, whose quotient, the friction, is then
        far more precise.

    Returns:
      An estimate of the broadcast shape of all numbers.

    Raises:
      InputError: (a ValueError) a number is out of range.
    """
    require_closure(closure)
    packing_fraction, pressure, shear_stress = map(as_array, (packing_fraction, pressure, shear_stress))
    pressure_stderr, shear_stress_stderr, correlation = map(
        as_array, (pressure_stderr, shear_stress_stderr, correlation)
    )
    require_fraction(packing_fraction)
    for name, value in (("pressure", pressure), ("shear_stress", shear_stress)):
        require(name, value, lambda x: (x > 0) & np.isfinite(x), "positive numbers")
    for name, value in (("pressure_stderr", pressure_stderr), ("shear_stress_stderr", shear_stress_stderr)):
        require(name, value, lambda x: (x >= 0) & np.isfinite(x), "numbers of at least 0")
    require("correlation", correlation, lambda x: (x >= -1) & (x <= 1), "between -1 and 1")
    numbers = broadcast(
        packing_fraction=packing_fraction,
        pressure=pressure,
        shear_stress=shear_stress,
        pressure_stderr=pressure_stderr,
        shear_stress_stderr=shear_stress_stderr,
        correlation=correlation,
    )
    return _estimates(closure, *numbers)


@jax.jit
def _estimates(closure: Closure, *numbers: Array) -> RestitutionEstimate:
    return elementwise(partial(estimate_restitution, closure), *numbers)


def estimate_restitution(
    closure: Closure,
    nu: Array,
    pressure: Array,
    shear_stress: Array,
    pressure_stderr: Array,
    shear_stress_stderr: Array,
    correlation: Array,
) -> RestitutionEstimate:
    """The estimate for one flow; all numbers are scalars."""
    closure = with_dtype(closure, nu.dtype)
    error_p, error_t = pressure_stderr / pressure, shear_stress_stderr / shear_stress  # of ln P and ln τ
    common = correlation * error_p * error_t
    noise = jnp.stack(  # covariance of ln P and ln τ − ln P
        [error_p**2, common - error_p**2, common - error_p**2, error_p**2 + error_t**2 - 2 * common]
    ).reshape(2, 2)
    observed = jnp.log(jnp.stack([pressure, shear_stress / pressure]))

    def misfit(alpha):
        logs, variances = log_laws(closure, alpha, nu)
        return observed - logs[:2], noise + jnp.diag(variances[:2])

    def refined(_, carry):
        """One Gauss–Newton step; also χ² before the step, and the error of α from the curvature of χ²."""
        alpha = carry[0]
        (residual, covariance), (change, _) = jax.jvp(misfit, (alpha,), (jnp.ones_like(alpha),))
        weights = jnp.linalg.solve(covariance, jnp.stack([residual, -change], axis=1))
        curvature = jnp.maximum(-change @ weights[:, 1], jnp.finfo(alpha.dtype).tiny)
        moved = alpha - change @ weights[:, 0] / curvature
        moved = jnp.clip(moved, jnp.maximum(low, start - cell), jnp.minimum(high, start + cell))
        return moved, residual @ weights[:, 0], curvature**-0.5

    low, high = closure.restitution_range
    cell = (high - low) / (_GRID - 1)
    grid = low + cell * jnp.arange(_GRID, dtype=nu.dtype)
    residuals, covariances = jax.vmap(misfit)(grid)
    start = grid[jnp.argmin(jax.vmap(_weighted_square)(residuals, covariances))]
    alpha, chi_squared, sharp = jax.lax.fori_loop(0, _REFINEMENTS, refined, (start, start, start))

    fine = low + cell / _FINER * jnp.arange((_GRID - 1) * _FINER + 1, dtype=nu.dtype)
    between = jax.vmap(lambda y: jnp.interp(fine, grid, y), in_axes=-1, out_axes=-1)
    squares = jax.vmap(_weighted_square)(between(residuals), between(covariances.reshape(-1, 4)).reshape(-1, 2, 2))
    likelihood = jax.nn.softmax(-squares / 2)
    spread = jnp.sqrt(likelihood @ (fine - alpha) ** 2)
    stderr = jnp.where(sharp < 2 * cell / _FINER, jnp.maximum(sharp, spread), spread)
    return RestitutionEstimate(alpha, stderr, chi_squared, stderr < (high - low) / 12**0.5)


def _weighted_square(residual: Array, covariance: Array) -> Array:
    return residual @ jnp.linalg.solve(covariance, residual)
