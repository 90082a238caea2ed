"""From an average at N grains to that of a large system, and its error.

A standard error says how an average scatters over samples of the same length. It does not say how
far the average is from that of a large system, of short time steps and of exact contact solves. An
average is corrected for its number of grains; the errors of the correction, of the time step and of
the tolerance follow from measured laws.

=========  =========================================================================================
part       law, and what it was measured with
=========  =========================================================================================
size       ``SizeLaw``: long waves of velocity are missing in small systems; ``jamming_error``: the
           packing fraction at which they jam scatters (``benchmarks size_limits``, also with flows
           that the laws were not fitted to)
time step  ``stress_error``: the share of its free path that a grain moves in one step (``benchmarks
           stability``)
tolerance  34 times the relative residual of a contact solve, for the part of the stress that
           contacts carry (``benchmarks solvers``)
=========  =========================================================================================

A force ratio belongs to its time step, so the time step adds no error to it.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jax.typing import ArrayLike

from jaxgran.model.choices import HALF_INTERVAL
from jaxgran.sampling.timestep import distance_to_jamming, stress_error

# relative error of the stress of one solve over its residual, which none of ``benchmarks solvers``
# exceeds
RESIDUAL_FACTOR = 34
MEASURED_POLYDISPERSITY = 0.26  # of the flows that all laws here are measured with
MEASURED_RANGES = {
    "restitution": (0.1, 0.85),
    "packing_fraction": (0.1, 0.82),
    "grains": (256, 25_600),
}
_MOST_MISSING = 0.6  # with a few grains the laws do not hold
# The excess of a force ratio has 1.2 times the error of the pressure, and so has another tenth:
# clusters of grains are also missing where the mean force hardly exceeds that of binary collisions.
_OF_EXCESS, _UNSEEN_EXCESS = 1.2, 0.1
_FRICTION_SHARE = 0.9  # of the error of the pressure that the shear stress does not share


class SizeLaw(NamedTuple):
    """The part of an average that is missing at N grains, over that of a large system, as long
    waves are missing:

    strength (1 − α²) exp(density (ν − 0.5)) min(1, (end − ν)/0.1) (N/1600)^(−exponent),

    at most 0.6. A collision loses energy ∝ 1 − α², and the waves end towards jamming.
    ``spread`` is the half-width of the 95 % interval of the missing part, over this part.
    """

    exponent: float
    strength: float
    density: float
    end: float
    spread: float

    def missing(
        self, restitution: ArrayLike, packing_fraction: ArrayLike, grains: ArrayLike
    ) -> np.ndarray:
        alpha, nu, count = (np.asarray(x, float) for x in (restitution, packing_fraction, grains))
        waves = self.strength * (1 - alpha**2) * np.exp(self.density * (nu - 0.5))
        part = waves * np.clip((self.end - nu) / 0.1, 0, 1) * (count / 1600) ** -self.exponent
        return np.minimum(part, _MOST_MISSING)

    def error(
        self, restitution: ArrayLike, packing_fraction: ArrayLike, grains: ArrayLike
    ) -> np.ndarray:
        """Half-width of the 95 % interval of an average that is corrected for its N, over the
        average.

        The first term is that of long waves of velocity. It grows with dissipation and vanishes in
        dense flows. The second is that of jamming: the packing fraction at which a small system
        jams scatters.

        Examples:
          The default number of grains, in a loose and in a dense flow:

          >>> law = SIZE_LAWS["pressure"]
          >>> [round(float(law.error(0.5, nu, 256)), 3) for nu in (0.6, 0.8)]
          [0.086, 0.061]
        """
        missing = self.missing(restitution, packing_fraction, grains)
        waves = self.spread * missing / (1 - missing)
        return np.hypot(waves, jamming_error(packing_fraction, grains))


SIZE_LAWS: dict[str, SizeLaw] = {  # fits of ``benchmarks size_limits``, and their spreads
    "pressure": SizeLaw(0.3453, 0.1092, 0.3831, 0.8307, 0.45),
    "shear_stress": SizeLaw(0.5079, 0.03528, 3.932, 0.8109, 0.4),
    "granular_temperature": SizeLaw(0.1655, 0.3114, 0.5583, 0.8212, 0.9),
    "local_granular_temperature": SizeLaw(0.3736, 0.02491, 2.275, 0.8328, 1.2),
}

LARGE_SYSTEM = ("force_ratio", "macroscopic_friction", *SIZE_LAWS)
"""The averages of which ``large_system`` has estimates."""


ERROR_SOURCES: dict[str, str | None] = {
    "sampling": "sampling",  # 1.96 standard errors
    "timestep": "dt",  # bound on the error from the time step
    "size": "size",  # error of the correction for the number of grains
    "tolerance": None,  # bound on the error from the tolerance of the contact solves
}
"""Sources of the error of an average of a large system, and the headings of their columns in
printed tables; None: too small to be printed."""


class Estimate(NamedTuple):
    """An average of a large system, and the half-widths of its 95 % interval in its unit, by the
    names of ``ERROR_SOURCES``.
    """

    value: np.ndarray
    sources: Mapping[str, np.ndarray]

    @property
    def total(self) -> np.ndarray:
        """Half-width from all sources together: the root of the sum of their squares."""
        return np.sqrt(sum(part**2 for part in self.sources.values()))


def jamming_error(packing_fraction: ArrayLike, grains: ArrayLike) -> np.ndarray:
    """The second term of ``SizeLaw.error``."""
    return 0.007 / distance_to_jamming(packing_fraction) * (100 / np.asarray(grains, float)) ** 1.25


def sampling_target(
    error: float,
    restitution: ArrayLike,
    packing_fraction: ArrayLike,
    grains: ArrayLike,
    crossing: ArrayLike,
    tolerance: float,
) -> np.ndarray:
    """The relative standard error of the stresses that the other parts of a requested error leave
    for sampling; negative where they exceed it.

    Args:
      error: half-width of the 95 % interval of pressure and shear stress, over these.
      restitution, packing_fraction, grains: of the flow.
      crossing: dt √T/σ.
      tolerance: relative residual of a contact solve.
    """
    flow = restitution, packing_fraction, grains
    size = np.maximum(SIZE_LAWS["pressure"].error(*flow), SIZE_LAWS["shear_stress"].error(*flow))
    others = size**2 + stress_error(crossing, packing_fraction, grains) ** 2
    left = error**2 - others - (RESIDUAL_FACTOR * tolerance) ** 2
    return np.sign(left) * np.sqrt(np.abs(left)) / HALF_INTERVAL


def large_system(
    values: Mapping[str, ArrayLike],
    errors: Mapping[str, ArrayLike],
    restitution: ArrayLike,
    packing_fraction: ArrayLike,
    grains: ArrayLike,
    timestep: ArrayLike,
    tolerance: ArrayLike,
) -> dict[str, Estimate]:
    """The averages in ``LARGE_SYSTEM`` of a large system, for arrays of points.

    The friction follows from the laws of both stresses. What is missing of the part of a force
    ratio that exceeds one is taken as that of the pressure.

    Args:
      values, errors: averages and their standard errors, by name; also contact_stress, (..., 2, 2).
      restitution, packing_fraction, grains: of the flow.
      timestep: dt of the sample, in t.
      tolerance: relative residual of a contact solve.
    """
    flow = restitution, packing_fraction, grains
    temperature = np.asarray(values["granular_temperature"], float)
    with np.errstate(invalid="ignore", divide="ignore"):
        crossing = np.asarray(timestep) * np.sqrt(temperature)
        step = stress_error(crossing, packing_fraction, grains)
        contact = np.asarray(values["contact_stress"])
        in_contacts = (contact[..., 0, 0] + contact[..., 1, 1]) / 2 / np.asarray(values["pressure"])
    solve = RESIDUAL_FACTOR * np.asarray(tolerance) * in_contacts
    present = {name: 1 - law.missing(*flow) for name, law in SIZE_LAWS.items()}
    of_pressure, estimates = SIZE_LAWS["pressure"].error(*flow), {}
    for name in LARGE_SYSTEM:
        value, stderr = np.asarray(values[name], float), np.asarray(errors[name], float)
        if name == "force_ratio":
            factor = 1 / present["pressure"]
            large = 1 + factor * (value - 1)
            size = _OF_EXCESS * of_pressure * (np.abs(large - 1) + _UNSEEN_EXCESS)
        elif name == "macroscopic_friction":
            factor = present["pressure"] / present["shear_stress"]
            large = factor * value
            size = _FRICTION_SHARE * of_pressure * np.abs(large)
        else:
            factor = 1 / present[name]
            large = factor * value
            size = SIZE_LAWS[name].error(*flow) * np.abs(large)
        scale = np.abs(large)
        sources = {
            "sampling": HALF_INTERVAL * factor * stderr,
            "timestep": (0.0 if name == "force_ratio" else 1.0) * step * scale,
            "size": size,
            "tolerance": solve * scale,
        }
        estimates[name] = Estimate(large, sources)
    return estimates
