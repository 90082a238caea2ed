"""The advance over many steps: exact flight, one trajectory by every route, statuses."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flows import EXACT, GRAINS, OF_INSTANTS, assert_same_state, assert_same_tally, flow_of, stacked
from jax.extend.core import jaxprs_in_params
from oracles import gaps_of

from jaxgran.contact.projected_methods import BarzilaiBorwein, Jacobi
from jaxgran.dynamics import jax_engine
from jaxgran.dynamics.jax_engine import advance_by_jax, contact_buffers
from jaxgran.dynamics.snapshots import contacts_now
from jaxgran.dynamics.tally import TABLE
from jaxgran.model.cell import displacement, remap_tilt
from jaxgran.model.grains import Grains
from jaxgran.model.state import State
from jaxgran.model.status import Status

EPS = np.finfo(float).eps
# The same steps in one advance and in two, where contacts are listed and solved in another order
JOINED = {"numba": 1e-7, "jax": 1e-10}
UNCHANGED = {"numba": 0, "jax": 4 * EPS}


def test_grain_flies_straight_in_the_laboratory(engine_run, scene):
    """Over three remaps of the tilt and the boundary, where the image is faster by γ̇L."""
    state = scene([[3.0, 4.0]], [[0.5, 1.7]])
    flow, steps = flow_of(0.02), 3200
    after, tally = engine_run(flow, state, steps)
    time = steps * flow.timestep
    tilt = float(remap_tilt(jnp.asarray(time)))
    travelled = np.array([[3.0 + 0.5 * time, 4.0 + 1.7 * time]])
    missed = displacement(after.positions[:1], jnp.asarray(travelled), after.side, after.tilt)
    np.testing.assert_allclose(missed, 0, atol=1e3 * EPS * float(state.side))
    np.testing.assert_allclose(
        after.velocities[0], [0.5 - travelled[0, 1], 1.7], rtol=0, atol=1e4 * EPS
    )
    np.testing.assert_allclose(after.tilt, tilt, rtol=0, atol=1e4 * EPS)
    assert (tally.steps, tally.solves, tally.impulse, tally.status) == (steps, 0, 0, Status.ok)
    np.testing.assert_allclose(tally.duration, time, rtol=1e3 * EPS)


@pytest.mark.parametrize("packing_fraction", [0.6, 0.75])
@pytest.mark.parametrize("activation", ["midpoint", "touching"])
def test_free_flight_repeats_the_trajectory_of_every_step(
    run, flowing, activation, packing_fraction
):
    flow, state = flow_of(packing_fraction, activation=activation), flowing(packing_fraction)
    (jumped, tally), (stepped, all_steps) = (
        run(flow, state, 100, free_flight) for free_flight in (True, False)
    )
    assert tally.solves > 5
    assert_same_state(jumped, stepped, 1e-10)
    assert_same_tally(tally, all_steps, 1e-10)


def test_jacobi_gives_the_same_trajectory(run, flowing):
    flow, state = flow_of(0.75), flowing(0.75)
    one, tally = run(flow, state, 100)
    assert tally.status == Status.ok and tally.solves > 5
    two, other = run(flow, state, 100, solver=Jacobi(EXACT.tolerance, EXACT.max_steps))
    assert_same_state(one, two, 1e-8)
    assert_same_tally(tally, other, 1e-8, but=("loaded_contacts",))


def test_two_samples_joined_are_the_sample_of_both(engine, engine_run, flowing):
    flow, state = flow_of(), flowing(0.6)
    whole_state, whole = engine_run(flow, state, 100)
    half_state, first = engine_run(flow, state, 40)
    joined_state, second = engine_run(flow, half_state, 60)
    assert_same_state(joined_state, whole_state, JOINED[engine])
    assert_same_tally(first + second, whole, JOINED[engine], but=OF_INSTANTS)


def test_no_steps_change_nothing(engine, engine_run, flowing):
    state = flowing(0.6)
    after, tally = engine_run(flow_of(), state, 0)
    assert_same_state(after, state, UNCHANGED[engine])
    assert all(np.all(getattr(tally, name) == 0) for name in TABLE if name != "momentum_drift")
    assert tally.momentum_drift < 4 * EPS  # that of the state


def test_network_of_a_state_is_that_of_the_overlaps_by_brute_force(run, flowing):
    flow = flow_of(0.75, activation="touching", timestep=5e-3)
    state, _ = run(flow, flowing(0.75), 100)
    network, status = jax.jit(contacts_now)(flow, state)
    assert status == Status.ok
    gaps = gaps_of(state.positions, state.grains.radii, state.side, state.tilt)
    pairs = {
        (min(i, j), max(i, j))
        for i, j in np.stack([network.i, network.j], axis=1)[np.asarray(network.used)]
    }
    assert pairs == set(zip(*np.nonzero(gaps <= 0), strict=True)) and len(pairs) > 3
    depths = state.grains.radii[network.i] + state.grains.radii[network.j] - network.distances
    np.testing.assert_allclose(
        np.sort(depths[network.used]), np.sort(-gaps[gaps <= 0]), atol=64 * EPS
    )


def test_overlaps_are_summed_and_the_deepest_is_kept(engine_run, scene):
    for overlap, deep in ((0.02, 1), (0.005, 0)):
        _, tally = engine_run(
            flow_of(0.02), scene([[5, 5], [6 - overlap, 5]], [[1.0, 0], [-1.0, 0]]), 1
        )
        assert (tally.deep_contacts, tally.contacts, tally.status) == (deep, 1, Status.ok)
        np.testing.assert_allclose(tally.overlap, overlap, rtol=0, atol=8 * EPS)
        np.testing.assert_allclose(tally.largest_overlap, overlap, rtol=0, atol=8 * EPS)


def test_cap_of_iterations_is_reported(engine_run, flowing):
    state, tally = engine_run(
        flow_of(0.75, restitution=0.1), flowing(0.75), 100, BarzilaiBorwein(1e-12, 1)
    )
    assert tally.status == Status.iteration_limit
    assert 0 < tally.unconverged <= tally.solves
    assert np.all(np.isfinite(state.velocities))


def test_grain_too_fast_for_the_lists_is_reported(run, flowing):
    state = flowing(0.6)
    _, tally = run(flow_of(), replace(state, velocities=state.velocities.at[0, 0].add(1e5)), 20)
    assert tally.status >= Status.capacity


def test_pairs_that_the_lists_cannot_hold_are_reported(engine_run, flowing):
    state = flowing(0.6)
    heap = replace(state, positions=2 + 0.1 * state.positions)
    assert np.sum(gaps_of(heap.positions, heap.grains.radii, heap.side, heap.tilt) < 0) > 4 * GRAINS
    _, tally = engine_run(flow_of(), heap, 3, BarzilaiBorwein(1e-12, 100))
    assert tally.status == Status.capacity


@pytest.mark.parametrize("packing_fraction", [0.6, 0.82])
def test_sizes_of_the_contact_buffers_change_no_trajectory(
    run, flowing, monkeypatch, packing_fraction
):
    """More contacts than the largest buffer holds are solved on the list of near pairs."""
    state, flow = flowing(packing_fraction), flow_of(packing_fraction, restitution=0.1)
    expected, tally = run(flow, state, 50)
    monkeypatch.setattr(jax_engine, "contact_buffers", lambda grains: (2,))
    grown, other = jax.jit(advance_by_jax)(flow, EXACT, state, jnp.int32(50))
    assert tally.contacts > 2 * tally.solves or packing_fraction < 0.7
    assert_same_state(grown, expected, 1e-8)
    assert_same_tally(other, tally, 1e-8, but=("loaded_contacts",))


@pytest.mark.parametrize(("field", "bad"), [("positions", np.nan), ("velocities", np.inf)])
def test_state_that_is_not_finite_stops_at_once(engine_run, flowing, field, bad):
    state = flowing(0.6)
    spoilt = replace(state, **{field: getattr(state, field).at[3, 1].set(bad)})
    _, tally = engine_run(flow_of(), spoilt, 2_000_000_000)
    assert tally.status == Status.nonfinite
    assert tally.steps == 0


def equations_of(jaxpr) -> list:
    """All equations of a program, those of its branches and loops included."""
    inner = [each for equation in jaxpr.eqns for each in jaxprs_in_params(equation.params)]
    return [*jaxpr.eqns, *(equation for each in inner for equation in equations_of(each))]


def test_control_flow_of_a_batch_stays_control_flow(flowing):
    """A predicate that differs between replicas would pay for all branches, for all replicas."""
    # the loops over lists and events, and a solve of each size and of all
    least = 3 + len(contact_buffers(GRAINS))
    points = [(0.6, 0.5), (0.75, 0.1), (0.5, 0.9)]
    flows = stacked([flow_of(nu, restitution=alpha) for nu, alpha in points])
    states = stacked([flowing(nu) for nu, _ in points])
    batch = jax.vmap(partial(advance_by_jax, steps=jnp.int32(0)), in_axes=(0, None, 0))
    jaxpr = jax.make_jaxpr(batch)(flows, EXACT, states).jaxpr
    for name in ("cond", "while"):
        equations = [each for each in equations_of(jaxpr) if each.primitive.name == name]
        assert len(equations) >= least
        for equation in equations:
            if name == "cond":
                assert equation.invars[0].aval.shape == ()
            else:  # JAX would reduce a batched predicate once more
                inside = [
                    each.primitive.name
                    for each in equations_of(equation.params["cond_jaxpr"].jaxpr)
                ]
                assert inside[-1] in ("custom_vmap_call", "and")


def test_single_precision_stays_single(flowing):
    flow, state = (jax.tree.map(jnp.float32, tree) for tree in (flow_of(), flowing(0.6)))
    solver = BarzilaiBorwein(jnp.float32(1e-4), jnp.int32(99))
    state, tally = jax.eval_shape(advance_by_jax, flow, solver, state, jnp.int32(3))
    numbers = [
        leaf.dtype
        for leaf in jax.tree.leaves((state, tally))
        if jnp.issubdtype(leaf.dtype, jnp.floating)
    ]
    assert set(numbers) == {jnp.dtype("float32")}


def test_a_cell_narrower_than_two_diameters_is_reported(engine_run):
    """Two images of a disc may then touch the same disc."""
    radii = np.full(GRAINS, 0.05)
    radii[:2] = 3.65
    places = np.stack([0.3 * np.arange(GRAINS) + 0.2, np.full(GRAINS, 9.5)], axis=1)
    places[:2] = [[2.0, 3.0], [7.1, 3.0]]
    grains = Grains(jnp.asarray(radii), jnp.asarray(4 * radii**2))
    state = State(
        grains, jnp.asarray(places), jnp.zeros((GRAINS, 2)), jnp.asarray(10.2), jnp.asarray(0.0)
    )
    _, tally = engine_run(flow_of(0.8, shear_rate=0.0), state, 2)
    assert tally.status >= Status.capacity
