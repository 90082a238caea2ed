"""What a time step and a tolerance cost in accuracy, and the longest and loosest of them for a given error.

In a step of dt a grain of thermal speed moves by x = dt √T/σ, and everything follows from that number:

- the deepest overlap of a sample is about K x diameters, K growing towards jamming, where grains are caught between
  others, and larger with the touching rule, which meets a grain only after it has gone too far;
- the stresses are off by at most about x over the mean gap between grains, (ν_J − ν)/2ν diameters: the share of its
  free path that a grain goes in a step. With the midpoint rule they are far better than that where grains bounce.

Kinetic theory underestimates the temperature of dense flows: close to jamming the geometry drives the grains, whatever
their restitution. The numbers here bound what the charts of ``benchmarks/stability.py`` and
``benchmarks/speed_vs_accuracy.py`` show for this size distribution; they choose a run, and are no results.
"""

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array

from jaxgran.model.checks import InputError, two_digits
from jaxgran.model.flow import SHORTEST_TIMESTEP, Activation, ShearFlow
from jaxgran.model.grains import Grains
from jaxgran.model.status import DEEP_OVERLAP
from jaxgran.theory.steady_shear import SteadyShear

COARSE_TIMESTEP = 1e-3
SHORTENING = 10**0.5  # factor between successive time steps
_CROSSING = 0.1  # diameters that a grain of thermal speed may cross in one step
_COARSE_CROSSING = 0.03  # the same for the coarse step, which is ours to choose
JAMMING = 0.8386  # packing fraction where a random quench of diameters uniform in σ ± 0.26 jams


def expected_temperature(theory: ArrayLike, packing_fraction: ArrayLike, shear_rate: ArrayLike = 1.0) -> np.ndarray:
    """Granular temperature of a flow in mσ²/t², from kinetic theory's and what the geometry of dense packings adds.

    It is within a factor of two of measured ones for 0 ≤ α ≤ 0.98 and 0.2 ≤ ν ≤ 0.83.
    """
    return np.asarray(theory) + 0.02 * np.asarray(shear_rate) ** 2 / _room(packing_fraction) ** 1.2


def longest_timestep(temperature: ArrayLike, packing_fraction: ArrayLike, activation: Activation) -> np.ndarray:
    """Longest time step, in t, at which a sample of strain 10 of some hundred grains has no deep overlap."""
    overlap = 2.5 + 1.23 / np.sqrt(_room(packing_fraction)) + (3 if activation == "touching" else 0)
    return DEEP_OVERLAP / (overlap * np.sqrt(np.asarray(temperature)))


def stress_error(crossing: ArrayLike, packing_fraction: ArrayLike) -> np.ndarray:
    """Bound on the relative error that the time step makes in pressure and shear stress, from x = dt √T/σ.

    Examples:
      The same crossing costs more where the gaps are small:

      >>> [round(float(stress_error(1e-3, nu)), 3) for nu in (0.5, 0.7, 0.8)]
      [0.003, 0.01, 0.041]
    """
    gap = np.minimum(_room(packing_fraction) / (2 * np.asarray(packing_fraction)), 0.5)
    return np.asarray(crossing) / gap


def automatic_timestep(
    temperature: ArrayLike, packing_fraction: ArrayLike, activation: Activation, target_error: float
) -> np.ndarray:
    """Longest time step, in t, whose stress error stays within the target and that overlaps nowhere deeply."""
    crossing = target_error / stress_error(1.0, packing_fraction)
    accurate = crossing / np.sqrt(np.asarray(temperature))
    return np.minimum(accurate, longest_timestep(temperature, packing_fraction, activation))


def automatic_tolerance(target_error: float) -> float:
    """Loosest tolerance whose solves are off by no more than half the target in the stress.

    In the networks of flows the stress of one solve is off by up to 34 times its relative residual. Over a run these
    errors mostly cancel, so this is on the safe side.
    """
    return float(np.clip(target_error / 70, 1e-10, 1e-2))


def _room(packing_fraction: ArrayLike) -> np.ndarray:
    """How far a packing fraction is from jamming."""
    return np.maximum(JAMMING - np.asarray(packing_fraction), 1e-3)


def check_timestep(flow: ShearFlow, theory: SteadyShear, grains: Grains | None = None) -> None:
    """Raise a ValueError where a grain of thermal speed crosses more than a tenth of a diameter in one step.

    Of the default grains it is the mean diameter and the speed of a mean grain; of one's own, those of the grain that
    is the fastest to cross its own diameter.
    """
    if np.any(np.asarray(flow.timestep) * np.asarray(flow.shear_rate) < 0.49 * SHORTEST_TIMESTEP):
        raise InputError(
            f"timestep must be at least {SHORTEST_TIMESTEP:g} / shear_rate, or the steps would be too many to count."
        )
    longest = _CROSSING / _crossing_rate(theory, grains)
    too_long = np.asarray(flow.timestep) > longest
    if np.any(too_long):
        worst = np.argmax(np.asarray(flow.timestep) / longest)
        alpha, nu = (float(np.asarray(x)[worst]) for x in (flow.restitution, flow.packing_fraction))
        raise InputError(
            f"timestep must be at most {two_digits(longest[worst], up=False)} at restitution {alpha:g} and packing "
            f"fraction {nu:g}, or grains would cross more than a tenth of a diameter in one step."
        )


def _crossing_rate(theory: SteadyShear, grains: Grains | None) -> np.ndarray:
    """Diameters that a grain of thermal speed crosses in a unit of time."""
    speed = np.sqrt(2 * np.asarray(theory.granular_temperature))
    return speed if grains is None else speed / np.min(2 * grains.radii * np.sqrt(grains.masses), axis=-1)


def bounded_coarse_timestep(
    flow: ShearFlow, theory: SteadyShear, longest: float = COARSE_TIMESTEP, grains: Grains | None = None
) -> Array:
    coarse = np.minimum(longest / np.asarray(flow.shear_rate), _COARSE_CROSSING / _crossing_rate(theory, grains))
    return jnp.maximum(jnp.asarray(coarse, jnp.asarray(flow.timestep).dtype), flow.timestep)


def timestep_ladder(coarse: np.ndarray, final: np.ndarray) -> list[float]:
    """Time steps strictly between a coarse and a final one, (1,) each, in equal ratios of at most ``SHORTENING``."""
    steps = int(np.ceil(np.log(coarse / final) / np.log(SHORTENING) - 1e-9).item())
    return [(coarse * (final / coarse) ** (k / steps)).item() for k in range(1, steps)]
