"""jaxgran as a peer of the others: several time steps at the default tolerance, and several
tolerances at one time step; midpoint rule.
"""

import jax
import jax.numpy as jnp
import numpy as np

import jaxgran as jg
from benchmarks.peers.problem import Discs, Flow, Run, Stress
from jaxgran.model.grains import Grains

TIMESTEPS = (1e-2, 3e-3, 1e-3, 3e-4, 1e-4)
TOLERANCES = (1e-1, 1e-2, 1e-3, 1e-6)
BY_TOLERANCE = "jaxgran by tolerance"
CURVES = {"jaxgran": TIMESTEPS, BY_TOLERANCE: TOLERANCES}
DEFAULT_TOLERANCE, MIDDLE_TIMESTEP = 1e-4, 1e-3


def missing() -> str | None:
    return None


def begin(discs: Discs, flow: Flow, curve: str, setting: float, duration: float) -> Run:
    """A run at one time step or tolerance."""
    timestep, tolerance = (
        (MIDDLE_TIMESTEP, setting) if curve == BY_TOLERANCE else (setting, DEFAULT_TOLERANCE)
    )
    law = jg.ShearFlow(
        grains=len(discs.radii),
        restitution=flow.restitution,
        packing_fraction=flow.packing_fraction,
        timestep=timestep,
        shear_rate=flow.shear_rate,
    )
    solver, strain = jg.BarzilaiBorwein(tolerance), duration * flow.shear_rate
    grains = Grains(jnp.asarray(discs.radii), jnp.asarray(discs.masses))
    arrays = (
        np.asarray(x, float) for x in (discs.positions, discs.velocities, discs.side, discs.tilt)
    )
    state = jg.State(
        grains, *map(jnp.asarray, arrays)
    )  # no weak types, or the second call would compile again

    def advance() -> Stress:
        nonlocal state
        state, sample = jax.block_until_ready(
            jg.sample(law, state, strain, blocks=1, solver=solver)
        )
        sample = jax.tree.map(np.asarray, sample)
        return Stress(*(float(sample.averages[name]) for name in Stress._fields))

    return Run(advance, lambda: discs_of(state))


def discs_of(state: jg.State) -> Discs:
    """The discs of a state of jaxgran."""
    arrays = (state.positions, state.velocities, state.grains.radii, state.grains.masses)
    return Discs(*(np.array(x) for x in arrays), float(state.side), float(state.tilt))
