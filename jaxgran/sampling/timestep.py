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

import numpy as np
from jax.typing import ArrayLike

from jaxgran.dynamics.plain import DEEP_OVERLAP
from jaxgran.model.flow import Activation

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
