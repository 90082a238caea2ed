"""The correlation strain of a flow, which sets the strain of its preparation, blocks and sample,
and its error bars.

It is the strain of one independent sample: 2s for a correlation that decays exponentially over a
strain s. Two processes are slow. The granular temperature follows the heating by the shear over a
strain of nT/τ, thermal energy over shear stress. Waves of velocity and density as long as the cell
decay over a strain that grows as its side ℓ, about 0.35 γ̇ ℓ √(ρ/p): the time that a sound wave
needs for a third of the cell. ``python -m benchmarks size_study`` compares this law with the
correlation of measured series.
"""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from jaxgran.model.checks import is_traced
from jaxgran.model.grains import Grains
from jaxgran.model.status import Status
from jaxgran.sampling.thresholds import FEWEST_CORRELATION_STRAINS, RELAXATION_STRAIN

_WAVE = 0.35  # correlation strain of the longest waves over γ̇ ℓ √(ρ/p)


def flow_correlation_strain(
    averages: Mapping[str, ArrayLike],
    grains: ArrayLike,
    mass: ArrayLike,
    area: ArrayLike,
    shear_rate: ArrayLike,
) -> Any:
    """Correlation strain of a flow: max(nT/τ, 0.35 γ̇ ℓ √(ρ/p)), and at least that of the contact
    network.

    Args:
      averages: granular_temperature, pressure and shear_stress.
      grains: number of grains.
      mass: that of all grains, in m.
      area: area of the cell, in σ².
      shear_rate: γ̇, in 1/t.

    Returns:
      Strain, of the shape of the arguments, of JAX where the averages are. Measured correlations
      are 0.2 to 3 times this. Where an average is not a positive number, it is that of the contact
      network.
    """
    xp: Any = jnp if isinstance(averages["pressure"], jax.Array) else np
    temperature, pressure, shear_stress = (
        xp.asarray(averages[name], float)
        for name in ("granular_temperature", "pressure", "shear_stress")
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        heating = xp.asarray(grains) / xp.asarray(area) * temperature / shear_stress
        waves = _WAVE * xp.asarray(shear_rate) * xp.sqrt(xp.asarray(mass) / pressure)
    return xp.maximum(
        RELAXATION_STRAIN, xp.fmax(*(xp.where(xp.isfinite(x), x, 0.0) for x in (heating, waves)))
    )


def total_mass(grains: Grains) -> Any:
    """Mass of all grains, or of those of each replica, in m."""
    if is_traced(grains.masses):
        return jnp.sum(grains.masses, axis=-1)
    # contiguous, or the order of the sum would depend on the place in a batch
    return np.sum(np.ascontiguousarray(grains.masses), axis=-1)


def mass_of_grains(packing_fraction: Any, area: Any) -> Any:
    """Mass of all grains whose masses are their squared diameters, in m."""
    return 4 / np.pi * packing_fraction * area


def length_status(strain: Any, correlation_strain: Any) -> Any:
    """``short_sample`` where a sampled strain is below ``FEWEST_CORRELATION_STRAINS``, otherwise
    ``ok``.
    """
    xp = jnp if isinstance(strain, jax.Array) else np
    is_short = strain < FEWEST_CORRELATION_STRAINS * correlation_strain
    return xp.where(is_short, Status.short_sample.value, Status.ok.value)
