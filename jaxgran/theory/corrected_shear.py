"""Kinetic theory with a measured correlation length and measured pairs at contact.

Enskog's theory takes the velocities of colliding grains to be independent and the pairs at contact
to be those of a fluid in equilibrium. In dissipative flow they approach more slowly, so less energy
is lost at the same stress, and in dense flow there are more pairs. Two laws of restitution and
packing fraction, fitted to a map, say by how much; the balance of the moments then gives
temperature and stresses. Units: ``steady_shear``.
"""

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxgran.theory.gaussian_moments import steady_moments
from jaxgran.theory.mixture import uniform_mixture
from jaxgran.theory.navier_stokes import garzo_dufty
from jaxgran.theory.steady_shear import Scalar, as_floats, of_one_flow

Numbers = Array | np.ndarray


class CorrelationLaws(NamedTuple):
    """Coefficients of the laws of the correlation length and of the pairs at contact, functions of
    α and y = 1/(1 − ν/ν_J).

    ================  =====  =======================================================================
    field             shape  meaning; all are dimensionless
    ================  =====  =======================================================================
    length            (3,)   a, b, k of L = 1 + a (1 − α)² y + b (1 − α) y^k, in mean diameters
    pairs             (3,)   c, e, m of R = (1 + c (1 − α)⁵) (1 + e (1 − α)^(1/3) y^m), pairs at
                             contact that carry the stress over those of equilibrium
    jamming_fraction  ()     ν_J
    ================  =====  =======================================================================
    """

    length: Float[Numbers, " 3"]
    pairs: Float[Numbers, " 3"]
    jamming_fraction: Float[Numbers, ""]


MEASURED_LAWS = CorrelationLaws(
    length=np.array([0.2245, 0.02589, 1.444]),
    pairs=np.array([0.3816, 0.01606, 1.609]),
    jamming_fraction=np.array(0.8386),
)
"""The laws of the benchmark ``dissipation``, fitted to 294 flows of N = 1600 to 16000, dt = 1e-4.
Their standard errors are in its result.
"""

SCATTER = np.array([0.1247, 0.1585, 0.149])
"""Rms errors of ln T, ln p and ln τ at 30 flows that were not fitted, N = 1600, dt = 3e-4."""

