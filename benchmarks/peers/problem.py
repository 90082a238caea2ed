"""What all peers are given and what they return: a flow, discs at one instant, stresses, and the
law of soft discs.

Units as in jaxgran: lengths in mean diameters, masses in that of a mean disc (m = d²), times in
1/shear rate. Velocities are peculiar, the laboratory's are ``velocity + shear_rate * y`` along x.
The cell has the lattice vectors (side, 0) and (tilt · side, side).
"""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from jaxgran.statistics import standard_errors

SAFETY = 1.2  # factor by which the fastest disc may become faster between two looks at it


class Flow(NamedTuple):
    restitution: float
    packing_fraction: float
    shear_rate: float = 1.0


class Discs(NamedTuple):
    """Positions and peculiar velocities (discs, 2), radii and masses (discs,), side and tilt of the
    cell.
    """

    positions: np.ndarray
    velocities: np.ndarray
    radii: np.ndarray
    masses: np.ndarray
    side: float
    tilt: float


class Stress(NamedTuple):
    """Kinetic and contact stress together, averaged over one advance, and the granular temperature
    and force ratio of programs that know them.
    """

    pressure: float
    shear_stress: float
    granular_temperature: float = math.nan
    force_ratio: float = math.nan


class Run(NamedTuple):
    advance: Callable[[], Stress]  # over the duration that the run was begun with
    discs: Callable[[], Discs]  # as they are now
    close: Callable[[], None] = lambda: None


def averages(runs: Sequence[Sequence[Stress]]) -> dict[str, tuple[float, float]]:
    """Means over the blocks of one or more equally long runs, and their standard errors; without
    what a program does not know.
    """
    blocks = {
        name: np.array([[getattr(stress, name) for stress in run] for run in runs])
        for name in Stress._fields
    }
    blocks["count"] = np.ones((len(runs), len(runs[0])))
    value, error = standard_errors(
        lambda sums: {name: sums[name] / sums["count"] for name in Stress._fields}, blocks
    )
    known = [name for name in Stress._fields if np.isfinite(value[name])]
    return {name: (float(value[name]), float(error[name])) for name in known}


def relative(value: tuple[float, float], right: tuple[float, float]) -> tuple[float, float]:
    """Relative error of a mean, and the standard error of it."""
    return value[0] / right[0] - 1, float(np.hypot(value[1], right[1])) / right[0]


def deepest(discs: Discs) -> float:
    """The largest overlap of two discs, in mean diameters; zero if none touch."""
    d = discs.positions[:, None] - discs.positions[None]
    rows = np.round(d[..., 1] / discs.side)
    dx = d[..., 0] - rows * discs.tilt * discs.side
    dx -= discs.side * np.round(dx / discs.side)
    distance = np.hypot(dx, d[..., 1] - rows * discs.side)
    depth = discs.radii[:, None] + discs.radii[None] - distance
    return max(0.0, float(np.max(depth[np.triu_indices(len(discs.radii), 1)])))


def damping_ratio(restitution: float) -> float:
    """ζ of the damped spring F = kδ − 2ζ√(km) u whose half period takes a velocity u to −αu, for
    any mass.

    A half period of m δ'' + 2ζ√(km) δ' + kδ = 0 multiplies the velocity by −exp(−πζ/√(1−ζ²)), so
    that ζ = 1/√(1 + (π/ln α)²). The force is attractive just before the discs part.
    """
    return 0.0 if restitution == 1 else 1 / math.sqrt(1 + (math.pi / math.log(restitution)) ** 2)


def soft_timestep(
    discs: Discs, restitution: float, stiffness: float, steps_per_contact: int
) -> float:
    """A share of the contact time π√(m/k)/√(1−ζ²) of two of the lightest discs, m their reduced
    mass.
    """
    reduced = discs.masses.min() / 2
    damped = math.sqrt(1 - damping_ratio(restitution) ** 2)
    return math.pi * math.sqrt(reduced / stiffness) / damped / steps_per_contact


def closing_speed(discs: Discs, shear_rate: float) -> float:
    """A bound on the speed at which a gap closes: two of the fastest discs, and the shear across
    them.
    """
    fastest = SAFETY * np.sqrt(np.max(np.sum(discs.velocities**2, axis=-1)))
    return float(2 * fastest + 2 * shear_rate * discs.radii.max())
