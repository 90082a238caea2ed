"""Derivatives of a contact solve and of a run, against differences and known laws."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from contact_networks import MAX_DISCS, padded_network, random_network
from exact_contacts import delassus
from flows import EXACT, GRAINS, of_state
from hypothesis import Phase, assume, given, settings
from hypothesis import strategies as st
from jax import lax
from oracles import build

from jaxgran.contact.delassus import NetworkOperator, grain_impulses
from jaxgran.contact.near_pairs import Frame, present, separations_now
from jaxgran.contact.network import Contacts, pair_motion
from jaxgran.contact.problem import ContactNetwork
from jaxgran.contact.projected_methods import BarzilaiBorwein, Nesterov
from jaxgran.contact.solve_contacts import solve_contacts
from jaxgran.contact.solver import solve
from jaxgran.dynamics import jax_engine
from jaxgran.dynamics.advance import count_events
from jaxgran.dynamics.jax_engine import advance_by_jax
from jaxgran.dynamics.moving_contacts import displaced
from jaxgran.model.cell import displacement
from jaxgran.model.flow import ShearFlow
from jaxgran.model.grains import Grains
from jaxgran.model.state import State
from jaxgran.model.status import Status

networks = st.tuples(st.integers(0, 2**32 - 1), st.integers(2, MAX_DISCS))
STEPS = 40


@jax.jit
def impulses_of(approach, angles, inverse_masses, network: Contacts):
    """Impulses of a network by approach velocities, directions of normals, inverse masses."""
    normals = jnp.where(
        network.used[:, None], jnp.stack([jnp.cos(angles), jnp.sin(angles)], axis=-1), 0
    )
    turned = replace(
        network,
        approach=approach,
        normals=normals,
        inverse_mass_i=jnp.where(network.used, inverse_masses[network.i], 0),
        inverse_mass_j=jnp.where(network.used, inverse_masses[network.j], 0),
    )
    operator, solver = NetworkOperator(turned, MAX_DISCS), BarzilaiBorwein(1e-12, 100_000)
    return solve(operator, jnp.asarray(1.0), solver, jnp.asarray(True)).impulses


@jax.jit
def weighted(approach, angles, inverse_masses, network, weights):
    return jnp.sum(weights * impulses_of(approach, angles, inverse_masses, network))


gradient = jax.jit(jax.grad(weighted, argnums=(0, 1, 2)))
tangent = jax.jit(lambda at, along, *rest: jax.jvp(lambda *x: weighted(*x, *rest), at, along)[1])


def inputs(network: Contacts, masses: np.ndarray):
    angles = jnp.arctan2(network.normals[:, 1], network.normals[:, 0])
    return network.approach, angles, jnp.asarray(1 / masses)


def strictness_and_error(network: Contacts, masses: np.ndarray) -> tuple[float, np.ndarray]:
    """How far the network is from a contact that neither presses nor parts, or, if that is less,
    from impulses that are not unique: the smallest eigenvalue of the block of pressing contacts.
    And by how much the impulses are off.
    """
    impulses, used = np.asarray(impulses_of(*inputs(network, masses), network)), network.used
    matrix, approach = delassus(network, masses), np.asarray(network.approach)
    margin = np.maximum(np.diag(matrix) * impulses, matrix @ impulses + approach)
    presses = (impulses > 0) & np.asarray(used)
    block, error = matrix[np.ix_(presses, presses)], np.zeros(impulses.size)
    strict = float(np.min(np.append(margin[np.asarray(used)], np.linalg.eigvalsh(block))))
    if strict > 0:
        error[presses] = impulses[presses] + np.linalg.solve(block, approach[presses])
    return strict, error


@settings(max_examples=25, phases=[Phase.generate])
@given(networks, st.sampled_from([1.0, 100.0]))
def test_gradient_of_a_solve_is_that_of_finite_differences(network_of, heaviest):
    """By velocities, geometry and masses, wherever no contact is about to press or to part."""
    network, masses, _ = random_network(*network_of, heaviest)
    used = np.asarray(network.used)
    assume(np.any(used))
    strict, error = strictness_and_error(network, masses)
    assume(strict > 1e-3)
    rng = np.random.default_rng(network_of[0])
    at, weights = inputs(network, masses), jnp.asarray(rng.normal(size=used.size) * used)
    noise = 4 * float(jnp.linalg.norm(weights * error)) / 1e-5  # of the differences
    derivative = gradient(*at, network, weights)
    assert all(np.all(np.isfinite(part)) for part in derivative)
    assume(float(jnp.max(jnp.abs(derivative[0]))) < 1e3)  # else differences lose their digits
    for k in range(3):
        real = used if k < 2 else np.ones(MAX_DISCS)
        along = tuple(
            jnp.asarray(real * rng.normal(size=x.shape) if n == k else 0 * x)
            for n, x in enumerate(at)
        )

        def difference(step: float, along=along) -> float:
            moved = [
                tuple(x + sign * step * d for x, d in zip(at, along, strict=True))
                for sign in (1, -1)
            ]
            return float(
                weighted(*moved[0], network, weights) - weighted(*moved[1], network, weights)
            ) / (2 * step)

        numerical = (4 * difference(1e-5) - difference(2e-5)) / 3  # of fourth order
        exact = float(jnp.sum(derivative[k] * along[k]))
        scale = float(jnp.sqrt(jnp.sum(derivative[k] ** 2))) + 1
        assert abs(numerical - exact) < 1e-6 * scale + noise
        assert abs(tangent(at, along, network, weights) - exact) < 1e-8 * scale


def test_both_modes_agree_where_many_contacts_join_few_discs():
    """Eight contacts of three discs: conjugate gradients diverge after they came near."""
    ends, rng = np.array([[0, 1], [1, 2], [0, 2]] * 3)[:8], np.random.default_rng(5)
    solver = BarzilaiBorwein(tolerance=1e-12, max_steps=20_000)

    @jax.jit
    def derivatives(normals, masses, velocities, along, weights):
        def score(velocities):
            approach = jnp.sum(normals * (velocities[ends[:, 0]] - velocities[ends[:, 1]]), axis=1)
            network = ContactNetwork(ends, normals, masses, approach)
            return jnp.sum(weights * solve_contacts(network, 0.5, solver).velocities)

        forward = jax.jvp(score, (velocities,), (along,))[1]
        return forward, jnp.sum(along * jax.grad(score)(velocities))

    for _ in range(40):
        angles, masses = rng.uniform(0, 2 * np.pi, 8), rng.uniform(0.3, 3, 3)
        velocities, along = rng.normal(size=(2, 3, 2))
        normals = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        weights = rng.normal(size=8)
        forward, backward = derivatives(normals, masses, velocities, along, weights)
        np.testing.assert_allclose(forward, backward, rtol=1e-5, atol=1e-5)


def test_velocities_are_differentiable_where_impulses_are_not_unique():
    """A disc hits a rigid hexagon of seven, which has one contact too many."""
    angles = np.arange(6) * np.pi / 3
    places = np.concatenate(
        [[[0.0, 0.0]], np.stack([np.cos(angles), np.sin(angles)], -1), [[2.0, 0.1]]]
    )
    places[7, 0] = 1 + np.sqrt(1 - 0.01)
    pairs = [(0, k) for k in range(1, 7)] + [(k, k % 6 + 1) for k in range(1, 7)] + [(1, 7)]
    i, j = np.array(pairs).T
    normals = places[i] - places[j]
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    masses = np.ones(MAX_DISCS)
    empty = padded_network(i, j, normals, np.zeros(len(i)), masses)
    assert np.linalg.matrix_rank(delassus(empty, masses)[: len(i), : len(i)]) < len(i)

    @jax.jit
    def after(velocities):
        approach = jnp.sum(empty.normals * (velocities[empty.i] - velocities[empty.j]), axis=-1)
        network = replace(empty, approach=jnp.where(empty.used, approach, 0))
        solver = Nesterov(1e-12, 1_000_000)
        operator = NetworkOperator(network, MAX_DISCS)
        impulses = solve(operator, jnp.asarray(1.0), solver, jnp.asarray(True)).impulses
        return velocities + grain_impulses(network, impulses, MAX_DISCS)

    inwards = np.zeros((MAX_DISCS, 2))
    inwards[1:7] = -0.1 * places[1:7]  # so that every contact of the hexagon presses
    inwards[7] = -1.0, 0.2
    along = (
        np.random.default_rng(0).normal(size=inwards.shape) * (np.arange(MAX_DISCS) < 8)[:, None]
    )
    ends = [after(jnp.asarray(inwards + sign * 1e-5 * along)) for sign in (1, -1)]
    _, change = jax.jvp(after, (jnp.asarray(inwards),), (jnp.asarray(along),))
    np.testing.assert_allclose(change, (ends[0] - ends[1]) / 2e-5, rtol=0, atol=1e-6)


# Through time

NUMBERS = ["restitution", "shear_rate", "timestep"]  # of the flow
NAMES = [*NUMBERS, "side", "radii", "masses", "positions", "velocities"]


def parameters(flow: ShearFlow, state: State) -> dict:
    numbers = {name: jnp.asarray(getattr(flow, name), float) for name in NUMBERS}
    own = {"side": state.side, "radii": state.grains.radii, "masses": state.grains.masses}
    return numbers | own | {"positions": state.positions, "velocities": state.velocities}


def exact_advance(flow, *arguments, **options):
    return advance_by_jax(flow, EXACT, *arguments, **options)


def changed(flow: ShearFlow, state: State, values: dict) -> tuple[ShearFlow, State]:
    """The flow and the state with these parameters."""
    flow = replace(flow, **{name: values[name] for name in NUMBERS})
    grains = Grains(values["radii"], values["masses"])
    return flow, State(
        grains, values["positions"], values["velocities"], values["side"], state.tilt
    )


@pytest.fixture(scope="module")
def tilting(flowing, run) -> tuple[ShearFlow, State]:
    """A flow whose tilt is about to be remapped, in which outer lists are built anew."""
    flow = ShearFlow(GRAINS, 0.6, 0.7, 5e-3)
    state = replace(flowing(0.7), tilt=jnp.asarray(0.45))
    end, tally = run(flow, state, STEPS)
    assert end.tilt < 0 and tally.collisions > 20
    return flow, state


@pytest.fixture(scope="module")
def events_of(tilting):
    """``events_of(steps)``: how many events that many steps of the flow have."""
    compiled = jax.jit(partial(count_events, solver=EXACT))
    return lambda steps: int(compiled(*tilting, jnp.int32(steps)))


@pytest.fixture(scope="module")
def score_of(tilting, run):
    """A random linear function of the end of the run."""
    weights = np.random.default_rng(0).normal(size=(2, GRAINS, 2))
    end, _ = run(*tilting, STEPS)

    @jax.jit
    def score(after: State):
        moved = displacement(
            after.positions, end.positions, lax.stop_gradient(after.side), after.tilt
        )
        return jnp.sum(weights[0] * moved) + jnp.sum(weights[1] * after.velocities)

    return score


@pytest.fixture(scope="module")
def backward(tilting, score_of, events_of):
    """``backward(values, steps)``: value, tally and gradient, in a loop of ``STEPS``'s events."""
    events = events_of(STEPS)

    @jax.jit
    def compiled(values: dict, steps):
        def score(values: dict):
            after, tally = exact_advance(*changed(*tilting, values), steps, events=events)
            return score_of(after), tally

        return jax.value_and_grad(score, has_aux=True)(values)

    return lambda values, steps: compiled(values, jnp.int32(steps))


