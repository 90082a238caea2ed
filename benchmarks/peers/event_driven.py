"""The event-driven program of ``independent.event_driven`` as a peer: no time step and no overlap.

Inelastic hard discs have no setting; they collapse where grains push in chains, and it says so.
With a duration of contact, the TC model, no collapse lasts.
"""

import numpy as np

from benchmarks.independent.event_driven import Discs as HardDiscs
from benchmarks.independent.event_driven import Law, averages, sheared
from benchmarks.peers.problem import Discs, Flow, Run, Stress

# The setting is the duration of a contact, in 1/γ̇
CURVES = {"event-driven": (0.0,), "TC model": (1e-3, 3e-4, 1e-4, 3e-5, 1e-5)}
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