RESTITUTION_RANGE, PACKING_FRACTION_RANGE = (0.1, 0.95), (0.1, 0.82)
"""Where the scatter holds; nearly elastic dense flow is more viscous than in Enskog's theory."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class CorrectedShear:
    """Prediction of :func:`corrected_shear`; scalars, with a leading ``(replicas,)`` under
    ``vmap``.

    ====================  =======  =================================================================
    field                 unit     meaning
    ====================  =======  =================================================================
    granular_temperature  m(σ/t)²  T relative to the flow nearby, which a map holds as
                                   ``local_granular_temperature``; the energy of long waves is not
                                   in it
    pressure              m/t²     half the trace of the stress, kinetic and collisional
    shear_stress          m/t²     positive, kinetic and collisional
    dissipation_rate      m/t³     energy lost per unit area and time, Enskog's times R/L; equals
                                   shear_stress × shear_rate
    …_stderr              as …     the first three times the scatter of the laws: standard errors of
                                   a prediction
    correlation_length    σ        L
    pair_factor           –        R
    extrapolated          –        true outside the ranges of the laws, where the errors are
                                   unreliable
    ====================  =======  =================================================================
    """

    granular_temperature: Float[Array, "*replicas"]
    pressure: Float[Array, "*replicas"]
    shear_stress: Float[Array, "*replicas"]
    dissipation_rate: Float[Array, "*replicas"]
    granular_temperature_stderr: Float[Array, "*replicas"]
    pressure_stderr: Float[Array, "*replicas"]
    shear_stress_stderr: Float[Array, "*replicas"]
    correlation_length: Float[Array, "*replicas"]
    pair_factor: Float[Array, "*replicas"]
    extrapolated: Bool[Array, "*replicas"]


@of_one_flow
@partial(jax.jit, static_argnames="size_classes")
def corrected_shear(
    restitution: Scalar,
    packing_fraction: Scalar,
    shear_rate: Scalar = 1.0,
    polydispersity: Scalar = 0.26,
    size_classes: int = 4,
    laws: CorrelationLaws = MEASURED_LAWS,
) -> CorrectedShear:
    """Steady shear by the theory of ``gaussian_moments``, corrected by a correlation length and by
    pairs at contact.

    ================  ====  =======================================================
    name              unit  meaning
    ================  ====  =======================================================
    restitution       –     0 ≤ α < 1
    packing_fraction  –     0 < ν < ν_J
    shear_rate        1/t   γ̇ > 0
    polydispersity    σ     0 ≤ Δ < 1: diameters uniform in σ ± Δ
    size_classes      –     number of Gauss-Legendre points of the size
                            distribution; static, a change recompiles
    laws                    CorrelationLaws; with zeros for `length` and `pairs`
                            the theory is that of ``gaussian_moments``
    returns                 CorrectedShear; not finite at α = 1 and from ν_J on
    ================  ====  =======================================================

    Every contact value is multiplied by the pair factor R, and collisions lose 1/L of the energy of
    Enskog's theory: Γ = R Γ_E/L and p_c = R p_E at the same temperature tensor, where p_c is the
    collisional pressure. The balance of the moments is then solved as without them, so that τγ̇ =
    Γ. No coefficient is adjusted to T, p or τ.

    Source: a correlation length that divides the dissipation rate is that of extended kinetic
    theory, for instance of D. Vescovi, D. Berzi, P. Richard and N. Brodu, Phys. Fluids 26, 053305
    (2014). Both laws are fits of this project (``python -m benchmarks dissipation``).

    Examples:
      Grains lose less energy than in Enskog's theory, so the flow is hotter.

      >>> from jaxgran.theory.gaussian_moments import gaussian_moments
      >>> corrected, enskog = corrected_shear(0.5, 0.6), gaussian_moments(0.5, 0.6)
      >>> hotter = bool(corrected.granular_temperature > enskog.granular_temperature)
      >>> hotter, round(float(enskog.pressure), 2)
      (True, 1.2)
    """
    alpha, nu, rate, width = as_floats(restitution, packing_fraction, shear_rate, polydispersity)
    laws = jax.tree.map(lambda x: jnp.asarray(x, alpha.dtype), laws)
    length, pairs = correlation_length(laws, alpha, nu), pair_factor(laws, alpha, nu)
    mixture = uniform_mixture(nu, width, size_classes)
    mixture = mixture._replace(encounters=pairs * mixture.encounters)
    moments = steady_moments(
        alpha, rate, mixture, jnp.log(garzo_dufty(alpha, nu).granular_temperature), length
    )
    of_temperature, of_pressure, of_shear = SCATTER.tolist()
    return CorrectedShear(
        granular_temperature=moments.granular_temperature,
        pressure=moments.pressure,
        shear_stress=moments.shear_stress,
        dissipation_rate=moments.dissipation_rate,
        granular_temperature_stderr=moments.granular_temperature * of_temperature,
        pressure_stderr=moments.pressure * of_pressure,
        shear_stress_stderr=moments.shear_stress * of_shear,
        correlation_length=length,
        pair_factor=pairs,
        extrapolated=_outside(alpha, RESTITUTION_RANGE) | _outside(nu, PACKING_FRACTION_RANGE),
    )


def correlation_length(laws: CorrelationLaws, alpha: Numbers, nu: Numbers) -> Array:
    """L = 1 + a (1 − α)² y + b (1 − α) y^k with y = 1/(1 − ν/ν_J), in mean diameters."""
    crowding, loss = 1 / (1 - nu / laws.jamming_fraction), 1 - alpha
    return (
        1 + laws.length[0] * loss**2 * crowding + laws.length[1] * loss * crowding ** laws.length[2]
    )


def pair_factor(laws: CorrelationLaws, alpha: Numbers, nu: Numbers) -> Array:
    """R = (1 + c (1 − α)⁵) (1 + e (1 − α)^(1/3) y^m) with y = 1/(1 − ν/ν_J)."""
    crowding, loss = 1 / (1 - nu / laws.jamming_fraction), 1 - alpha
    return (1 + laws.pairs[0] * loss**5) * (
        1 + laws.pairs[1] * jnp.cbrt(loss) * crowding ** laws.pairs[2]
    )


def _outside(value: Array, span: tuple[float, float]) -> Bool[Array, "..."]:
    """Whether a number is outside the range (2,) of a law, beyond rounding."""
    slack = 8 * jnp.finfo(value.dtype).eps
    return (value < span[0] - slack) | (value > span[1] + slack)