@pytest.fixture(scope="module")
def derivative(tilting, backward):
    """Value and gradient of the score."""
    (value, tally), slopes = backward(parameters(*tilting), STEPS)
    assert tally.status <= Status.deep_overlap
    return value, slopes


@pytest.fixture(scope="module")
def forward(tilting, score_of):
    """``forward(values, along)``: the derivative along a direction, in forward mode."""

    def score(values: dict):
        return score_of(exact_advance(*changed(*tilting, values), jnp.int32(STEPS))[0])

    return jax.jit(lambda values, along: jax.jvp(score, (values,), (along,))[1])


def test_loop_of_fixed_length_has_the_values_of_the_advance(tilting, derivative, score_of, run):
    np.testing.assert_allclose(derivative[0], score_of(run(*tilting, STEPS)[0]), rtol=1e-9)


@pytest.mark.parametrize("name", NAMES)
def test_gradient_of_a_run_is_that_of_finite_differences(
    tilting, derivative, forward, score_of, run, name
):
    """Across new lists and a remap of the tilt; radii only decide in which steps grains meet."""
    at = parameters(*tilting)
    along = jnp.asarray(np.random.default_rng(1).normal(size=at[name].shape))
    step = 1e-8
    ends = []
    for sign in (1, -1):
        flow, start = changed(*tilting, at | {name: at[name] + sign * step * along})
        ends.append(score_of(run(flow, start, STEPS)[0]))
    high, low = ends
    numerical, exact = float((high - low) / (2 * step)), float(jnp.sum(derivative[1][name] * along))
    assert abs(numerical - exact) <= 1e-6 * max(1, abs(exact))
    if name == "radii":
        assert exact == 0
    change = {other: jnp.asarray(np.zeros(x.shape)) for other, x in at.items()} | {name: along}
    np.testing.assert_allclose(forward(at, change), exact, rtol=1e-7, atol=1e-9)


