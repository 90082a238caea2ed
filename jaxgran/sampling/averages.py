"""The formulas of the observables: averages computed from a tally."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array

from jaxgran.dynamics.tally import RESIDUAL_EDGES, Tally
from jaxgran.model.batches import in_numpy


def averages(tally: Tally, area: ArrayLike, grains: int, shear_rate: ArrayLike) -> dict[str, Array]:
    """All observables of a tally, by the names of ``OBSERVABLES``.

    Args:
      tally: sums with any leading axes.
      area: area of the cell, in σ².
      grains: number of grains.
      shear_rate: γ̇, in 1/t.

    Returns:
      NumPy arrays, or those of JAX where it traces, with the leading axes of the tally; tensors have two more axes,
      (2, 2). The diagonal of a stress Σ^{ab} is positive, and the shear stress is −Σ^{xy}, as in the paper. An average
      over no contacts is NaN.
    """
    tally, area, shear_rate = in_numpy((tally, area, shear_rate))
    with np.errstate(divide="ignore", invalid="ignore"):  # NumPy warns of these, JAX does not
        return _averages(tally, area, grains, shear_rate, _namespace(*vars(tally).values(), area, shear_rate))


def _averages(tally: Tally, area: ArrayLike, grains: int, shear_rate: ArrayLike, xp: Any) -> dict[str, Array]:
    area, shear_rate = xp.asarray(area), xp.asarray(shear_rate)
    volume = area * tally.duration
    contact, binary, kinetic = (
        moment / volume[..., None, None] for moment in (tally.contact_moment, tally.binary_moment, tally.kinetic_moment)
    )
    in_clusters, in_all = tally.cluster_moment, tally.contact_moment
    dt = _ratio(tally.duration, tally.steps)
    pressure = {name: (s[..., 0, 0] + s[..., 1, 1]) / 2 for name, s in _named(contact, binary, kinetic)}
    shear = {name: -s[..., 0, 1] for name, s in _named(contact, binary, kinetic)}
    total_pressure = pressure["contact"] + pressure["kinetic"]
    total_shear = shear["contact"] + shear["kinetic"]
    work = total_shear * shear_rate * volume
    temperature = pressure["kinetic"] * area / grains
    return {
        "force_ratio": _ratio(tally.impulse, tally.binary_impulse),
        "contact_force": _ratio(tally.impulse, tally.loaded_contacts * dt),
        "binary_force": _ratio(tally.binary_impulse, tally.loaded_contacts * dt),
        "force_second_moment": _ratio(tally.squared_impulse * tally.loaded_contacts, tally.impulse**2),
        "pressure": total_pressure,
        **{f"{name}_pressure": x for name, x in pressure.items()},
        "shear_stress": total_shear,
        **{f"{name}_shear_stress": x for name, x in shear.items()},
        "granular_temperature": temperature,
        "local_granular_temperature": _ratio(tally.local_kinetic, tally.duration),
        "longwave_energy_ratio": _ratio(tally.wave_kinetic, temperature * tally.duration),
        "bagnold_pressure": total_pressure / shear_rate**2,
        "bagnold_shear_stress": total_shear / shear_rate**2,
        "dissipation_rate": tally.dissipation / volume,
        "binary_dissipation_rate": tally.binary_dissipation / volume,
        "cluster_pressure_share": _ratio(*(xp.trace(x, axis1=-2, axis2=-1) for x in (in_clusters, in_all))),
        "cluster_shear_share": _ratio(in_clusters[..., 0, 1], in_all[..., 0, 1]),
        "coordination_number": 2 * tally.loaded_contacts / (grains * tally.steps),
        "network_size": _ratio(tally.contacts, tally.solves),
        "macroscopic_friction": total_shear / total_pressure,
        "inertial_number": shear_rate / xp.sqrt(total_pressure),
        "collision_rate": 2 * tally.collisions / (grains * tally.duration * shear_rate),
        "iterations": _ratio(tally.iterations, tally.solves),
        "median_residual": _median_residual(tally.residual_counts),
        "worst_residual": tally.worst_residual,
        "unconverged_share": _ratio(tally.unconverged, tally.solves),
        "mean_overlap": _ratio(tally.overlap, tally.contacts),
        "max_overlap": tally.largest_overlap,
        "momentum_drift": tally.momentum_drift,
        "energy_balance_error": _ratio(work - tally.dissipation - tally.energy_change, xp.abs(work)),
        "complementarity_power": _ratio(tally.complementarity, xp.abs(work)),
        "contact_stress": contact,
        "binary_stress": binary,
        "kinetic_stress": kinetic,
        "stress_ratio": _ratio(contact, binary),
    }


def _median_residual(counts: Array) -> Array:
    """Median of a histogram of residuals (..., bins), interpolated in its bin; zero if that is the lowest bin."""
    xp = _namespace(counts)
    cumulative = xp.cumsum(counts, axis=-1)
    half = cumulative[..., -1:] / 2
    bin = xp.argmax(cumulative >= half, axis=-1, keepdims=True)
    in_bin, up_to_bin = (xp.take_along_axis(x, bin, axis=-1)[..., 0] for x in (counts, cumulative))
    bin, half = bin[..., 0], half[..., 0]
    share = 1 - (up_to_bin - half) / xp.where(in_bin > 0, in_bin, 1)
    edges = xp.log10(xp.asarray(RESIDUAL_EDGES, counts.dtype))
    median = 10 ** (edges[bin] + share * (edges[bin + 1] - edges[bin]))
    return xp.where(half > 0, xp.where(bin == 0, 0, median), xp.nan)


def _namespace(*values: Any) -> Any:
    """``jax.numpy`` for JAX arrays, or else NumPy, which is 100 times faster for the few numbers of a point."""
    return jnp if any(isinstance(x, jax.Array) for x in values) else np


def _named(contact: Array, binary: Array, kinetic: Array):
    return (("contact", contact), ("binary", binary), ("kinetic", kinetic))


def _ratio(numerator: Array, denominator: Array) -> Array:
    """The quotient; NaN without a warning where the denominator is zero."""
    xp = _namespace(numerator, denominator)
    return xp.where(denominator == 0, xp.nan, numerator / xp.where(denominator == 0, 1, denominator))
