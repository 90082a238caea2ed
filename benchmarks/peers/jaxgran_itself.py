"""jaxgran as a peer of the others: several time steps at the default tolerance, several tolerances
at one time step, the engine in JAX alone and for a batch, and the plain projected Jacobi method;
midpoint rule.
"""

import jax
import jax.numpy as jnp
import numpy as np

import jaxgran as jg
from benchmarks.peers.problem import Discs, Flow, Run, Stress
from jaxgran.model.grains import Grains

TIMESTEPS = (1e-2, 3e-3, 1e-3, 3e-4, 1e-4)
TOLERANCES = (1e-1, 1e-2, 1e-3, 1e-6)
BY_TOLERANCE, BY_JAX, BATCH = "jaxgran by tolerance", "JAX engine", "JAX engine, 16 flows"
JACOBI = "projected Jacobi"
FLOWS = 16  # of the batch
CURVES = {"jaxgran": TIMESTEPS, BY_TOLERANCE: TOLERANCES, BY_JAX: TIMESTEPS}
CURVES |= {BATCH: (1e-3,), JACOBI: TIMESTEPS}
DEFAULT_TOLERANCE, MIDDLE_TIMESTEP = 1e-4, 1e-3


def missing() -> str | None:
    return None


def begin(discs: Discs, flow: Flow, curve: str, setting: float, duration: float) -> Run:
    """A run at one time step or tolerance.

    The flows of the batch begin at different times of one flow, and together last as long as the
    one flow of the other curves.
    """
    by_tolerance = MIDDLE_TIMESTEP, setting
    timestep, tolerance = by_tolerance if curve == BY_TOLERANCE else (setting, DEFAULT_TOLERANCE)
    where = flow.restitution, flow.packing_fraction
    law = jg.ShearFlow(len(discs.radii), *where, timestep, shear_rate=flow.shear_rate)
    solver = jg.Jacobi(tolerance) if curve == JACOBI else jg.BarzilaiBorwein(tolerance)
    engine = jg.Jax() if curve in (BY_JAX, BATCH) else None
    strain = duration * flow.shear_rate
    state = state_of(discs)
    if curve == BATCH:
        strain /= FLOWS
        states = [state]
        for _ in range(FLOWS - 1):
            states.append(jg.sample(law, states[-1], 0.5, blocks=1)[0])
        state = jax.tree.map(lambda *x: jnp.stack(x), *states)

    def one(state: jg.State):
        return jg.sample(law, state, strain, blocks=1, solver=solver, engine=engine)

    sampled = jax.jit(jax.vmap(one)) if curve == BATCH else one

    def advance() -> Stress:
        nonlocal state
        state, sample = jax.block_until_ready(sampled(state))
        averages = jax.tree.map(np.asarray, sample).averages
        return Stress(*(float(np.mean(averages[name])) for name in Stress._fields))

    return Run(advance, lambda: discs_of(state[0] if curve == BATCH else state))


def state_of(discs: Discs) -> jg.State:
    """A state of jaxgran; without weak types, or a second call would compile again."""
    grains = Grains(jnp.asarray(discs.radii), jnp.asarray(discs.masses))
    plain = discs.positions, discs.velocities, discs.side, discs.tilt
    arrays = (np.asarray(x, float) for x in plain)
    return jg.State(grains, *map(jnp.asarray, arrays))


def discs_of(state: jg.State) -> Discs:
    """The discs of a state of jaxgran."""
    arrays = (state.positions, state.velocities, state.grains.radii, state.grains.masses)
    return Discs(*(np.array(x) for x in arrays), float(state.side), float(state.tilt))
