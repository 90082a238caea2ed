"""The loop of ``independent.contact_dynamics`` as a peer: same time step and law as jaxgran, no
code in common.

The loop looks at every time step, but only at the parabola of each near pair's separation, and
refreshes the pairs of discs that were hit alone. It has no simpler way than that, and none that
leaves steps out.
"""

from benchmarks.independent import contact_dynamics
from benchmarks.peers.problem import Discs, Flow, Run, Stress

TIMESTEPS = (1e-2, 3e-3, 1e-3, 3e-4, 1e-4)
CURVES = {"numba loop": TIMESTEPS}
TOLERANCES = {"numba loop": 1e-4, "reference": 1e-6}
MIDPOINT = 0.5


def missing() -> None:
    """Nothing: jaxgran requires numba."""


def begin(discs: Discs, flow: Flow, curve: str, timestep: float, duration: float) -> Run:
    """A run at one time step; ``curve`` names the tolerance."""
    now = discs._replace(positions=discs.positions.copy(), velocities=discs.velocities.copy())

    def advance() -> Stress:
        nonlocal now
        positions, velocities, tilt, tally = contact_dynamics.advance(
            **now._asdict(),
            shear_rate=flow.shear_rate,
            restitution=flow.restitution,
            timestep=timestep,
            activation=MIDPOINT,
            tolerance=TOLERANCES[curve],
            steps=round(duration / timestep),
        )
        now = now._replace(positions=positions, velocities=velocities, tilt=float(tilt))
        averages = (tally.pressure, tally.shear_stress, tally.temperature, tally.force_ratio)
        return Stress(*map(float, averages))

    return Run(advance, lambda: now)
