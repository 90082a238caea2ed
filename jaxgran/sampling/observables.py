"""Observables: the averages computed from a tally, with their names and units."""

from typing import Any, overload

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array

from jaxgran.dynamics.tally import RESIDUAL_EDGES, Tally
from jaxgran.model.batches import in_numpy

STRESS_UNIT = "m / t^2"  # in two dimensions; t is the time unit of the shear rate, 1/shear rate by default

OBSERVABLES: dict[str, tuple[str, str]] = {
    "force_ratio": ("mean contact force over mean binary contact force", "1"),
    "contact_force": ("mean force of a contact that carries an impulse", "m sigma / t^2"),
    "binary_force": ("mean force of such a contact if collisions were binary", "m sigma / t^2"),
    "force_second_moment": ("mean squared force of a contact that carries an impulse over its squared mean", "1"),
    "pressure": ("pressure, contact and kinetic", STRESS_UNIT),
    "contact_pressure": ("pressure of the contact forces", STRESS_UNIT),
    "binary_pressure": ("pressure of the contact forces if collisions were binary", STRESS_UNIT),
    "kinetic_pressure": ("pressure of the peculiar motion", STRESS_UNIT),
    "shear_stress": ("shear stress, contact and kinetic, positive", STRESS_UNIT),
    "contact_shear_stress": ("shear stress of the contact forces", STRESS_UNIT),
    "binary_shear_stress": ("shear stress of the contact forces if collisions were binary", STRESS_UNIT),
    "kinetic_shear_stress": ("shear stress of the peculiar motion", STRESS_UNIT),
    "granular_temperature": ("granular temperature, sum of m c^2 over 2 N", "m sigma^2 / t^2"),
    "local_granular_temperature": (
        "granular temperature relative to the mean velocity of boxes of about 25 grains",
        "m sigma^2 / t^2",
    ),
    "longwave_energy_ratio": ("kinetic energy of the four longest waves of velocity over that of equipartition", "1"),
    "bagnold_pressure": ("pressure over mass of a mean grain times squared shear rate", "1"),
    "bagnold_shear_stress": ("shear stress over mass of a mean grain times squared shear rate", "1"),
    "dissipation_rate": ("energy that contacts lose per unit area and time", "m / t^3"),
    "binary_dissipation_rate": ("energy that contacts would lose if collisions were binary", "m / t^3"),
    "cluster_pressure_share": ("share of the contact pressure in clusters of three or more grains", "1"),
    "cluster_shear_share": ("share of the contact shear stress in clusters of three or more grains", "1"),
    "coordination_number": ("contacts per grain that carry an impulse (twice their number over the grains)", "1"),
    "network_size": ("contacts of a solved network, carrying an impulse or not", "1"),
    "macroscopic_friction": ("shear stress over pressure", "1"),
    "inertial_number": ("shear rate times the square root of the mass of a mean grain over the pressure", "1"),
    "collision_rate": ("approaching contacts per grain and unit strain, each grain counting its own", "1"),
    "iterations": ("solver iterations per solved network", "1"),
    "median_residual": ("median relative residual of the solved networks", "1"),
    "worst_residual": ("largest relative residual of a solved network", "1"),
    "unconverged_share": ("share of the solved networks that ended above the tolerance", "1"),
    "mean_overlap": ("mean overlap of the contacts of a solved network", "sigma"),
    "max_overlap": ("largest overlap of a contact", "sigma"),
    "momentum_drift": ("largest total momentum over the sum of the momenta of the grains", "1"),
    "energy_balance_error": ("shear work less dissipation and growth of the kinetic energy, over shear work", "1"),
    "complementarity_power": ("sum of p (u+ + alpha u-)/2, which an exact solve makes zero, over shear work", "1"),
    "contact_stress": ("stress of the contact forces", STRESS_UNIT),
    "binary_stress": ("stress of the contact forces if collisions were binary", STRESS_UNIT),
    "kinetic_stress": ("stress of the peculiar motion", STRESS_UNIT),
    "stress_ratio": ("contact stress over binary stress, by component", "1"),
}
EXTREME_OBSERVABLES = {
    "max_overlap": "largest_overlap",
    "worst_residual": "worst_residual",
    "momentum_drift": "momentum_drift",
}
TENSORS = ("contact_stress", "binary_stress", "kinetic_stress", "stress_ratio")


class Average:
    """An average of a sample as an attribute, by the name of an observable."""

    def __set_name__(self, owner: type, name: str) -> None:
        self.name, self.__doc__ = name, "{}, unit {}".format(*OBSERVABLES[name])

    @overload
    def __get__(self, sample: None, owner: type) -> "Average": ...

    @overload
    def __get__(self, sample: "Averages", owner: type) -> Array | np.ndarray: ...

    def __get__(self, sample: Any, owner: type) -> Any:
        return self if sample is None else sample.averages[self.name]


class Averages:
    """Every observable as an attribute, from the mapping ``averages``; editors know the names."""

    force_ratio = Average()
    contact_force = Average()
    binary_force = Average()
    force_second_moment = Average()
    pressure = Average()
    contact_pressure = Average()
    binary_pressure = Average()
    kinetic_pressure = Average()
    shear_stress = Average()
    contact_shear_stress = Average()
    binary_shear_stress = Average()
    kinetic_shear_stress = Average()
    granular_temperature = Average()
    local_granular_temperature = Average()
    longwave_energy_ratio = Average()
    bagnold_pressure = Average()
    bagnold_shear_stress = Average()
    dissipation_rate = Average()
    binary_dissipation_rate = Average()
    cluster_pressure_share = Average()
    cluster_shear_share = Average()
    coordination_number = Average()
    network_size = Average()
    macroscopic_friction = Average()
    inertial_number = Average()
    collision_rate = Average()
    iterations = Average()
    median_residual = Average()
    worst_residual = Average()
    unconverged_share = Average()
    mean_overlap = Average()
    max_overlap = Average()
    momentum_drift = Average()
    energy_balance_error = Average()
    complementarity_power = Average()
    contact_stress = Average()
    binary_stress = Average()
    kinetic_stress = Average()
    stress_ratio = Average()


def unit_attributes(unit: str) -> dict[str, str]:
    """The attributes of a dataset's variable that give its unit: all are numbers in units of m, σ and t."""
    return {"units": "1"} if unit == "1" else {"reduced_unit": unit, "units": "1"}


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
