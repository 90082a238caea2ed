"""Both engines against programs that share no code with them, step by step and on average."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from exact_contacts import certified_impulses
from flows import EXACT, GRAINS, flow_of
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from oracles import nearest_image

import jaxgran as jg
from benchmarks.independent import contact_dynamics, event_driven
from jaxgran.model.cell import displacement
from jaxgran.model.grains import Grains
from jaxgran.model.state import State
from jaxgran.model.status import Status

THETA = {"midpoint": 0.5, "touching": 0.0}
STEPS, DT = 200, 1e-3


class Plain:
    """The time step in its plainest form: all pairs, all images, dense matrices."""

    def __init__(self, state: State, flow: jg.ShearFlow) -> None:
        self.x, self.c = np.array(state.positions), np.array(state.velocities)
        self.side, self.tilt = float(state.side), float(state.tilt)
        self.radii, self.masses = np.array(state.grains.radii), np.array(state.grains.masses)
        self.rate, self.dt, self.alpha = (
            float(flow.shear_rate),
            float(flow.timestep),
            float(flow.restitution),
        )
        self.ahead, self.collisions = flow.activation * self.dt, 0

    def contacts(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Grains i < j of each contact, normals from j to i, and relative normal velocities."""
        i, j = np.triu_indices(len(self.x), 1)
        s = nearest_image(self.x[i] - self.x[j], self.side, self.tilt)
        u = self.c[i] - self.c[j] + np.stack([self.rate * s[:, 1], np.zeros(len(s))], axis=1)
        speed, closing = np.sum(u * u, axis=1), np.sum(s * u, axis=1)
        closest = np.where(closing < 0, -closing / np.where(speed > 0, speed, 1), np.inf)
        nearest = s + np.minimum(closest, self.ahead)[:, None] * u
        meets = np.sum(nearest**2, axis=1) <= (self.radii[i] + self.radii[j]) ** 2
        i, j, s, u = i[meets], j[meets], s[meets], u[meets]
        n = s / np.linalg.norm(s, axis=1)[:, None]
        return i, j, n, np.sum(n * u, axis=1)

    def impulses(
        self, i: np.ndarray, j: np.ndarray, n: np.ndarray, approach: np.ndarray
    ) -> np.ndarray:
        """The solution of 0 ≤ J ⟂ W J + (1 + α) u⁻ ≥ 0: with u⁺ = u⁻ + W J, u⁺ + α u⁻ ≥ 0."""
        h, rows = np.zeros((len(i), len(self.x), 2)), np.arange(len(i))
        h[rows, i], h[rows, j] = n, -n
        solved = certified_impulses(
            h.reshape(len(i), -1) / np.repeat(np.sqrt(self.masses), 2), approach
        )
        assert solved is not None
        return (1 + self.alpha) * solved

    def step(self) -> None:
        i, j, n, approach = self.contacts()
        if np.any(approach < 0):
            self.collisions += int(np.sum(approach < 0))
            p = self.impulses(i, j, n, approach)[:, None] * n
            np.add.at(self.c, i, p / self.masses[i, None])
            np.add.at(self.c, j, -p / self.masses[j, None])
        self.x = self.x + self.dt * (
            self.c + self.rate * np.stack([self.x[:, 1], np.zeros(len(self.x))], axis=1)
        )
        self.c[:, 0] -= self.rate * self.dt * self.c[:, 1]
        self.tilt += self.rate * self.dt
        rows = np.floor(self.x[:, 1] / self.side)  # back into the cell, where few images suffice
        self.x -= np.stack([rows * self.tilt, rows], axis=1) * self.side
        self.tilt -= np.round(self.tilt)
        self.x[:, 0] -= np.floor(self.x[:, 0] / self.side) * self.side


def assert_same_motion(state: State, plain: Plain, atol: float) -> None:
    moved = displacement(state.positions, jnp.asarray(plain.x), state.side, state.tilt)
    np.testing.assert_allclose(moved, 0, atol=atol)
    np.testing.assert_allclose(state.velocities, plain.c, rtol=0, atol=atol)


