"""What tests share: the set-up of JAX, functions of the engine that are compiled once, and flows.

Tests run in float64 with strict promotion, so that no precision or rank changes unnoticed. One number of grains needs
one compilation of each function; ``pytest.GRAINS`` is that number.
"""

from dataclasses import replace
from functools import cache, partial

import compiled_programs
import hypothesis
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgran.contact.solver import solve
from jaxgran.dynamics import advance as public
from jaxgran.dynamics.jax_engine import advance
from jaxgran.dynamics.pallas_engine import kernel
from jaxgran.model.flow import ShearFlow
from jaxgran.model.grains import Grains
from jaxgran.model.state import State
from jaxgran.sampling.packing import pack

compiled_programs.configure_jax()
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")

hypothesis.settings.register_profile("tests", deadline=None, derandomize=True)  # the same examples at any speed
hypothesis.settings.load_profile("tests")

GRAINS = 32
ENGINES = ("numba", "pallas", "jax")
pytest.GRAINS = GRAINS


class Compiled:
    """A function compiled once per shape, and optimised, that counts how often it is traced."""

    def __init__(self, function):
        self.traces = 0
        self._function = function
        self._call = compiled_programs.optimised(self._traced)

    def _traced(self, *arguments):
        self.traces += 1
        return self._function(*arguments)

    def __call__(self, *arguments):
        return jax.block_until_ready(self._call(*arguments))


@pytest.fixture(scope="session")
def run():
    """``run(flow, state, steps, free_flight=True)``: advance, compiled; ``run.compiled.traces`` counts the traces."""
    compiled = Compiled(advance)

    def call(flow: ShearFlow, state: State, steps: int, free_flight: bool = True):
        return compiled(flow, state, jnp.int32(steps), jnp.asarray(free_flight))

    call.compiled = compiled
    return call


@pytest.fixture(scope="session")
def engines(run):
    """``engines[name](flow, state, steps)``: the advance by an engine, compiled; the thread block is interpreted."""

    def compiled(advance, jit=jax.jit):
        call = jit(advance)
        return lambda flow, state, steps: jax.block_until_ready(call(flow, state, jnp.int32(steps)))

    interpreted = partial(kernel.advance, interpret=True)
    return {
        "numba": compiled(public.advance),
        "pallas": compiled(interpreted, compiled_programs.optimised),
        "jax": run,
    }


@pytest.fixture(scope="session", params=ENGINES)
def engine(request) -> str:
    """A law that asks for it holds for every engine."""
    return request.param


@pytest.fixture(scope="session")
def engine_run(engine, engines):
    """``engine_run(flow, state, steps)``: the advance by each engine in turn."""
    return engines[engine]


@pytest.fixture(scope="session")
def packed():
    """``packed(packing_fraction, seed=0)``: a packing at rest."""
    compiled = compiled_programs.optimised(pack)

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
        return run(flow, replace(state, velocities=jnp.asarray(velocities)), 1000)[0]

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
    """``solved(network, tolerance, max_iterations, method, active, relaxation)``: the contact solve, compiled."""
    compiled = jax.jit(solve, static_argnums=(1, 6))

    def call(network, tolerance=1e-12, max_iterations=100_000, method="barzilai-borwein", active=True, relaxation=1.8):
        numbers = jnp.asarray(1.0), jnp.asarray(tolerance), jnp.asarray(max_iterations), jnp.asarray(relaxation)
        return compiled(network, 60, *numbers, method, jnp.asarray(active))

    return call
