"""Enskog's collision integrals of Gaussian velocities, and the collisional stress and dissipation
rate at a given temperature tensor, for instance a measured one.

Units: ``steady_shear``.
"""

import math
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxgran.model.checks import InputError
from jaxgran.theory.mixture import Mixture, uniform_mixture
from jaxgran.theory.steady_shear import Scalar, as_floats, of_one_flow

# Contact directions on the half circle; the integrand is smooth and periodic: errors below 1e-11
_ANGLES = 32


class Collisions(NamedTuple):
    """What collisions do, per unit area and time unless said otherwise; tensors are symmetric."""

    stress: Float[Array, "*replicas 2 2"]  # Σ d n ⊗ n J over the collisions, the collisional stress
    speed_stress: Float[Array, "*replicas 2 2"]  # the same, each times its speed of approach w
    dissipation_rate: Float[Array, "*replicas"]  # Σ (1 − α²) m_ij w²/2 over the collisions
    collision_rate: Float[Array, "*replicas"]  # collisions per grain and time
    source: Float[Array, "*replicas 2 2 classes"]  # change of the temperature tensors per time


@of_one_flow
@partial(jax.jit, static_argnames="size_classes")
def collisional_transfer(
    temperature: Float[Array, "2 2"],
    restitution: Scalar,
    packing_fraction: Scalar,
    shear_rate: Scalar = 1.0,
    polydispersity: Scalar = 0.26,
    size_classes: int = 4,
) -> Collisions:
    """Collisional stress and dissipation rate of Enskog's theory for Gaussian velocities of a
    temperature tensor.

    ================  ========  =======================================================
    name              unit      meaning
    ================  ========  =======================================================
    temperature       m(σ/t)²   (2, 2), ⟨m c ⊗ c⟩, the same for all sizes of grains
    restitution       –         0 ≤ α ≤ 1
    packing_fraction  –         0 < ν < 1
    shear_rate        1/t       γ̇ ≥ 0
    polydispersity    σ         0 ≤ Δ < 1: diameters uniform in σ ± Δ
    size_classes      –         number of Gauss-Legendre points of the size
                                distribution; static, a change recompiles
    returns                     Collisions
    ================  ========  =======================================================

    See ``enskog_collisions`` for the integrals.

    Examples:
      Without shear the collisional pressure is (1 + α) ν χ times the kinetic one, n T.

      >>> still = collisional_transfer(jnp.eye(2), 0.8, 0.5, shear_rate=0.0, polydispersity=0.0)
      >>> round(float(still.stress[0, 0] / (4 / jnp.pi * 0.5)), 4), round(1.8 * 0.5 * 3.125, 4)
      (2.8125, 2.8125)
    """
    if jnp.shape(temperature) != (2, 2):
        raise InputError(f"temperature must be a tensor (2, 2), not {jnp.shape(temperature)}.")
    alpha, nu, rate, width = as_floats(restitution, packing_fraction, shear_rate, polydispersity)
    return enskog_collisions(temperature, alpha, rate, uniform_mixture(nu, width, size_classes))


