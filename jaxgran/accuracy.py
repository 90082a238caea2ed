"""What a time step and a tolerance cost in accuracy, and the longest and loosest of them for a given error.

In a step of dt a grain of thermal speed moves by x = dt √T/σ, and everything follows from that number:

- the deepest overlap of a sample is about K x diameters, K growing towards jamming, where grains are caught between
  others, and larger with the touching rule, which meets a grain only after it has gone too far;
- the stresses are off by at most about C x, the more the closer to jamming, where they change most with the size of
  the grains.

Kinetic theory underestimates the temperature of dense flows: close to jamming the geometry drives the grains, whatever
their restitution. The numbers here bound what the charts of ``benchmarks/stability.py`` and
``benchmarks/speed_vs_accuracy.py`` show for this size distribution; they choose a run, and are no results.
"""

import numpy as np
from jax.typing import ArrayLike

from jaxgran.dynamics import DEEP_OVERLAP
from jaxgran.flow import Activation

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


def stress_error(crossing: ArrayLike, packing_fraction: ArrayLike, activation: Activation) -> np.ndarray:
    """Bound on the relative error of pressure, shear stress and temperature that the time step makes."""
    stiffness = 1 + 0.3 / _room(packing_fraction)
    return (8 if activation == "touching" else 2) * stiffness * np.asarray(crossing)


def automatic_timestep(
    temperature: ArrayLike, packing_fraction: ArrayLike, activation: Activation, target_error: float
) -> np.ndarray:
    """Longest time step, in t, whose stress error stays within the target and that overlaps nowhere deeply."""
    crossing = target_error / stress_error(1.0, packing_fraction, activation)
    accurate = crossing / np.sqrt(np.asarray(temperature))
    return np.minimum(accurate, longest_timestep(temperature, packing_fraction, activation))


def automatic_tolerance(target_error: float) -> float:
    """Loosest tolerance whose solves are off by no more than half the target in the stress.

    On the network collection, the stress of one solve is off by up to 25 times its relative residual.
    """
    return float(np.clip(target_error / 50, 1e-10, 1e-2))


def _room(packing_fraction: ArrayLike) -> np.ndarray:
    """How far a packing fraction is from jamming."""
    return np.maximum(JAMMING - np.asarray(packing_fraction), 1e-3)
