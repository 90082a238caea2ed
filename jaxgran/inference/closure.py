"""A closure beyond kinetic theory: fitted corrections to its stresses, and a law for the force ratio.

ε = 1 − α² is the relative energy loss of a collision, ν_J the packing fraction at jamming, and x = −ln(1 − ν/ν_J) the
crowding. The laws are

    ln(P/P_theory)      = (ε, ε⁶) ⊗ (ν, x, x²) · a
    ln(μ/μ_theory)      = (ε, ε⁶) ⊗ (ν, x, x²) · b,  μ = τ/P
    ln(force ratio − 1) = (1, 1 − α, ln(1 − α), x, (1 − α) x) · c

The theory is that of anisotropic Gaussian velocities. Both stress corrections vanish as ν → 0 and as α → 1. The excess
of the force ratio, F − 1, is positive, vanishes as α → 1, and diverges at jamming as a power of ν_J − ν. The powers of
ε were chosen by cross-validation: ε corrects all flows with α < 1, ε⁶ strongly dissipative ones. Friction is fitted
rather than the shear stress, since τ and P share noise that nearly cancels in τ/P.

The stress laws are linear in their coefficients and fitted by linear least squares. The law of the force ratio is not:
F has Gaussian errors, but ln(F − 1) does not. Its sum of squares is minimised by L-BFGS.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxgran.model.batches import equal_values
from jaxgran.model.checks import InputError, as_array, require, require_number, short_repr
from jaxgran.model.choices import MAX_PACKING_FRACTION
from jaxgran.theory.gaussian_moments import gaussian_moments
from jaxgran.theory.steady_shear import Scalar, outside

Numbers = Array | np.ndarray

LAWS = ("pressure", "macroscopic_friction", "force_ratio")
NEEDED = (*LAWS, *(f"{name}_stderr" for name in LAWS))
"""Variables of a map that a closure needs."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Law:
    """Fitted coefficients of one law, for the logarithm of what it predicts.

    ============  ==============  =====================================================================
    field         shape           meaning; all are dimensionless
    ============  ==============  =====================================================================
    coefficients  (terms,)        a, b or c of the formulas above
    deviations    (terms, terms)  square root D of their covariance D Dᵀ, for accuracy
    scatter       ()              standard deviation of the points about the law, beyond their errors
    ============  ==============  =====================================================================
    """

    coefficients: Float[Numbers, " terms"]
    deviations: Float[Numbers, "terms terms"]
    scatter: Float[Numbers, ""]

    __eq__ = equal_values

    @property
    def covariance(self) -> Float[Numbers, "terms terms"]:
        """Covariance of the coefficients."""
        return self.deviations @ self.deviations.T


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Closure:
    """Three fitted laws and the ranges in which they were fitted; a pytree, so it can be passed to ``jit``.

    ======================  =====  ====  =================================================================
    field                   shape  unit  meaning
    ======================  =====  ====  =================================================================
    pressure                Law    –     of P over that of theory, 6 terms
    macroscopic_friction    Law    –     of μ = τ/P over that of theory, 6 terms
    force_ratio             Law    –     of ⟨F⟩/⟨F_bc⟩, 5 terms
    restitution_range       (2,)   –     smallest and largest α of the fitted points
    packing_fraction_range  (2,)   –     smallest and largest ν of the fitted points
    jamming_fraction        ()     –     ν_J
    timestep                ()     1/γ̇   dt of the fitted map, on which the force ratio depends; NaN if
                                         unknown
    ======================  =====  ====  =================================================================
    """

    pressure: Law
    macroscopic_friction: Law
    force_ratio: Law
    restitution_range: Float[Numbers, " 2"]
    packing_fraction_range: Float[Numbers, " 2"]
    jamming_fraction: Float[Numbers, ""]
    timestep: Float[Numbers, ""]

    __eq__ = equal_values


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Prediction:
    """Prediction of a closure; each field has the shape (*flows) of α and ν.

    ==============  ====  ====================================================================================
    field           unit  meaning
    ==============  ====  ====================================================================================
    force_ratio     –     ⟨F⟩/⟨F_bc⟩
    pressure        mγ̇²   half the trace of the stress, contacts and kinetic
    shear_stress    mγ̇²   positive, contacts and kinetic
    …_stderr        as …  standard errors with respect to a noiseless measurement, from the covariance of the
                          coefficients and the scatter of the points about the law
    extrapolated    –     true outside the fitted restitutions or packing fractions; the errors are unreliable
    ==============  ====  ====================================================================================
    """

    force_ratio: Float[Array, "*flows"]
    pressure: Float[Array, "*flows"]
    shear_stress: Float[Array, "*flows"]
    force_ratio_stderr: Float[Array, "*flows"]
    pressure_stderr: Float[Array, "*flows"]
    shear_stress_stderr: Float[Array, "*flows"]
    extrapolated: Bool[Array, "*flows"]

    __eq__ = equal_values


def predict(closure: Closure, restitution: Scalar, packing_fraction: Scalar) -> Prediction:
    """Predict force ratio and stresses; supports ``jit``, ``vmap`` and differentiation.

    Args:
      closure: as :func:`fit_closure` returns it.
      restitution: 0 ≤ α < 1; as α → 1 the stresses are those of theory, which diverge.
      packing_fraction: 0 < ν ≤ 0.83, of a shape that broadcasts with that of α.

    Raises:
      InputError: (a ValueError) a number is out of range; traced numbers are not checked.
    """
    require_closure(closure)
    restitution, packing_fraction = as_array(restitution), as_array(packing_fraction)
    require("restitution", restitution, lambda x: (x >= 0) & (x < 1), "at least 0 and below 1")
    require_fraction(packing_fraction)
    return _predictions(closure, *broadcast(restitution=restitution, packing_fraction=packing_fraction))


