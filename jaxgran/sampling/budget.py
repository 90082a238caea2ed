"""The error budget of an average: sampling, time step, tolerance and number of grains, each by a
measured law.

A standard error says how an average scatters over samples of the same length. It does not say how
far the average is from that of a large system, of short time steps and of exact contact solves. The
laws here bound these differences.

=========  =========================================================================================
part       law, and what it was measured with
=========  =========================================================================================
time step  ``stress_error``: the share of its free path that a grain moves in one step (``benchmarks
           stability``)
tolerance  34 times the relative residual of a contact solve, for the part of the stress that
           contacts carry (``benchmarks solvers``)
size       ``size_error``: long waves of velocity are missing in small systems, and the packing
           fraction at which they jam scatters (``benchmarks size_limits``)
=========  =========================================================================================

A force ratio belongs to its time step, so the time step adds no error to it.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jax.typing import ArrayLike

from jaxgran.model.choices import HALF_INTERVAL
from jaxgran.sampling.timestep import distance_to_jamming, stress_error

# relative error of the stress of one solve over its residual, that 98 % of solves do not exceed
RESIDUAL_FACTOR = 34

# Largest share of a requested error that each source may take; their squares add up to one.
_SQUARES = {"sampling": 0.44, "size": 0.36, "timestep": 0.16, "tolerance": 0.04}
SHARES = {source: square**0.5 for source, square in _SQUARES.items()}


class SizeLaw(NamedTuple):
    """The part of an average that is missing at N grains, over that of a large system, as long
    waves are missing:

    (elastic + dissipative (1 − α)) exp(density (ν − 0.5)) min(1, (end − ν)/0.1)
    (N/1600)^(−exponent).
    """

    exponent: float
    elastic: float
    dissipative: float
    density: float
    end: float

    def missing(
        self, restitution: ArrayLike, packing_fraction: ArrayLike, grains: ArrayLike
    ) -> np.ndarray:
        alpha, nu, count = (np.asarray(x, float) for x in (restitution, packing_fraction, grains))
        waves = (self.elastic + self.dissipative * (1 - alpha)) * np.exp(self.density * (nu - 0.5))
        return waves * np.clip((self.end - nu) / 0.1, 0, 1) * (count / 1600) ** -self.exponent


SIZE_LAWS: dict[str, SizeLaw] = {  # fits of ``benchmarks size_limits``
    "pressure": SizeLaw(0.4175, 0.00494, 0.1151, 0.3665, 0.8193),
    "shear_stress": SizeLaw(0.5639, 0.00744, 0.03257, 3.591, 0.8012),
    "granular_temperature": SizeLaw(0.2314, 0.01633, 0.3066, 0.8507, 0.8096),
    "local_granular_temperature": SizeLaw(0.7592, 0.0, 0.02069, 2.435, 0.8015),
}
MEASURED_POLYDISPERSITY = 0.26  # of the flows that all laws here are measured with
SIZE_SPREAD = 0.5  # half-width of the 95 % interval of the missing part of one flow, over the law


class Law(NamedTuple):
    """How the errors of one average follow from those of the stresses, as factors; 0 where there is
    none.
    """

    timestep: float
    tolerance: float
    size: float
    sized_as: str  # the average with the same law of the size


BUDGET: dict[str, Law] = {
    "force_ratio": Law(
        0.0, 1.0, 1.0, "pressure"
    ),  # that of the size is the share of the excess, see ``error_budget``
    "pressure": Law(1.0, 1.0, 1.0, "pressure"),
    "shear_stress": Law(1.0, 1.0, 1.0, "shear_stress"),
    "granular_temperature": Law(1.0, 1.0, 1.0, "granular_temperature"),
    "local_granular_temperature": Law(1.0, 1.0, 1.0, "local_granular_temperature"),
    "macroscopic_friction": Law(1.0, 1.0, 0.7, "pressure"),
}


def size_error(
    restitution: ArrayLike,
    packing_fraction: ArrayLike,
    grains: ArrayLike,
    average: str = "pressure",
) -> np.ndarray:
    """Bound on the difference of an average at N grains from that of a large system, over the
    latter.

    The first term is that of long waves of velocity. It grows with dissipation and vanishes in
    dense flows. The second is that of jamming: the packing fraction at which a small system jams
    scatters.

    Examples:
      The default number of grains, in a loose and in a dense flow:

      >>> [round(float(size_error(0.5, nu, 256)), 3) for nu in (0.6, 0.8)]
      [0.218, 0.099]
    """
    waves = (1 + SIZE_SPREAD) * SIZE_LAWS[average].missing(restitution, packing_fraction, grains)
    return waves + jamming_error(packing_fraction, grains)


def jamming_error(packing_fraction: ArrayLike, grains: ArrayLike) -> np.ndarray:
    """The second term of ``size_error``."""
    return 0.007 / distance_to_jamming(packing_fraction) * (100 / np.asarray(grains, float)) ** 1.25


def sampling_error(error: float) -> float:
    """The standard error that takes the share of sampling in a requested error."""
    return SHARES["sampling"] * error / HALF_INTERVAL


def fewest_grains(restitution: float, packing_fraction: float, size: float) -> int:
    """The smallest of 256, 362, 512, 724, ... grains, in steps of √2, whose ``size_error`` is
    within a given one.

    So programs are compiled for few numbers of grains, and no system is much larger than necessary.
    """
    step = 0
    while size_error(restitution, packing_fraction, _grains_at(step)) > size:
        step += 1
    return _grains_at(step)


def _grains_at(step: int) -> int:
    return round(256 * 2 ** (step / 2))


def error_budget(
    values: Mapping[str, ArrayLike],
    errors: Mapping[str, ArrayLike],
    restitution: ArrayLike,
    packing_fraction: ArrayLike,
    grains: ArrayLike,
    timestep: ArrayLike,
    tolerance: ArrayLike,
) -> dict[str, dict[str, np.ndarray]]:
    """Half-widths of the 95 % interval of every average in ``BUDGET``, by source and in its unit,
    for arrays of points.

    ===========  ===================================================================================
    source       half-width
    ===========  ===================================================================================
    total        of all sources together, √(sampling² + timestep² + size² + tolerance²)
    sampling     1.96 standard errors
    timestep     bound on the error from the time step
    size         bound on the difference from a large system
    tolerance    bound on the error from the tolerance of the contact solves
    ===========  ===================================================================================

    Args:
      values, errors: averages and their standard errors, by name; also contact_stress, (..., 2, 2).
      restitution, packing_fraction, grains: of the flow.
      timestep: dt of the sample, in t.
      tolerance: relative residual of a contact solve.
    """
    temperature = np.asarray(values["granular_temperature"], float)
    with np.errstate(invalid="ignore", divide="ignore"):
        step = stress_error(np.asarray(timestep) * np.sqrt(temperature), packing_fraction)
        contact = np.asarray(values["contact_stress"])
        in_contacts = (contact[..., 0, 0] + contact[..., 1, 1]) / 2 / np.asarray(values["pressure"])
    solve = RESIDUAL_FACTOR * np.asarray(tolerance) * in_contacts
    budget = {}
    for name, law in BUDGET.items():
        size = size_error(restitution, packing_fraction, grains, law.sized_as)
        size = size / np.maximum(
            1 - size, 0.1
        )  # over the average at N grains, which may be the smaller one
        value, stderr = np.asarray(values[name], float), np.asarray(errors[name], float)
        scale = np.abs(value)
        sized = np.abs(value - 1) + 0.03 if name == "force_ratio" else scale
        sampling = HALF_INTERVAL * stderr
        bounds = {
            "timestep": law.timestep * step * scale,
            "size": law.size * size * sized,
            "tolerance": law.tolerance * solve * scale,
        }
        total = np.sqrt(sampling**2 + sum(bound**2 for bound in bounds.values()))
        budget[name] = {"total": total, "sampling": sampling, **bounds}
    return budget
