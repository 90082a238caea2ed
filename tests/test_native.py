"""The numba engine is the plain advance: same contacts, same impulses, same sums, same failures."""

import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numba
import numpy as np
import pytest
from flows import (
    COUNTS,
    EXACT,
    GRAINS,
    assert_same_bits,
    assert_same_state,
    flow_of,
    of_state,
    replica,
    stacked,
)
from fuzz_driver import GIVEN, of_numbers
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from jaxgran.contact.projected_methods import BarzilaiBorwein
from jaxgran.dynamics import advance as advance_module
from jaxgran.dynamics import jax_engine, step
from jaxgran.dynamics.engine import Jax, Numba, engine_named
from jaxgran.dynamics.numba_engine import arrays, cluster_solver
from jaxgran.dynamics.numba_engine.ffi import engine_folder
from jaxgran.dynamics.numba_engine.near_pairs import LIFE, closing_speed_bound, find_near_pairs
from jaxgran.dynamics.tally import TABLE
from jaxgran.model.flow import ShearFlow
from jaxgran.model.grains import Grains
from jaxgran.model.state import State
from jaxgran.model.status import Status

LOOSE = BarzilaiBorwein(1e-6, 10**6)
LOOK_AHEAD = 0.05  # strain, of the longest time step


@pytest.fixture(scope="module")
def native_run(engines):
    return engines["numba"]


def state_of(positions, velocities, side, tilt=0.0, radii=0.5, masses=1.0) -> State:
    """A state of any numbers; those of a grain are the same for all, or one for each."""
    of_grains = (np.broadcast_to(x, len(positions)) for x in (radii, masses))
    numbers = (jnp.asarray(x, float) for x in (positions, velocities, side, tilt))
    return State(Grains(*(jnp.asarray(x, float) for x in of_grains)), *numbers)


def assert_same(ours, plain, atol: float) -> None:
    (state, tally), (expected, sums) = ours, plain
    strain = float(state.tilt - expected.tilt)
    assert abs(strain - round(strain)) < 1e-9
    assert_same_state(replace(state, tilt=expected.tilt), expected, atol)
    for name in (*COUNTS, "unconverged"):
        assert getattr(tally, name) == getattr(sums, name), name
    for name in TABLE:
        if name not in (*COUNTS, "unconverged", "iterations", "worst_residual", "momentum_drift"):
            expected_value = np.asarray(getattr(sums, name))
            np.testing.assert_allclose(
                getattr(tally, name), expected_value, rtol=1e-6, atol=1e-9 + atol, err_msg=name
            )


@pytest.mark.parametrize(
    ("packing_fraction", "steps", "activation", "shear_rate"),
    [
        (0.4, 400, "midpoint", 1.0),
        (0.6, 100, "touching", 0.0),
        (0.78, 100, "midpoint", 1.0),
        (0.78, 100, "touching", 0.0),
    ],
)
def test_trajectory_and_sums_are_those_of_the_plain_advance(
    flowing, run, native_run, packing_fraction, steps, activation, shear_rate
) -> None:
    state = flowing(packing_fraction)
    flow = flow_of(packing_fraction, activation=activation, shear_rate=shear_rate)
    ours, plain = native_run(flow, state, steps), run(flow, state, steps)
    assert ours[1].solves > 5
    assert_same(ours, plain, 1e-6)


@pytest.mark.parametrize(("rows", "steps"), [(10, 200), (25, 15)])
def test_flows_of_more_grains_are_those_of_the_plain_advance(run, native_run, rows, steps) -> None:
    """100 grains past a remap of the tilt, with several clusters in a step, each within the
    tolerance; and 625, whose pairs are found by jax-md.
    """
    rng, count = np.random.default_rng(rows), rows * rows
    radii, velocities = rng.uniform(0.45, 0.55, count), rng.normal(size=(count, 2))
    velocities -= np.average(velocities, axis=0, weights=radii**2)
    places = 1.11 * np.stack(np.divmod(np.arange(count), rows), axis=-1) + 0.1
    state = state_of(places, velocities, 1.11 * rows, 0.4, radii, 4 * radii**2)
    flow = of_state(ShearFlow(count, 0.5, 0.6, 5e-3), state)
    ours, plain = native_run(flow, state, steps), run(flow, state, steps)
    assert ours[1].status == Status.ok
    assert ours[1].collisions > count / 5 and np.trace(ours[1].cluster_moment) > 0
    assert max(ours[1].worst_residual, plain[1].worst_residual) <= EXACT.tolerance
    assert_same(ours, plain, 1e-6)