def fast_pair(gap: float, speed: float) -> State:
    """Two fast discs on their way to each other between two rows of discs at rest."""
    count = GRAINS - 2
    places = np.stack(
        [1.2 * (np.arange(count) % 15), 6.0 * (2 * (np.arange(count) // 15) - 1)], axis=1
    )
    positions = np.concatenate([[[-(1 + gap) / 2, 0.0], [(1 + gap) / 2, 0.0]], places - [8.5, 0.0]])
    velocities = np.zeros((GRAINS, 2))
    velocities[:2, 0] = speed, -speed
    grains = Grains(jnp.full(GRAINS, 0.5), jnp.ones(GRAINS))
    return State(grains, *map(jnp.asarray, (positions + 10, velocities, 20.0, 0.0)))


@settings(max_examples=30)
@given(
    gap=st.floats(0.1, 9),
    speed=st.floats(1, 25),
    activation=st.sampled_from(["midpoint", "touching"]),
)
@example(5.5, 19.2, "midpoint")
def test_fast_discs_do_not_pass_through_each_other(engine_run, gap, speed, activation) -> None:
    """The list of near pairs must reach as far as the contact rule looks ahead."""
    steps = gap / (2 * speed * 0.1) + 1 - THETA[activation]
    assume(abs(steps - round(steps)) > 1e-9)  # rounding would decide
    flow = flow_of(0.0628, timestep=0.1, shear_rate=0.0, activation=activation)
    state = fast_pair(gap, speed)
    after, tally = engine_run(flow, state, 6)
    assume(tally.status < Status.infeasible)
    plain = Plain(state, flow)
    for _ in range(6):
        plain.step()
    assert float(tally.collisions) == plain.collisions
    assert_same_motion(after, plain, 1e-9 * speed)


@settings(max_examples=40)
@given(
    packing_fraction=st.sampled_from([0.05, 0.1, 0.3, 0.6]),
    timestep=st.floats(-3, -1).map(lambda x: 10**x),
    speed=st.floats(0.1, 15),
    shear_rate=st.sampled_from([0.0, 1.0]),
    activation=st.sampled_from(["midpoint", "touching"]),
    steps=st.integers(1, 6),
    seed=st.integers(0, 10**6),
)
@example(0.05, 0.1, 8.0, 0.0, "midpoint", 6, 3)
@example(0.05, 0.1, 15.0, 1.0, "midpoint", 6, 4)
@example(0.1, 0.1, 10.0, 1.0, "touching", 6, 5)
def test_fast_coarse_sparse_flows_move_as_by_the_plainest_program(
    packed, engine_run, packing_fraction, timestep, speed, shear_rate, activation, steps, seed
) -> None:
    """No contact is missed and no grain passes another, or the status says that lists are full."""
    velocities = speed * np.random.default_rng(seed).normal(size=(GRAINS, 2))
    still = packed(packing_fraction)
    state = State(still.grains, still.positions, jnp.asarray(velocities), still.side, still.tilt)
    flow = flow_of(
        packing_fraction, timestep=timestep, shear_rate=shear_rate, activation=activation
    )
    after, tally = engine_run(flow, state, steps)
    assume(tally.status < Status.infeasible)
    plain = Plain(state, flow)
    for _ in range(steps):
        plain.step()
    assert float(tally.collisions) == plain.collisions
    assert_same_motion(after, plain, 1e-6 * (1 + speed))


@pytest.mark.parametrize("packing_fraction", [0.6, 0.78])
def test_contacts_of_a_step_are_those_of_the_plainest_program(flowing, packing_fraction) -> None:
    state, flow = flowing(packing_fraction), flow_of(packing_fraction, timestep=0.03)
    seen = jax.jit(
        lambda state: jg.snapshot_series(flow, state, float(flow.timestep), 1, solver=EXACT)
    )(state)[1][0]
    plain = Plain(seen.state, flow)
    i, j, n, approach = plain.contacts()
    used = np.asarray(seen.contacts.used)
    order = np.lexsort((np.asarray(seen.contacts.j)[used], np.asarray(seen.contacts.i)[used]))
    ours = [np.asarray(x)[used][order] for x in (seen.contacts.i, seen.contacts.j, seen.impulses)]
    assert len(i) > 5
    np.testing.assert_array_equal(ours[0], i)
    np.testing.assert_array_equal(ours[1], j)
    np.testing.assert_allclose(ours[2], plain.impulses(i, j, n, approach), atol=1e-8)


@pytest.mark.parametrize(
    ("packing_fraction", "activation"), [(0.4, "midpoint"), (0.7, "midpoint"), (0.78, "touching")]
)
def test_sums_over_200_steps_are_those_of_the_classical_loop(
    flowing, engine_run, packing_fraction, activation
) -> None:
    """Two programs that were written apart, from the same state: contacts, impulses, averages."""
    state = flowing(packing_fraction)
    flow = flow_of(packing_fraction, activation=activation, restitution=0.8)
    after, tally = engine_run(flow, state, STEPS)
    grains = state.grains
    given = grains.radii, grains.masses, state.side
    law = {"shear_rate": 1.0, "restitution": 0.8, "timestep": DT, "tolerance": 1e-12}
    law["activation"] = THETA[activation]
    at, sums = (state.positions, state.velocities, state.tilt), np.zeros(11)
    for _ in range(STEPS):
        *at, step = contact_dynamics.advance(*at[:2], *given, at[2], **law)
        begin = at[1] + DT * np.stack([at[1][:, 1], np.zeros(GRAINS)], axis=1)  # after the impulses
        kinetic = sum(
            w * np.einsum("i,ia,ib->ab", grains.masses, c, c) for w, c in simpson(begin, at[1])
        )
        stresses = *step.contact_stress, *step.binary_stress, *symmetric(kinetic)
        sums += (step.impulse, step.binary_impulse, *stresses)
    area = float(state.side) ** 2
    assert float(tally.collisions) > 5
    per_step = (tally.contact_moment / area, tally.binary_moment / area, tally.kinetic_moment)
    moments = (x for moment in per_step for x in symmetric(np.asarray(moment)) / DT)
    tally_sums = np.array([tally.impulse, tally.binary_impulse, *moments], float)
    scale = np.repeat([np.max(np.abs(part)) for part in np.split(sums, [2, 5, 8])], [2, 3, 3, 3])
    np.testing.assert_allclose(tally_sums / scale, sums / scale, atol=1e-6)
    moved = displacement(after.positions, jnp.asarray(at[0]), after.side, after.tilt)
    np.testing.assert_allclose(moved, 0, atol=1e-7)
    np.testing.assert_allclose(after.velocities, at[1], atol=1e-6)


def simpson(begin: np.ndarray, end: np.ndarray) -> list[tuple[float, np.ndarray]]:
    """Weights and values whose sum of squares is the mean over a flight at linear velocities."""
    return [(1 / 6, begin), (4 / 6, (begin + end) / 2), (1 / 6, end)]


def symmetric(tensor: np.ndarray) -> np.ndarray:
    return np.array([tensor[0, 0], tensor[0, 1], tensor[1, 1]])


def hard_discs(state: State) -> event_driven.Discs:
    """The discs of a state, none of which has collided before."""
    grains, never = state.grains, np.full(len(state.positions), -np.inf)
    arrays = (grains.radii, grains.masses, state.positions, state.velocities)
    return event_driven.Discs(
        *(np.array(x, float) for x in arrays), never, float(state.side), float(state.tilt)
    )


FLOWS = [(0.9, 0.4), (0.9, 0.6), (0.7, 0.4), (0.7, 0.6), (0.5, 0.5), (0.8, 0.7)]
COUNT, STRAIN, BLOCKS = 128, 2000.0, 20


@pytest.mark.parametrize(("restitution", "packing_fraction"), FLOWS)
def test_averages_are_those_of_event_driven_discs(restitution, packing_fraction) -> None:
    """Hard discs without a time step; an error of 5 % of either stress would be seen."""
    flow = jg.ShearFlow(COUNT, restitution, packing_fraction, 3e-4)
    state = jg.prepare(flow, jax.random.key(0), engine=jg.Numba())
    _, sample = jg.sample(flow, state, STRAIN, engine=jg.Numba())
    law = event_driven.Law(restitution)
    discs, _ = event_driven.sheared(hard_discs(state), law, 50.0)
    discs, sums = event_driven.sheared(discs, law, STRAIN, BLOCKS)
    averages, errors = event_driven.averages(sums, discs), sample.errors()
    for name in ("pressure", "shear_stress", "granular_temperature"):
        ours, theirs = float(getattr(sample, name)), float(np.mean(averages[name]))
        error = np.hypot(float(errors[name]), np.std(averages[name], ddof=1) / np.sqrt(BLOCKS))
        assert 4 * error < 0.05 * theirs, (name, error / theirs)
        assert abs(ours - theirs) < 3.5 * error, (name, ours, theirs, error)
