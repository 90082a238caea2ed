"""Flows of ``GRAINS`` grains, engines compiled once for them, and when runs are the same."""

from dataclasses import replace
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgran.contact.delassus import NetworkOperator
from jaxgran.contact.projected_methods import BarzilaiBorwein, ProjectedMethod
from jaxgran.contact.solver import solve
from jaxgran.dynamics.advance import advance
from jaxgran.dynamics.jax_engine import advance_by_jax
from jaxgran.dynamics.tally import INSTANT, TABLE, Tally
from jaxgran.maps import batches
from jaxgran.maps.replica import Replica, ReplicaId
from jaxgran.maps.run import run_replicas
from jaxgran.maps.settings import MapSettings
from jaxgran.model.cell import displacement
from jaxgran.model.flow import ShearFlow
from jaxgran.model.grains import Grains
from jaxgran.model.state import State
from jaxgran.sampling.packing import pack

GRAINS = 32
COUNTS = ("steps", "contacts", "loaded_contacts", "collisions", "solves", "status")

# those of the end of an advance
OF_INSTANTS = tuple(name for name, row in TABLE.items() if row["kind"] == INSTANT)

# Not the same where impulses agree to rounding only: what measures how well a network was solved.
OF_THE_SOLVER = ("worst_residual", "complementarity", "iterations", "momentum_drift", "overlap")


EXACT = BarzilaiBorwein(tolerance=1e-12, max_steps=100_000)  # contacts are solved to rounding


def of_state(flow: ShearFlow, state: State) -> ShearFlow:
    """The flow with the packing fraction of a state, as those of scenes of a few grains."""
    with np.errstate(all="ignore"):
        area = np.pi * np.sum(np.square(state.grains.radii), axis=-1)
        packing_fraction = area / np.square(state.side)
    accepted = np.all((packing_fraction > 0) & (packing_fraction <= 0.83))
    return replace(flow, packing_fraction=packing_fraction) if accepted else flow


def arrays(*trees: Any) -> Any:
    """The same numbers as arrays, for which all calls of a compiled function are one program."""
    return jax.tree.map(np.asarray, trees)


def flow_of(packing_fraction=0.6, **change) -> ShearFlow:
    """A flow of the shared number of grains."""
    numbers = {"restitution": 0.5, "timestep": 1e-3}
    return ShearFlow(GRAINS, packing_fraction=packing_fraction, **{**numbers, **change})


def stacked(trees: list) -> Any:
    """A batch of replicas."""
    return jax.tree.map(lambda *leaves: jnp.stack([jnp.asarray(leaf) for leaf in leaves]), *trees)


def replica(batch: Any, k: int) -> Any:
    """One replica of a batch."""
    return jax.tree.map(lambda leaf: leaf[k], batch)


def assert_same_bits(one: Any, other: Any) -> None:
    jax.tree.map(np.testing.assert_array_equal, one, other)


def assert_same_state(one, two, atol: float):
    """Velocities and tilts agree, and positions up to a lattice vector."""
    moved = displacement(one.positions, two.positions, one.side, one.tilt)
    np.testing.assert_allclose(moved, 0, atol=atol)
    np.testing.assert_allclose(one.velocities, two.velocities, rtol=0, atol=atol)
    np.testing.assert_allclose(one.tilt, two.tilt, rtol=0, atol=atol)


def assert_same_tally(one: Tally, two: Tally, rtol: float, but: tuple[str, ...] = ()):
    """Counts agree exactly, sums to a share of the sum, moments to one of their largest part."""
    for name in COUNTS:
        assert getattr(one, name) == getattr(two, name), name
    for name in set(TABLE) - {*COUNTS, *OF_THE_SOLVER, *but}:
        first, second = np.asarray(getattr(one, name)), np.asarray(getattr(two, name))
        np.testing.assert_allclose(
            first, second, rtol=0, atol=rtol * np.max(np.abs(second)), err_msg=name
        )


def in_batches(size: int, settings: MapSettings, **options: Any) -> dict[ReplicaId, Replica]:
    """The replicas of a map that are run in batches of a given size."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(batches, "batch_size", lambda *_: size)
        ids = batches.replica_ids(settings)
        return {x.id: x for x in run_replicas(settings, ids, **options)}


# Fixtures

ENGINES = ("numba", "jax")


@pytest.fixture(scope="session")
def run():
    """``run(flow, state, steps, free_flight=True, solver=EXACT)``: the compiled engine ``Jax``."""
    compiled = jax.jit(advance_by_jax, static_argnames="free_flight")

    def call(
        flow: ShearFlow,
        state: State,
        steps: int,
        free_flight: bool = True,
        solver: ProjectedMethod = EXACT,
    ):
        numbers = arrays(of_state(flow, state), solver, state, np.int32(steps))
        return jax.block_until_ready(compiled(*numbers, free_flight=free_flight))

    return call


@pytest.fixture(scope="session")
def engines(run):
    """``engines[name](flow, state, steps, solver=EXACT)``: the advance by an engine, compiled."""

    def compiled(advance):
        call = jax.jit(advance)

        def run(flow: ShearFlow, state: State, steps: int, solver: ProjectedMethod = EXACT):
            return jax.block_until_ready(
                call(*arrays(of_state(flow, state), solver, state, np.int32(steps)))
            )

        return run

    return {
        "numba": compiled(
            lambda flow, solver, state, steps: advance(flow, state, steps, solver=solver)
        ),
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
        state, is_packed = compiled(
            ShearFlow(GRAINS, 0.5, packing_fraction, 1e-3), jax.random.key(seed)
        )
        assert is_packed
        return state

    return packing


@pytest.fixture(scope="session")
def flowing(packed, run):
    """``flowing(packing_fraction, seed=0)``: that after a strain of one, without momentum."""

    @cache
    def flow_state(packing_fraction: float, seed: int = 0) -> State:
        state = packed(packing_fraction, seed)
        masses = np.asarray(state.grains.masses)[:, None]
        velocities = np.random.default_rng(seed).normal(size=(GRAINS, 2)) / np.sqrt(masses)
        velocities -= np.sum(masses * velocities, axis=0) / np.sum(masses)
        flow = ShearFlow(GRAINS, 0.7, packing_fraction, 1e-3)
        return run(
            flow, replace(state, velocities=jnp.asarray(velocities)), 1000, solver=BarzilaiBorwein()
        )[0]

    return flow_state


@pytest.fixture(scope="session")
def scene():
    """``scene(positions, velocities, radii=½, side=40)``: a few grains alone; the others are parked
    far away.

    The velocities are those of the laboratory. Parked grains move with the shear, in rows that keep
    clear of y < 20.
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
            grains,
            jnp.asarray(positions),
            jnp.asarray(peculiar),
            jnp.asarray(side, float),
            jnp.asarray(0, float),
        )

    return build


@pytest.fixture(scope="session")
def solved():
    """``solved(network, tolerance, max_steps, method, active)``: the contact solve, compiled."""
    compiled = jax.jit(solve)

    def call(network, tolerance=1e-12, max_steps=100_000, method=BarzilaiBorwein, active=True):
        operator, solver = NetworkOperator(network, 60), method(tolerance, max_steps)
        return compiled(operator, jnp.asarray(1.0), solver, jnp.asarray(active))

    return call