def test_numbers_and_derivatives_are_nan_where_events_do_not_suffice(tilting, backward, events_of):
    """Where a few steps more have one event more than the loop is long."""
    steps = next(steps for steps in range(STEPS, 2 * STEPS) if events_of(steps) > events_of(STEPS))
    (_, tally), derivative = backward(parameters(*tilting), steps)
    assert tally.status == Status.capacity
    assert np.isnan(tally.impulse) and np.isnan(derivative["restitution"])


# What the derivative means


def collision(gap, scene, dt: float, moving_contacts: bool):
    """Where the left of two discs, the other at rest, is a time after it hits head on."""
    state = scene([[3.0, 0.0], [4.0, 0.0]], [[1.0, 0.0], [0.0, 0.0]])
    flow = ShearFlow(GRAINS, 0.5, GRAINS * np.pi / 4 / 40**2, dt)
    state = replace(state, positions=state.positions.at[1, 0].add(gap))
    steps = jnp.int32(round(0.5 / dt))
    end, _ = exact_advance(flow, state, steps, moving_contacts=moving_contacts)
    return end.positions[0, 0]


def test_a_contact_that_moves_in_time_has_the_derivative_of_the_event(scene):
    """At fixed steps, the first disc has come no further when it has further to go: ∂x/∂gap = 0. In
    truth it meets the other one later, and loses the velocity Δv later: ∂x/∂gap = Δv/u = (1 + α)/2.
    So says a difference over many steps.
    """
    at, change = jnp.asarray(0.2 + 3e-4), 0.05

    @partial(jax.jit, static_argnums=1)
    def value_and_slope(gap, moving_contacts: bool):
        return jax.jvp(
            lambda gap: collision(gap, scene, 1e-3, moving_contacts), (gap,), (jnp.ones_like(gap),)
        )

    (near, moving), (far, _) = value_and_slope(at, True), value_and_slope(at + change, True)
    np.testing.assert_allclose(moving, 0.75, atol=1e-9)
    np.testing.assert_allclose((far - near) / change, 0.75, atol=0.02)