@settings(max_examples=30)
@given(
    packing_fraction=st.sampled_from([0.1, 0.4, 0.7, 0.8]),
    restitution=st.floats(0, 1),
    timestep=st.floats(-6, -2).map(lambda x: 10**x),
    speed=st.floats(0, 20),
    tilt=st.floats(-0.5, 0.49),
    seed=st.integers(0, 10**6),
)
@example(packing_fraction=0.8, restitution=0.0, timestep=1e-3, speed=0.0, tilt=0.0, seed=0)
def test_any_flow_takes_its_first_events_as_in_the_plain_advance(
    packed, run, native_run, packing_fraction, restitution, timestep, speed, tilt, seed
) -> None:
    still = packed(packing_fraction)
    velocities = speed * np.random.default_rng(seed).normal(size=(GRAINS, 2))
    state = replace(still, velocities=jnp.asarray(velocities))
    if tilt:  # a packing in another cell overlaps here and there: overlaps are contacts like others
        state = replace(state, tilt=jnp.asarray(tilt, float))
    flow = flow_of(packing_fraction, restitution=restitution, timestep=timestep)
    ours, plain = native_run(flow, state, 5), run(flow, state, 5)
    # its lists are narrower: the numba engine may still hold such a flow
    assume(plain[1].status < Status.capacity)
    assert ours[1].status == plain[1].status
    if plain[1].status < Status.infeasible:
        assert_same(ours, plain, 1e-6 * max(1, speed))


@pytest.mark.parametrize(
    "rows", [10, 50]
)  # 100 grains, and more than the numba engine takes as they come
def test_results_do_not_depend_on_the_order_of_the_grains(rows) -> None:
    rng, count = np.random.default_rng(rows), rows * rows
    radii = rng.uniform(0.37, 0.63, count)
    places = 1.5 * np.stack(np.divmod(np.arange(count), rows), axis=-1) + 0.1
    velocities = 3 * rng.normal(size=(count, 2))
    state = state_of(places, velocities, 1.5 * rows, radii=radii, masses=4 * radii**2)
    flow = of_state(ShearFlow(count, 0.9, 0.4, 1e-3), state)
    advance = jax.jit(partial(advance_module.advance, solver=EXACT))
    shuffled = rng.permutation(count)
    after, tally = advance(flow, state, jnp.int32(100))
    other, sums = advance(
        flow, jax.tree.map(lambda x: x[shuffled] if x.ndim else x, state), jnp.int32(100)
    )
    assert tally.collisions > count / 10
    np.testing.assert_allclose(after.velocities[shuffled], other.velocities, atol=1e-6)
    np.testing.assert_allclose(tally.contact_moment, sums.contact_moment, rtol=1e-6)


def test_a_row_around_the_cell_comes_to_rest(native_run) -> None:
    """Grains in a closed row can only stand still, whatever drives them together."""
    places = np.stack([np.arange(GRAINS) + 0.5, np.full(GRAINS, GRAINS / 2)], axis=-1)
    velocities = np.zeros((GRAINS, 2))
    velocities[:, 0] = -0.1 * np.sin(2 * np.pi * np.arange(GRAINS) / GRAINS)
    state = state_of(places, velocities, GRAINS, radii=0.5 * (1 + 1e-3))
    after, tally = native_run(
        flow_of(0.7, restitution=0.0, shear_rate=0.0), state, 1, BarzilaiBorwein(1e-6)
    )
    assert tally.status == Status.ok and tally.loaded_contacts >= GRAINS / 2
    np.testing.assert_allclose(after.velocities, 0, atol=1e-5)


@pytest.mark.parametrize("heaviest", [1.0, 1e4])
def test_stiff_clusters_are_solved_as_by_the_plain_advance(run, native_run, heaviest) -> None:
    """A grain hits a long row, light and heavy in turn: sweeps alone would take thousands."""
    gap = 1e-9
    places = np.stack([2 + np.arange(GRAINS) * (1 - gap), np.full(GRAINS, 30.0)], axis=-1)
    velocities = np.zeros((GRAINS, 2))
    velocities[0, 0] = 1.0
    masses = np.where(np.arange(GRAINS) % 2, heaviest, 1.0)
    state = state_of(places, velocities, 60.0, masses=masses)
    flow, solver = flow_of(0.01, restitution=0.0, shear_rate=0.0), BarzilaiBorwein(1e-9, 10**6)
    ours, plain = native_run(flow, state, 1, solver), run(flow, state, 1, solver=solver)
    assert ours[1].status == plain[1].status == Status.ok
    assert ours[1].iterations > cluster_solver.SWEEPS
    np.testing.assert_allclose(ours[0].velocities, plain[0].velocities, atol=1e-7)
    np.testing.assert_allclose(ours[1].impulse, plain[1].impulse, rtol=1e-5)


