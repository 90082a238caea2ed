"""Snapshots are the flow: their forces are those of the next step, and change nothing."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flows import EXACT, GRAINS
from oracles import nearest_image
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from jaxgran.dynamics.snapshot import collided, free_flight
from jaxgran.dynamics.snapshots import snapshot, snapshot_series
from jaxgran.model.cell import displacement
from jaxgran.model.flow import ShearFlow
from jaxgran.model.status import Status


@pytest.fixture(scope="module")
def flow() -> ShearFlow:
    return ShearFlow(GRAINS, 0.3, 0.78, 1e-3)


@pytest.fixture(scope="module")
def series(flow, flowing):
    return snapshot_series(flow, flowing(0.78), 0.05, 5, solver=EXACT)


def assert_same_flow(one, other, tolerance: float) -> None:
    """Velocities agree, and positions up to a lattice vector."""
    apart = displacement(one.positions, other.positions, one.side, one.tilt)
    np.testing.assert_allclose(apart, 0, atol=tolerance)
    np.testing.assert_allclose(one.velocities, other.velocities, atol=tolerance)
    np.testing.assert_allclose(one.tilt, other.tilt, atol=tolerance)


def test_collision_and_flight_are_the_two_halves_of_a_step(flow, flowing, run) -> None:
    state, loaded = flowing(0.78), 0
    one_snapshot = jax.jit(snapshot)
    for _ in range(40):
        seen = one_snapshot(flow, state, EXACT)
        loaded += int(jnp.sum(seen.impulses > 0))
        by_halves = free_flight(collided(seen), flow.shear_rate, flow.timestep)
        state, _ = run(flow, state, 1)
        assert_same_flow(by_halves, state, 1e-12)
    assert loaded > 20  # so that there was something to compare


def test_taking_snapshots_changes_nothing(flow, flowing, run, series) -> None:
    end, seen = series
    state = flowing(0.78)
    for k in range(5):
        state, _ = run(flow, state, 10)
        now = jax.tree.map(lambda x, k=k: x[k], seen)
        assert_same_flow(now.state, state, 1e-9)
    assert_same_flow(end, state, 1e-9)
    assert np.all(np.asarray(seen.status) == 0)


def test_sums_over_the_snapshots_of_every_step_are_those_of_the_tally(flow, flowing, run) -> None:
    """Of all contacts, and of those in clusters, which the tally finds without a walk."""
    state, steps = flowing(0.78), 40
    _, tally = run(flow, state, steps)
    one_snapshot, contact, clustered = jax.jit(snapshot), np.zeros((2, 2)), np.zeros((2, 2))
    for _ in range(steps):
        seen = one_snapshot(flow, state, EXACT)
        loaded = np.flatnonzero(np.asarray(seen.impulses) > 0)
        i, j = (np.asarray(x)[loaded] for x in (seen.contacts.i, seen.contacts.j))
        normals, distances = (
            np.asarray(x)[loaded] for x in (seen.contacts.normals, seen.contacts.distances)
        )
        sizes = (np.asarray(seen.impulses)[loaded] * distances)[:, None, None]
        moments = sizes * normals[:, :, None] * normals[:, None]
        _, cluster = connected_components(
            coo_array((np.ones(len(i)), (i, j)), shape=(GRAINS, GRAINS)), directed=False
        )
        contact += moments.sum(axis=0)
        clustered += moments[np.bincount(cluster)[cluster[i]] >= 3].sum(axis=0)
        state, _ = run(flow, state, 1)
    assert 0 < np.trace(clustered) < np.trace(contact)
    np.testing.assert_allclose(tally.contact_moment, contact, rtol=1e-9)
    np.testing.assert_allclose(tally.cluster_moment, clustered, rtol=1e-9)


def test_forces_push_and_add_nothing_to_the_momentum(series) -> None:
    _, seen = series
    assert np.all(np.asarray(seen.impulses) >= 0)
    masses = np.asarray(seen.state.grains.masses)
    before = np.sum(masses[..., None] * np.asarray(seen.state.velocities), axis=1)
    after = np.sum(masses[..., None] * np.asarray(jax.vmap(collided)(seen).velocities), axis=1)
    np.testing.assert_allclose(after, before, atol=1e-12)


def test_flight_there_and_back_is_where_it_started(flow, flowing) -> None:
    state = flowing(0.78)
    assert_same_flow(free_flight(free_flight(state, 1.0, 0.7), 1.0, -0.7), replace(state), 1e-12)


@pytest.mark.parametrize(
    ("packing_fraction", "temperature", "timestep"), [(0.3, 250.0, 0.05), (0.1, 2000.0, 0.1)]
)
def test_a_fast_coarse_flow_has_all_its_contacts_or_says_that_some_may_be_missing(
    packed, packing_fraction, temperature, timestep
) -> None:
    """A step looks θ·dt ahead, which may be further than the lists of pairs reach."""
    still, statuses = packed(packing_fraction), []
    flow = ShearFlow(GRAINS, 0.5, packing_fraction, timestep)
    for seed in range(10):
        velocities = np.random.default_rng(seed).normal(size=(GRAINS, 2)) * np.sqrt(temperature)
        state = replace(still, velocities=jnp.asarray(velocities))
        seen = jax.jit(snapshot)(flow, state, EXACT)
        i, j = np.triu_indices(GRAINS, 1)
        positions, radii = np.asarray(state.positions), np.asarray(state.grains.radii)
        s = nearest_image(positions[i] - positions[j], float(state.side), float(state.tilt))
        u = velocities[i] - velocities[j] + np.stack([s[:, 1], 0 * s[:, 1]], axis=1)
        closing, speed = np.sum(s * u, axis=1), np.sum(u * u, axis=1)
        time = np.where(closing < 0, np.minimum(-closing / speed, timestep / 2), timestep / 2)
        meets = np.sum((s + time[:, None] * u) ** 2, axis=1) <= (radii[i] + radii[j]) ** 2
        statuses.append(int(seen.status))
        if seen.status < Status.infeasible:
            assert np.sum(seen.contacts.used) == np.sum(meets)
    assert (min(statuses) == Status.ok) == (temperature < 1000)
