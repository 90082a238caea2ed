"""The event-driven program of ``independent.event_driven`` as a peer: no time step and no overlap,
so a single setting. Inelastic hard discs collapse where grains push in chains, and it says so.
"""

import numpy as np

from benchmarks.independent.event_driven import Discs as HardDiscs
from benchmarks.independent.event_driven import Law, averages, sheared
from benchmarks.peers.problem import Discs, Flow, Run, Stress

CURVES = {"event-driven": (0.0,)}  # the setting is the duration of a contact
MOST_COLLISIONS = (
    2000.0  # of a disc in a unit of strain, twenty times those of flows that do not collapse
)


def missing() -> None:
    """Nothing: jaxgran requires numba."""


def begin(discs: Discs, flow: Flow, curve: str, contact_duration: float, duration: float) -> Run:
    """A run of hard discs, whose last collisions are forgotten."""
    never = np.full(len(discs.radii), -np.inf)
    now = HardDiscs(
        discs.radii, discs.masses, discs.positions, discs.velocities, never, discs.side, discs.tilt
    )
    law = Law(flow.restitution, contact_duration, flow.shear_rate)
    most = int(MOST_COLLISIONS * len(discs.radii) * max(1.0, duration * flow.shear_rate))

    def advance() -> Stress:
        nonlocal now
        now, sums = sheared(now, law, duration, most_collisions=most)
        values = averages(sums, now)
        return Stress(*(values[name].item() for name in Stress._fields if name in values))

    def current() -> Discs:
        return Discs(**{name: getattr(now, name) for name in Discs._fields})

    return Run(advance, current)
