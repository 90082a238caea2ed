"""Tests run in float64 with strict promotion, so that no precision or rank changes unnoticed.

The compiled functions of the engine are shared by all tests: one number of grains, one compilation of each. What is
compiled is kept in a folder of the run, for the processes that share its tests and for those that they start. Most of
the time of a run is compilation, so XLA leaves out optimising machine code. With ``XLA_FLAGS`` of one's own,
``--xla_backend_optimization_level=3``, the tests run what users have.
"""

import os
import shutil
import tempfile
from dataclasses import replace
from functools import cache
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

FIRST_PROCESS = "PYTEST_XDIST_WORKER" not in os.environ
if FIRST_PROCESS:
    os.environ["XDG_CACHE_HOME"] = tempfile.mkdtemp(prefix="jaxgran-tests-")
os.environ.setdefault("XLA_FLAGS", "--xla_backend_optimization_level=0")
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # as the command line does, and why
CACHE = Path(os.environ["XDG_CACHE_HOME"])

jax.config.update("jax_compilation_cache_dir", str(CACHE / "compiled"))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.3)
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")

from jaxgran.contact.solver import solve  # noqa: E402
from jaxgran.dynamics.plain import advance  # noqa: E402
from jaxgran.model.flow import ShearFlow  # noqa: E402
from jaxgran.model.grains import Grains  # noqa: E402
from jaxgran.model.state import State  # noqa: E402
from jaxgran.sampling.packing import pack  # noqa: E402

GRAINS = 32


def pytest_configure():
    """``pytest.GRAINS`` is the number of grains that the shared compiled functions are for."""
    pytest.GRAINS = GRAINS


def pytest_unconfigure():
    """The folder of compiled programs goes with the run."""
    if FIRST_PROCESS:
        shutil.rmtree(CACHE, ignore_errors=True)


class Compiled:
    """A function compiled once per shape and static choice, that counts how often it is traced."""

    def __init__(self, function, static=()):
        self.traces = 0
        self._function = function
        self._call = jax.jit(self._traced, static_argnums=static)

    def _traced(self, *arguments):
        self.traces += 1
        return self._function(*arguments)

    def __call__(self, *arguments):
        return jax.block_until_ready(self._call(*arguments))


@pytest.fixture(scope="session")
def run():
    """``run(flow, state, steps, free_flight=True)``: advance, compiled; ``run.compiled.traces`` counts the traces."""
    compiled = Compiled(advance, static=3)

    def call(flow: ShearFlow, state: State, steps: int, free_flight: bool = True):
        return compiled(flow, state, jnp.int32(steps), free_flight)

    call.compiled = compiled
    return call


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