@pytest.mark.parametrize("tolerance", [1e-3, 1e-5, 1e-7])
def test_copies_of_a_cluster_are_solved_as_one_within_the_tolerance(native_run, tolerance) -> None:
    """Each has its share of the permitted residual, which grows with the copies: the first takes
    the iterations that it takes alone, and the others no more.
    """
    column, row = np.arange(GRAINS) % 8, np.arange(GRAINS) // 8
    places = np.stack([2 + column * (1 - 1e-9), 5.0 * row + 2], axis=-1)
    tallies = []
    for copies in (1, 2, 4):
        velocities = np.zeros((GRAINS, 2))
        velocities[(column == 0) & (row < copies), 0] = 1.0
        state = state_of(places, velocities, 40.0)
        flow = flow_of(0.01, restitution=0.0, shear_rate=0.0)
        tallies.append(native_run(flow, state, 1, BarzilaiBorwein(tolerance))[1])
    assert tallies[0].iterations == tallies[1].iterations == tallies[2].iterations > 5
    assert all(0 < tally.worst_residual <= tolerance for tally in tallies)


def test_grains_that_a_collision_made_faster_meet_whatever_their_distance(native_run) -> None:
    """Heavy grains strike two light ones, which meet head-on in the step in which another pair
    collides; the list of near pairs was made for half of their speed.
    """
    places = np.stack([2 + 3.0 * (np.arange(GRAINS) % 12), 24 + 4.0 * (np.arange(GRAINS) // 12)])
    masses, velocities = np.ones(GRAINS), np.zeros((GRAINS, 2))
    masses[[0, 3]], velocities[[0, 3, 4], 0] = 1e4, [1, -1, 0.5]
    flow = flow_of(0.02, restitution=1.0, shear_rate=0.0, timestep=1.44)
    for gap in np.linspace(8.0, 8.64, 33)[:-1]:
        places[:, :6] = [[5, 6, 7 + gap, 8 + gap, 5, 6.72], [5, 5, 5, 5, 15, 15]]
        after, _ = native_run(flow, state_of(places.T, velocities, 40.0, masses=masses), 2)
        np.testing.assert_allclose(after.velocities[[1, 2], 0], [-2, 2], atol=1e-3, err_msg=gap)


def test_steps_that_outrun_a_usual_skin_have_lists_as_wide_as_they_need(native_run) -> None:
    row, rng = 6, np.random.default_rng(1)
    places = 1.05 * np.stack(np.divmod(np.arange(GRAINS), row), axis=-1) + 0.5
    state = state_of(places, rng.normal(size=places.shape), 1.05 * row)
    _, tally = native_run(flow_of(0.7, timestep=0.05), state, 3, BarzilaiBorwein())
    assert tally.status == Status.ok and tally.deep_contacts > tally.contacts / 10


def test_a_solve_of_nothing_has_no_residual(native_run) -> None:
    """Two grains graze each other by rounding only; without shear the residual has no floor."""
    places = 5.0 * np.stack(np.divmod(np.arange(GRAINS), 6), axis=-1) + 1
    speeds = np.zeros((GRAINS, 2))
    for angle in np.linspace(0.1, 3.0, 60):
        normal = np.array([np.cos(angle), np.sin(angle)])
        places[1], speeds[0] = places[0] + (1 - 1e-9) * normal, normal[::-1] * [-1, 1]
        _, tally = native_run(flow_of(0.03, shear_rate=0.0), state_of(places, speeds, 40.0), 2)
        assert np.isfinite(tally.worst_residual)


def test_derivatives_and_the_values_beside_them_are_those_of_the_engine_jax(
    flowing, monkeypatch
) -> None:
    monkeypatch.setattr(jax_engine, "contact_buffers", lambda _: ())  # there is less to compile
    state = flowing(0.6)

    def velocities(alpha, engine):
        flow = replace(flow_of(0.6), restitution=alpha)
        return advance_module.advance(flow, state, jnp.int32(30), engine=engine)[0].velocities

    def with_derivative(engine):
        return jax.jit(lambda x: jax.jvp(lambda y: velocities(y, engine), (x,), (1.0,)))(0.5)

    (value, derivative), expected = map(with_derivative, (Numba(), Jax()))
    np.testing.assert_array_equal(value, expected[0])
    np.testing.assert_array_equal(derivative, expected[1])
    plain = jax.jit(lambda x: velocities(x, Numba()))(0.5)
    np.testing.assert_allclose(value, plain, rtol=1e-9, atol=1e-9)
    assert np.max(np.abs(derivative)) > 0.1


@settings(max_examples=30)
@given(
    place=st.floats(-300, 308).map(lambda x: 10**x),
    speed=st.floats(-300, 308).map(lambda x: 10**x),
    radius=st.sampled_from([0.0, -0.5, 1e-300, 0.5, 1e3, 1e300, np.nan, np.inf]),
    mass=st.sampled_from([0.0, 1e-300, 1.0, 1e300, np.nan]),
    side=st.sampled_from([0.0, -5.0, 1e-300, 6.0, 1e300, np.nan]),
    tilt=st.sampled_from([0.0, 0.3, 1e300, np.nan]),
    shear_rate=st.sampled_from([0.0, 1.0]),
)
@example(
    place=1.0, speed=1.0, radius=0.5, mass=1.0, side=6.0, tilt=0.0, shear_rate=1.0
)  # more contacts than room
def test_senseless_states_come_to_an_end(
    native_run, place, speed, radius, mass, side, tilt, shear_rate
) -> None:
    """Whatever a state holds, the loop ends, and nothing is NaN and called ok."""
    rng = np.random.default_rng(0)
    places, velocities = (x * rng.uniform(-1, 1, (GRAINS, 2)) for x in (place, speed))
    state = state_of(places, velocities, side, tilt, radius, mass)
    flow = flow_of(shear_rate=shear_rate)
    after, tally = native_run(flow, state, 20, BarzilaiBorwein(1e-12, 100))
    if not np.all(np.isfinite(after.velocities)):
        assert tally.status == Status.nonfinite


def test_any_numbers_come_to_an_end_and_are_finite_or_flagged(engine) -> None:
    """In a process of its own, which an index outside of its array would end by a signal."""
    driver = Path(__file__).with_name("fuzz_driver.py")
    command = [sys.executable, str(driver), engine]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr


def test_a_traced_number_that_cannot_be_ends_its_replica_and_no_other(engine) -> None:
    cannot_be = {"timestep": 0.0, "shear_rate": -1.0, "side": -1.0, "radii": -0.5, "masses": -1.0}
    faults = [
        *((name, np.nan) for name in ("tilt", "restitution", "positions", *cannot_be)),
        *((name, np.inf) for name in ("tilt", "restitution", "velocities", *cannot_be)),
        *cannot_be.items(),
        *(("restitution", -0.05), ("restitution", 1.1), ("activation", 0.3)),
    ]
    replicas = [{name: np.array(x, float) for name, x in GIVEN.items()} for _ in (*faults, 0, 1)]
    for changed, (name, value) in zip(replicas[1:-1], faults, strict=True):
        changed[name].flat[0] = value

    @jax.jit
    @jax.vmap
    def advanced(numbers):
        flow, state = of_numbers(numbers)
        return advance_module.advance(flow, state, jnp.int32(100), engine=engine_named(engine))

    end, tally = advanced(stacked(replicas))
    np.testing.assert_array_equal(tally.status[1:-1], Status.nonfinite)
    first, last = ((replica(end, k), replica(tally, k)) for k in (0, -1))
    assert_same_bits(first, last)
    assert first[1].status == Status.ok and first[1].collisions > 0


@settings(max_examples=200)
@given(
    fastest=st.floats(0.1, 10),
    distance=st.floats(0.8, 3),
    angles=st.tuples(*[st.floats(0, 2 * np.pi)] * 3),
    strain=st.floats(1e-6, LIFE + LOOK_AHEAD),
    shear_rate=st.sampled_from([1.0, 3.0]),
)
@example(
    fastest=1.0, distance=1.0, angles=(0.0, np.pi, 0.0), strain=0.01, shear_rate=1.0
)  # head on
def test_no_pair_closes_by_more_than_its_list_loses_of_the_skin(
    fastest, distance, angles, strain, shear_rate
) -> None:
    """Both fly straight in the laboratory, at the largest peculiar speed in any directions."""
    apart = distance * np.array([np.cos(angles[0]), np.sin(angles[0])])
    (ci, si), (cj, sj) = ((np.cos(a), np.sin(a)) for a in angles[1:])
    velocity = fastest * np.array([ci - cj, si - sj]) + [shear_rate * apart[1], 0]
    time = strain / shear_rate
    closed = distance - np.linalg.norm(apart + velocity * time)
    look_ahead = LOOK_AHEAD / shear_rate
    bound = closing_speed_bound.py_func(fastest, shear_rate, distance, look_ahead)
    assert closed <= bound * time * (1 + 1e-12)


@pytest.mark.parametrize("speed", [0.3, 3.0])
def test_bound_of_closing_includes_that_speeds_grow_within_a_flight(engine, speed) -> None:
    """A pair that stretches with the shear reaches the skin in the look-ahead of the last step of
    the longest flight, or of the longest step.
    """
    longest, skin = {"numba": LIFE, "jax": 2 * LOOK_AHEAD}[engine] + LOOK_AHEAD, 0.2
    normal = np.array([1, -1]) / np.sqrt(2)
    velocities = speed * np.stack([-normal, normal])
    later = velocities - longest * velocities[:, 1:] * [1, 0]
    closing = np.dot(later[1] - later[0], normal) + (1 + skin) / 2
    if engine == "numba":
        bound = closing_speed_bound.py_func(speed, 1.0, 1 + skin, LOOK_AHEAD)
    else:
        flow, grains = flow_of(timestep=2 * LOOK_AHEAD), Grains(jnp.full(2, 0.5), jnp.ones(2))
        given = jnp.asarray(velocities), jnp.asarray(skin)
        bound = step.closing_speed_bound(flow, grains, *given)
    assert closing <= bound <= closing + 2 * speed * longest


@pytest.fixture(scope="module")
def near_pairs_found():
    """``find_near_pairs`` with a way in from Python; kept as long as the engine is the same."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(numba.config, "CACHE_DIR", str(engine_folder()))
        return numba.njit(cache=True)(find_near_pairs.py_func)


@settings(max_examples=40)
@given(
    count=st.integers(16, 300),
    packing_fraction=st.floats(0.05, 0.8),
    tilt=st.floats(-0.5, 0.5),
    skin=st.floats(0.01, 1.0),
    seed=st.integers(0, 10**6),
)
def test_near_pairs_are_those_of_all_images(
    near_pairs_found, count, packing_fraction, tilt, skin, seed
) -> None:
    rng = np.random.default_rng(seed)
    radii = rng.uniform(0.37, 0.63, count)
    side = np.sqrt(np.pi * np.sum(radii**2) / packing_fraction)
    reach = 2 * radii.max() + skin
    assume(reach <= side / 2)  # nearest images are unique
    positions = rng.uniform(0, side, (count, 2))
    positions[:, 0] -= np.floor((positions[:, 0] - tilt * positions[:, 1]) / side) * side
    motion, constants = np.zeros(count, arrays.MOTION), np.ones(count, arrays.CONSTANTS)
    motion["x"], motion["y"], constants["radius"] = *positions.T, radii
    room = count * (count - 1) // 2
    cells = (
        np.empty(max(9, 2 * count) + 1, np.uint32),
        *np.empty((2, count), np.uint32),
        np.empty((3, count)),
    )
    listed = np.empty((2, room + 1), np.uint32), np.empty((2, room + 1))
    memory = arrays.Pairs(*listed, *4 * [None], *cells, *3 * [None])
    grains = arrays.Grains(motion, constants, None)
    found = near_pairs_found(grains, memory, side, tilt, reach, skin, room)
    pairs, images = memory.ends, memory.images
    expected = set()
    for row in (-1, 0, 1):
        for column in (-2, -1, 0, 1, 2):
            shift = np.array([(column + row * tilt) * side, row * side])
            apart = positions[:, None] - positions[None, :] - shift
            near = np.hypot(*np.moveaxis(apart, -1, 0)) <= radii[:, None] + radii[None, :] + skin
            expected |= {(i, j, row, column) for i, j in np.argwhere(near) if i < j}
    across = np.round(images[0, :found] / side - images[1, :found] * tilt).astype(int)
    signs = np.where(pairs[0, :found] < pairs[1, :found], 1, -1)
    ends = np.sort(pairs[:, :found].astype(int), axis=0)
    got = list(zip(*ends, (signs * images[1, :found]).astype(int), signs * across, strict=True))
    assert len(got) == len(set(got))
    assert set(got) == expected