@jax.jit
def _predictions(closure: Closure, alpha: Array, nu: Array) -> Prediction:
    return elementwise(partial(prediction, closure), alpha, nu)


def prediction(closure: Closure, alpha: Array, nu: Array) -> Prediction:
    """The prediction for one flow; α and ν are scalars."""
    closure = with_dtype(closure, alpha.dtype)
    logs, variances = log_laws(closure, alpha, nu)
    pressure, shear_stress, ratio = jnp.exp(jnp.stack([logs[0], logs[0] + logs[1], logs[2]]))
    errors = jnp.sqrt(jnp.stack([variances[0], variances[0] + variances[1], variances[2]]))
    return Prediction(
        force_ratio=ratio,
        pressure=pressure,
        shear_stress=shear_stress,
        force_ratio_stderr=ratio * errors[2],
        pressure_stderr=pressure * errors[0],
        shear_stress_stderr=shear_stress * errors[1],
        extrapolated=outside(alpha, closure.restitution_range) | outside(nu, closure.packing_fraction_range),
    )


def stress_terms(alpha: Numbers, nu: Numbers, jamming_fraction: Numbers) -> Array:
    """Terms of the corrections of pressure and friction, (..., 6)."""
    energy_loss, crowding = 1 - alpha**2, -jnp.log1p(-nu / jamming_fraction)
    density = jnp.stack([nu, crowding, crowding**2], axis=-1)
    return jnp.concatenate([energy_loss[..., None] * density, energy_loss[..., None] ** 6 * density], axis=-1)


def excess_terms(alpha: Numbers, nu: Numbers, jamming_fraction: Numbers) -> Array:
    """Terms of the logarithm of the excess, force ratio − 1, (..., 5)."""
    crowding = -jnp.log1p(-nu / jamming_fraction)
    inelasticity = 1 - alpha
    terms = [jnp.ones_like(inelasticity), inelasticity, jnp.log(inelasticity), crowding, inelasticity * crowding]
    return jnp.stack(terms, axis=-1)


def log_laws(closure: Closure, alpha: Array, nu: Array) -> tuple[Array, Array]:
    """Logarithms of pressure, friction and force ratio of one flow, and their variances, each (3,)."""
    theory = gaussian_moments(alpha, nu)
    base = jnp.log(jnp.stack([theory.pressure, theory.shear_stress / theory.pressure]))
    stress, excess = (terms(alpha, nu, closure.jamming_fraction) for terms in (stress_terms, excess_terms))
    log_excess = excess @ closure.force_ratio.coefficients
    corrections = jnp.stack([stress @ law.coefficients for law in (closure.pressure, closure.macroscopic_friction)])
    logs = jnp.concatenate([base + corrections, jax.nn.softplus(log_excess)[None]])
    gradients = stress, stress, jax.nn.sigmoid(log_excess) * excess
    laws = closure.pressure, closure.macroscopic_friction, closure.force_ratio
    variances = [
        jnp.sum((gradient @ law.deviations) ** 2) + law.scatter**2
        for gradient, law in zip(gradients, laws, strict=True)
    ]
    return logs, jnp.stack(variances)


def require_closure(closure: Closure) -> None:
    if not isinstance(closure, Closure):
        raise InputError(f"closure must be a Closure from fit_closure, not {short_repr(closure)}.")


def require_fraction(packing_fraction: Scalar) -> None:
    accepted = f"above 0 and at most {MAX_PACKING_FRACTION}"
    require("packing_fraction", packing_fraction, lambda x: (x > 0) & (x <= MAX_PACKING_FRACTION), accepted)


def require_jamming(jamming_fraction: float) -> None:
    accepted = f"a number above {MAX_PACKING_FRACTION} and at most 1"
    require_number("jamming_fraction", jamming_fraction, lambda x: (x > MAX_PACKING_FRACTION) & (x <= 1), accepted)


def broadcast(**numbers: Scalar | np.ndarray) -> list[Array]:
    """Numbers as arrays of a common floating-point type and shape."""
    shapes = {name: np.shape(x) for name, x in numbers.items()}
    try:
        shape = np.broadcast_shapes(*shapes.values())
    except ValueError:
        given = ", ".join(f"{name} {shape}" for name, shape in shapes.items())
        raise InputError(f"the numbers must have shapes that broadcast, not {given}.") from None
    dtype = jnp.result_type(float, *numbers.values())
    return [jnp.broadcast_to(jnp.asarray(x, dtype), shape) for x in numbers.values()]


def elementwise(function: Callable, *arrays: Array):
    """Apply a function of scalars to every entry of arrays of equal shape."""
    results = jax.vmap(function)(*(x.reshape(-1) for x in arrays))
    return jax.tree.map(lambda x: x.reshape(arrays[0].shape), results)


def with_dtype(closure: Closure, dtype: jnp.dtype) -> Closure:
    return jax.tree.map(lambda x: jnp.asarray(x, dtype), closure)