def enskog_collisions(
    temperature: Float[Array, "2 2 *classes"],
    alpha: Float[Array, ""],
    rate: Float[Array, ""],
    mixture: Mixture,
    length: Float[Array, ""] | float = 1.0,
) -> Collisions:
    """Enskog's collision integrals of Gaussian velocities in a mixture of size classes.

    Let n be the normal from grain i to grain j. The approach speed w = (v_i − v_j)·n is Gaussian,
    with mean −γ̇ d_ij n_x n_y and variance n·(T_i/m_i + T_j/m_j)·n; averages ⟨ ⟩ are over w > 0. A
    collision transfers the impulse J = (1 + α) m_ij w and loses the energy (1 − α) J w/2, so the
    stress is ½ Σ_ij n_i n_j χ_ij d_ij² (1 + α) m_ij ∮ dn n ⊗ n ⟨w²⟩ and the dissipation rate
    ¼ Σ_ij n_i n_j χ_ij d_ij (1 − α²) m_ij ∮ dn ⟨w³⟩. It adds −J n/m_i to v_i, so the temperature
    tensor of class i changes at the rate Σ_j n_j χ_ij d_ij ∮ dn ⟨w [J² n n/m_i − J (n c_i + c_i
    n)]⟩, where ⟨w² c_i⟩ = 2⟨w⟩ T_i·n/m_i, because c_i and w are jointly Gaussian.

    Args:
      temperature: a tensor for each class, or one for all.
      alpha: restitution.
      rate: shear rate.
      mixture: the classes.
      length: collisions lose 1/length of the energy above. The rest is given back: to grain i the
        share m_ij/m_i, to both directions alike.

    Source: J. T. Jenkins and M. W. Richman, J. Fluid Mech. 192, 313 (1988).
    """
    masses, distances = mixture.masses, mixture.contact_diameters
    angle = (jnp.arange(_ANGLES, dtype=masses.dtype) + 0.5) * (jnp.pi / _ANGLES)
    arc = 2 * jnp.pi / _ANGLES  # both halves of the circle contribute equally
    # Sums, as accelerators round products of matrices more coarsely
    n = jnp.stack([jnp.cos(angle), jnp.sin(angle)])
    nn = n[:, None] * n[None, :]  # (2, 2, angles)
    tensors = jnp.broadcast_to(temperature.reshape(2, 2, -1), (2, 2, masses.size))
    along = jnp.sum(tensors[:, :, :, None] * n[None, :, None, :], axis=1)  # T·n
    spread = jnp.sum(along * n[:, None, :], axis=0) / masses[:, None]
    first, second, third = _half_range_moments(
        -rate * distances[:, :, None] * nn[0, 1][None, None, :],
        jnp.sqrt(spread[:, None, :] + spread[None, :, :]),
    )  # each (classes, classes, angles)

    impulse = (1 + alpha) * mixture.reduced_masses  # over the speed of approach
    loss = arc * jnp.sum((mixture.encounters * impulse)[:, :, None] * first, axis=1)
    gain = arc * jnp.sum((mixture.encounters * impulse**2)[:, :, None] * third, axis=1)
    drag = along[:, None] * n[None, :, None, :] + n[:, None, None, :] * along[None, :]
    returned = (1 - 1 / length) * (1 - alpha) / (1 + alpha) * jnp.sum(gain, axis=1) / 2
    source = (
        jnp.sum(gain[None, None] * nn[:, :, None, :] - 2 * loss[None, None] * drag, axis=-1)
        + jnp.eye(2, dtype=masses.dtype)[:, :, None] * returned[None, None, :]
    )
    # half: each pair is summed twice
    per_area = mixture.number_densities[:, None] * mixture.encounters * arc / 2
    transfer = (per_area * impulse * distances)[:, :, None]
    stress, speed_stress = (
        jnp.sum(nn * jnp.sum(transfer * moment, axis=(0, 1))[None, None], axis=-1)
        for moment in (second, third)
    )
    energy = jnp.sum((per_area * impulse)[:, :, None] * third)
    collisions = jnp.sum(per_area[:, :, None] * first)
    return Collisions(
        stress=stress,
        speed_stress=speed_stress,
        dissipation_rate=(1 - alpha) / 2 * energy / length,
        collision_rate=2 * collisions / jnp.sum(mixture.number_densities),
        source=source / masses[None, None, :],
    )


def _half_range_moments(mean: Array, deviation: Array) -> tuple[Array, Array, Array]:
    """First, second and third moment of a Gaussian, restricted to positive values."""
    z = mean / deviation
    above = jax.lax.erfc(-z / jnp.sqrt(2.0).astype(z.dtype)) / 2
    bell = jnp.exp(-(z**2) / 2) / math.sqrt(2 * math.pi)
    first = deviation * (z * above + bell)
    second = deviation**2 * ((z**2 + 1) * above + z * bell)
    third = deviation**3 * ((z**2 + 3) * z * above + (z**2 + 2) * bell)
    return first, second, third
