"""Errors that a time step causes, and the longest step for a given error.

In one step dt a grain of thermal speed moves by x = dt √T/σ. The errors follow from x:

- The deepest overlap of a sample is about K x diameters. K grows towards jamming, where grains are
  caught between others. It is larger with the touching rule, which finds a contact only after the
  grains overlap.
- The relative error of the stresses is at most about x over the mean gap between grains, (ν_J −
  ν)/2ν diameters, in the densest states that a cell of N grains passes through. This ratio is the
  share of its free path that a grain moves in one step. With the midpoint rule the error is far
  smaller for grains that bounce.
- A sample knows its mean overlap. Over the mean gap it foretells the error of the pressure better
  than x or the share of deep contacts does (``python -m benchmarks timestep_error``).

Kinetic theory underestimates the temperature of dense flows: close to jamming the geometry drives
the grains, for any restitution. The numbers here are bounds on what ``python -m benchmarks
timestep_error``, ``stability`` and ``speed_vs_accuracy`` find for this size distribution. They
serve to choose a time step and are not results.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from jaxgran.model.checks import InputError, two_digits
from jaxgran.model.choices import SHORTEST_TIMESTEP
from jaxgran.model.flow import ShearFlow
from jaxgran.model.grains import Grains
from jaxgran.model.status import DEEP_OVERLAP
from jaxgran.theory.steady_shear import SteadyShear

COARSE_TIMESTEP = 1e-3  # 1/γ̇; time step until the flow is steady
SHORTENING = 10**0.5  # largest factor between successive time steps
JAMMING = 0.8386  # packing fraction where a random quench of diameters uniform in σ ± 0.26 jams
_LARGEST_CROSSING = 0.1  # largest motion in one step of a grain of thermal speed, in its diameters
_COARSE_CROSSING = 0.03  # the same limit for the coarse time step
_DEEPEST_OVERLAP = 0.0175  # mean overlap of the contacts over the mean gap
_SMALLEST_DISTANCE = 1e-3  # smallest distance to jamming that enters a bound, in packing fraction


def expected_temperature(
    theory: ArrayLike,
    packing_fraction: ArrayLike,
    shear_rate: ArrayLike = 1.0,
    mass: ArrayLike = 1.0,
) -> np.ndarray:
    """Granular temperature of a flow in mσ²/t²: that of kinetic theory and a term from the geometry
    of dense packings, for grains of this mean mass in m.

    It is within a factor of two of simulations for 0 ≤ α ≤ 0.98 and 0.2 ≤ ν ≤ 0.83.
    """
    geometry = 0.02 * np.asarray(shear_rate) ** 2 / distance_to_jamming(packing_fraction) ** 1.2
    return np.asarray(theory) + geometry * np.asarray(mass)


def longest_timestep(
    temperature: ArrayLike, packing_fraction: ArrayLike, activation: ArrayLike
) -> np.ndarray:
    """Longest time step, in t, for which a sample of strain 10 and some hundred grains has no deep
    overlap, by θ of the activation rule.
    """
    late = np.where(np.asarray(activation) == 0, 3, 0)
    overlap = 2.5 + 1.23 / np.sqrt(distance_to_jamming(packing_fraction)) + late
    return DEEP_OVERLAP / (overlap * np.sqrt(np.asarray(temperature)))


def stress_error(crossing: ArrayLike, packing_fraction: ArrayLike, grains: ArrayLike) -> Any:
    """Bound on the relative error of pressure and shear stress from the time step, by the crossing
    x = dt √T/σ: x over ``mean_gap``.

    Examples:
      The same crossing causes a larger error where the gaps are small:

      >>> [round(float(stress_error(1e-3, nu, 256)), 3) for nu in (0.5, 0.7, 0.8)]
      [0.003, 0.011, 0.052]
    """
    gap = mean_gap(packing_fraction, grains)
    return (jnp if isinstance(gap, jax.Array) else np).asarray(crossing) / gap


def mean_gap(packing_fraction: ArrayLike, grains: ArrayLike) -> Any:
    """Mean gap between grains in the densest states that N of them pass through, in diameters: (ν_J
    − ν)/2ν, and at most ½.

    The packing fraction where N grains jam has a distribution of full width 0.16 N⁻⁰·⁵⁵ (O'Hern,
    Silbert, Liu and Nagel, Phys. Rev. E 68, 011306, 2003), by which ν is raised: the pressure of a
    small dense system is that of the times when it is nearly jammed.
    """
    xp = jnp if isinstance(packing_fraction, jax.Array) else np
    nu = xp.asarray(packing_fraction) + 0.16 * np.asarray(grains, float) ** -0.55
    return xp.minimum(distance_to_jamming(nu) / (2 * nu), 0.5)


def deepest_overlap(packing_fraction: ArrayLike, grains: ArrayLike) -> Any:
    """Mean overlap of the contacts, in diameters, above which a sample has the status
    ``deep_overlap``: a small part of ``mean_gap``.

    Of 192 samples of 256 grains, with time steps of 3e-4 to 1e-2, all 34 exceed it whose pressure
    was off by more than 3 % beyond two standard errors, and 22 that were within 3 %; of the
    six below it at ν ≥ 0.8, the pressure was off by 2.3 % at most. That more than a tenth of the
    contacts are deeper than 1e-2 σ misses half of the 34 (``python -m benchmarks
    timestep_error``).
    """
    return _DEEPEST_OVERLAP * mean_gap(packing_fraction, grains)


def automatic_timestep(
    temperature: ArrayLike,
    packing_fraction: ArrayLike,
    activation: ArrayLike,
    grains: ArrayLike,
    target_error: float,
) -> np.ndarray:
    """Longest time step, in t, with a stress error within the target, and at most
    ``longest_timestep``. Contacts overlap deeply where a target above 5 % is reached.
    """
    crossing = target_error / stress_error(1.0, packing_fraction, grains)
    accurate = crossing / np.sqrt(np.asarray(temperature))
    return np.minimum(accurate, longest_timestep(temperature, packing_fraction, activation))


def distance_to_jamming(packing_fraction: ArrayLike) -> Any:
    """Difference between the packing fraction at jamming and this one."""
    xp = jnp if isinstance(packing_fraction, jax.Array) else np
    return xp.maximum(JAMMING - xp.asarray(packing_fraction), _SMALLEST_DISTANCE)


def check_timestep(flow: ShearFlow, theory: SteadyShear, grains: Grains | None = None) -> None:
    """Raise an InputError if a grain of thermal speed crosses more than a tenth of a diameter in
    one step.

    For the default grains this is the mean diameter and the thermal speed of a mean grain. For
    given grains it is the grain that crosses its own diameter fastest.
    """
    shortest = 0.999 * SHORTEST_TIMESTEP  # with room for rounding
    if np.any(np.asarray(flow.timestep) * np.asarray(flow.shear_rate) < shortest):
        raise InputError(
            f"timestep must be at least {SHORTEST_TIMESTEP:g} / shear_rate, or the steps would be "
            "too many to count."
        )
    longest = _LARGEST_CROSSING / _crossing_rate(theory, grains)
    too_long = np.asarray(flow.timestep) > longest
    if np.any(too_long):
        worst = np.argmax(np.asarray(flow.timestep) / longest)
        alpha, nu = (float(np.asarray(x)[worst]) for x in (flow.restitution, flow.packing_fraction))
        raise InputError(
            f"timestep must be at most {two_digits(longest[worst], up=False)} at restitution "
            f"{alpha:g} and packing "
            f"fraction {nu:g}, or grains would cross more than a tenth of a diameter in one step."
        )


def _crossing_rate(theory: SteadyShear, grains: Grains | None) -> np.ndarray:
    """Diameters that a grain of thermal speed crosses in a unit of time, in 1/t."""
    speed = np.sqrt(2 * np.asarray(theory.granular_temperature))
    return (
        speed
        if grains is None
        else speed / np.min(2 * grains.radii * np.sqrt(grains.masses), axis=-1)
    )


def bounded_coarse_timestep(
    flow: ShearFlow, theory: SteadyShear, grains: Grains | None = None
) -> np.ndarray:
    """The coarse time step of each flow, in t: short enough for its thermal speed, not shorter than
    its own step.
    """
    coarse = np.minimum(
        COARSE_TIMESTEP / np.asarray(flow.shear_rate),
        _COARSE_CROSSING / _crossing_rate(theory, grains),
    )
    timestep = np.asarray(flow.timestep)
    return np.maximum(coarse.astype(timestep.dtype), timestep)


def timestep_ladder(coarse: np.ndarray, final: np.ndarray) -> list[float]:
    """Time steps between a coarse and a final one, (1,) each, without these; equal ratios of at
    most ``SHORTENING``.
    """
    steps = int(np.ceil(np.log(coarse / final) / np.log(SHORTENING) - 1e-9).item())
    return [(coarse * (final / coarse) ** (k / steps)).item() for k in range(1, steps)]
