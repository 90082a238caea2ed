"""The formulas of the observables: averages computed from a tally."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array

from jaxgran.dynamics.tally import Tally
from jaxgran.model.batches import in_numpy


def averages(tally: Tally, area: ArrayLike, grains: int, shear_rate: ArrayLike) -> dict[str, Array]:
    """All observables of a tally, by the names of ``OBSERVABLES``.

    Args:
      tally: sums with any leading axes.
      area: area of the cell, in σ².
      grains: number of grains.
      shear_rate: γ̇, in 1/t.

    Returns:
      NumPy arrays, or those of JAX where it traces, with the leading axes of the tally; tensors
      have two more axes, (2, 2). The diagonal of a stress Σ^{ab} is positive, and the shear stress
      is −Σ^{xy}, as in the paper. An average over no contacts is NaN.
    """
    tally, area, shear_rate = in_numpy((tally, area, shear_rate))
    with np.errstate(divide="ignore", invalid="ignore"):  # NumPy warns of these, JAX does not
        return _averages(
            tally, area, grains, shear_rate, _namespace(*vars(tally).values(), area, shear_rate)
        )


def _averages(
    tally: Tally, area: ArrayLike, grains: int, shear_rate: ArrayLike, xp: Any
) -> dict[str, Array]:
    area, shear_rate = xp.asarray(area), xp.asarray(shear_rate)
    volume = area * tally.duration
    contact, binary, kinetic = (
        moment / volume[..., None, None]
        for moment in (tally.contact_moment, tally.binary_moment, tally.kinetic_moment)
    )
    in_clusters, in_all = tally.cluster_moment, tally.contact_moment
    contact_pressure, kinetic_pressure = (
        (s[..., 0, 0] + s[..., 1, 1]) / 2 for s in (contact, kinetic)
    )
    total_pressure = contact_pressure + kinetic_pressure
    total_shear = -contact[..., 0, 1] - kinetic[..., 0, 1]
    work = total_shear * shear_rate * volume
    temperature = kinetic_pressure * area / grains
    return {
        "force_ratio": _ratio(tally.impulse, tally.binary_impulse),
        "pressure": total_pressure,
        "shear_stress": total_shear,
        "granular_temperature": temperature,
        "local_granular_temperature": _ratio(tally.local_kinetic, tally.duration),
        "longwave_energy_ratio": _ratio(tally.wave_kinetic, temperature * tally.duration),
        "dissipation_rate": tally.dissipation / volume,
        "binary_dissipation_rate": tally.binary_dissipation / volume,
        "cluster_pressure_share": _ratio(
            *(xp.trace(x, axis1=-2, axis2=-1) for x in (in_clusters, in_all))
        ),
        "cluster_shear_share": _ratio(in_clusters[..., 0, 1], in_all[..., 0, 1]),
        "coordination_number": 2 * tally.loaded_contacts / (grains * tally.steps),
        "macroscopic_friction": total_shear / total_pressure,
        "inertial_number": shear_rate / xp.sqrt(total_pressure),
        "collision_rate": 2 * tally.collisions / (grains * tally.duration * shear_rate),
        "iterations": _ratio(tally.iterations, tally.solves),
        "worst_residual": tally.worst_residual,
        "unconverged_share": _ratio(tally.unconverged, tally.solves),
        "mean_overlap": _ratio(tally.overlap, tally.contacts),
        "max_overlap": tally.largest_overlap,
        "momentum_drift": tally.momentum_drift,
        "energy_balance_error": _ratio(
            work - tally.dissipation - tally.energy_change, xp.abs(work)
        ),
        "complementarity_power": _ratio(tally.complementarity, xp.abs(work)),
        "contact_stress": contact,
        "binary_stress": binary,
        "kinetic_stress": kinetic,
        "stress_ratio": _ratio(contact, binary),
    }


def _namespace(*values: Any) -> Any:
    """``jax.numpy`` for JAX arrays, or else NumPy, which is 100 times faster for the few numbers of
    a point.
    """
    return jnp if any(isinstance(x, jax.Array) for x in values) else np


def _ratio(numerator: Array, denominator: Array) -> Array:
    """The quotient; NaN without a warning where the denominator is zero."""
    xp = _namespace(numerator, denominator)
    return xp.where(
        denominator == 0, xp.nan, numerator / xp.where(denominator == 0, 1, denominator)
    )
