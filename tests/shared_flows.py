"""Fixtures: flows of ``GRAINS`` grains, and functions of the engines that are compiled once for them."""

from dataclasses import replace
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flows import EXACT, GRAINS

from jaxgran.contact.projected_methods import BarzilaiBorwein, ProjectedMethod
from jaxgran.contact.solver import solve
from jaxgran.dynamics.advance import advance
from jaxgran.dynamics.jax_engine import advance_by_jax
from jaxgran.dynamics.pallas_engine import kernel
from jaxgran.model.flow import ShearFlow
from jaxgran.model.grains import Grains
from jaxgran.model.state import State
from jaxgran.sampling.packing import pack

ENGINES = ("numba", "pallas", "jax")


@pytest.fixture(scope="session")
def run():
    """``run(flow, state, steps, free_flight=True, solver=EXACT)``: the advance by JAX alone, compiled."""
    compiled = jax.jit(advance_by_jax)

    def call(flow: ShearFlow, state: State, steps: int, free_flight: bool = True, solver: ProjectedMethod = EXACT):
        return jax.block_until_ready(compiled(flow, solver, state, jnp.int32(steps), jnp.asarray(free_flight)))

    return call


@pytest.fixture(scope="session")
def engines(run):
    """``engines[name](flow, state, steps, solver=EXACT)``: the advance by an engine, compiled; pallas interpreted."""

    def compiled(advance):
        call = jax.jit(advance)

        def run(flow: ShearFlow, state: State, steps: int, solver: ProjectedMethod = EXACT):
            return jax.block_until_ready(call(flow, solver, state, jnp.int32(steps)))

        return run

    interpreted = partial(kernel.advance_by_pallas, interpret=True)
    return {
        "numba": compiled(lambda flow, solver, state, steps: advance(flow, state, steps, solver=solver)),
        "pallas": compiled(interpreted),
        "jax": lambda flow, state, steps, solver=EXACT: run(flow, state, steps, solver=solver),
    }


@pytest.fixture(scope="session", params=ENGINES)
def engine(request) -> str:
    """A law that asks for it holds for every engine."""
    return request.param


@pytest.fixture(scope="session")
def engine_run(engine, engines):
    """``engine_run(flow, state, steps, solver=EXACT)``: the advance by each engine in turn."""
    return engines[engine]


@pytest.fixture(scope="session")
def packed():
    """``packed(packing_fraction, seed=0)``: a packing at rest."""
    compiled = jax.jit(pack)

    @cache
    def packing(packing_fraction: float, seed: int = 0) -> State:
        state, found = compiled(ShearFlow(GRAINS, 0.5, packing_fraction, 1e-3), jax.random.key(seed))
        assert found
        return state

    return packing


@pytest.fixture(scope="session")
def flowing(packed, run):
    """``flowing(packing_fraction, seed=0)``: the same after a strain of one, with zero total momentum."""

    @cache
    def flow_state(packing_fraction: float, seed: int = 0) -> State:
        state = packed(packing_fraction, seed)
        masses = np.asarray(state.grains.masses)[:, None]
        velocities = np.random.default_rng(seed).normal(size=(GRAINS, 2)) / np.sqrt(masses)
        velocities -= np.sum(masses * velocities, axis=0) / np.sum(masses)
        flow = ShearFlow(GRAINS, 0.7, packing_fraction, 1e-3)
        return run(flow, replace(state, velocities=jnp.asarray(velocities)), 1000, solver=BarzilaiBorwein())[0]

    return flow_state


@pytest.fixture(scope="session")
def scene():
    """``scene(positions, velocities, radii=½, side=40)``: a few grains alone; the others are parked far away.

    The velocities are those of the laboratory. Parked grains move with the shear, in rows that keep clear of y < 20.
    """

    def build(positions, velocities, radii=0.5, side: float = 40.0) -> State:
        few = len(positions)
        row = np.arange(GRAINS - few)
        places = np.stack([2.0 + 3 * (row % 12), 24.0 + 4 * (row // 12)], axis=-1)
        positions = np.concatenate([np.asarray(positions, float), places])
        peculiar = np.zeros((GRAINS, 2))
        peculiar[:few] = velocities
        peculiar[:few, 0] -= positions[:few, 1]  # shear rate one
        every = np.full(GRAINS, 0.5)
        every[:few] = radii
        grains = Grains(jnp.asarray(every), jnp.asarray(4 * every**2))
        return State(
            grains, jnp.asarray(positions), jnp.asarray(peculiar), jnp.asarray(side, float), jnp.asarray(0, float)
        )

    return build


@pytest.fixture(scope="session")
def solved():
    """``solved(network, tolerance, max_steps, method, active)``: the contact solve, compiled."""
    compiled = jax.jit(solve, static_argnums=1)

    def call(network, tolerance=1e-12, max_steps=100_000, method=BarzilaiBorwein, active=True):
        return compiled(network, 60, jnp.asarray(1.0), method(tolerance, max_steps), jnp.asarray(active))

    return call