def test_displaced_grains_have_their_velocities_in_the_laboratory(flowing) -> None:
    """Positions, frozen separations and pairs follow by the same displacement, in any frame."""
    state, shift = flowing(0.6), 1e-3 * np.random.default_rng(0).normal(size=(GRAINS, 2))
    lists = build(state.positions, state.grains, state.side, state.tilt)
    lists = replace(lists, frame=Frame(jnp.zeros((GRAINS, 2)), jnp.asarray(0.3)))
    near, before = lists.near, separations_now(lists.near, lists.frame)
    pairs = pair_motion(near.i, near.j, before, state.velocities, 1.0)
    frame, velocities, after = displaced(jnp.asarray(shift), 1.0, lists, state.velocities, pairs)
    (old, tilt), (new, _) = (
        present(replace(lists, frame=x), state.side) for x in (lists.frame, frame)
    )
    np.testing.assert_allclose(displacement(new, old, state.side, tilt), shift, atol=1e-12)
    np.testing.assert_allclose(velocities - state.velocities, -shift[:, 1:] * [1, 0], atol=1e-12)
    apart = shift[near.i] - shift[near.j]
    np.testing.assert_allclose(separations_now(near, frame) - before, apart, atol=1e-9)
    np.testing.assert_allclose(after.x - pairs.x, apart[:, 0], atol=1e-9)
    np.testing.assert_allclose(after.y - pairs.y, apart[:, 1], atol=1e-9)


def test_at_a_kink_the_derivative_is_one_of_the_two_one_sided_ones(scene, run, monkeypatch):
    """A disc hits a second one that a third one touches at a right angle: the third contact neither
    presses nor parts.

    Hit a little from above or from below, the second disc pushes the third or leaves it alone: the
    derivatives to both sides differ, and the one returned is one of them.
    """
    touching = scene([[3.0, 4.0], [4.0, 4.0], [4.0, 3.0]], [[1.0, 0.0], [0.0, 0.0], [0.0, 0.0]])
    flow = of_state(ShearFlow(GRAINS, 0.0, 0.02, 1e-6), touching)

    def pushed(slant, advanced=exact_advance):
        """Velocity of the third disc along y, where the first one comes at a slant."""
        turn = jnp.stack([jnp.cos(slant), -jnp.sin(slant)])
        first = touching.positions.at[0].set(touching.positions[1] - turn)
        return advanced(flow, replace(touching, positions=first), jnp.int32(2))[0].velocities[2, 1]

    at, step = jnp.asarray(0.0), 1e-4
    left, middle, right = (pushed(at + x, run) for x in (-step, 0, step))
    sides = [(right - middle) / step, (middle - left) / step]
    monkeypatch.setattr(jax_engine, "contact_buffers", lambda _: ())  # there is less to compile
    returned = jax.jit(jax.jacfwd(pushed))(at)
    assert abs(sides[0] - sides[1]) > 0.1
    assert min(abs(returned - side) for side in sides) < 1e-3
