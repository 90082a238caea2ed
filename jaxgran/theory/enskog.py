"""Enskog's collisional stress and dissipation rate at a given temperature tensor, for instance a
measured one.

Units: ``steady_shear``.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxgran.theory.mixture import ANGLES, Mixture, half_range_moments, uniform_mixture
from jaxgran.theory.steady_shear import Scalar, as_floats


class CollisionalTransfer(NamedTuple):
    """Momentum that collisions transfer, and energy that they lose, per unit area and time;
    stresses are symmetric.
    """

    stress: Float[Array, "*replicas 2 2"]  # Σ d n ⊗ n p over the collisions, the collisional stress
    speed_stress: Float[
        Array, "*replicas 2 2"
    ]  # the same, each collision times its speed of approach w
    dissipation_rate: Float[Array, "*replicas"]  # Σ (1 − α²) μ w²/2 over the collisions


@partial(jax.jit, static_argnames="size_classes")
def collisional_transfer(
    temperature: Float[Array, "2 2"],
    restitution: Scalar,
    packing_fraction: Scalar,
    shear_rate: Scalar = 1.0,
    polydispersity: Scalar = 0.26,
    size_classes: int = 4,
) -> CollisionalTransfer:
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
    returns                     CollisionalTransfer
    ================  ========  =======================================================

    The approach speed w of a pair along its normal n is Gaussian, with mean −γ̇ d n_x n_y and
    variance n·T·n (1/m_i + 1/m_j). A collision transfers the impulse p = (1 + α) μ w and loses the
    energy (1 − α) p w/2, so the stress is ½ Σ_ij n_i n_j χ_ij d_ij² (1 + α) μ_ij ∮ dn n ⊗ n ⟨w²⟩
    and the dissipation rate ¼ Σ_ij n_i n_j χ_ij d_ij (1 − α²) μ_ij ∮ dn ⟨w³⟩, averaged over w > 0.

    Source: J. T. Jenkins and M. W. Richman, J. Fluid Mech. 192, 313 (1988).

    Examples:
      Without shear the collisional pressure is (1 + α) ν χ times the kinetic one, n T.

      >>> still = collisional_transfer(jnp.eye(2), 0.8, 0.5, shear_rate=0.0, polydispersity=0.0)
      >>> round(float(still.stress[0, 0] / (4 / jnp.pi * 0.5)), 4), round(1.8 * 0.5 * 3.125, 4)
      (2.8125, 2.8125)
    """
    alpha, nu, rate, width = as_floats(restitution, packing_fraction, shear_rate, polydispersity)
    return mixture_transfer(temperature, alpha, rate, uniform_mixture(nu, width, size_classes))


def mixture_transfer(
    temperature: Float[Array, "2 2"],
    alpha: Float[Array, ""],
    rate: Float[Array, ""],
    mixture: Mixture,
) -> CollisionalTransfer:
    """``collisional_transfer`` of a mixture of given size classes."""
    dtype = mixture.diameters.dtype
    angle = (jnp.arange(ANGLES, dtype=dtype) + 0.5) * (jnp.pi / ANGLES)
    normals = jnp.stack([jnp.cos(angle), jnp.sin(angle)])
    along = jnp.einsum("ak,ab,bk->k", normals, temperature, normals)
    spread = (1 / mixture.masses)[:, None] + (1 / mixture.masses)[None, :]
    distances = mixture.contact_diameters
    _, second, third = half_range_moments(
        -rate * distances[:, :, None] * (normals[0] * normals[1])[None, None, :],
        jnp.sqrt(spread[:, :, None] * along[None, None, :]),
    )  # each (classes, classes, angles)
    arc = 2 * jnp.pi / ANGLES  # both halves of the circle contribute equally
    pairs = (
        mixture.number_densities[:, None] * mixture.encounters / 2
    )  # half: each pair is summed twice
    impulse = arc * pairs * (1 + alpha) * mixture.reduced_masses  # over the speed of approach
    stress, speed_stress = (
        jnp.einsum("ij,ijk,ak,bk->ab", impulse * distances, moment, normals, normals)
        for moment in (second, third)
    )
    return CollisionalTransfer(
        stress, speed_stress, (1 - alpha) / 2 * jnp.einsum("ij,ijk->", impulse, third)
    )
