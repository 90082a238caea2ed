"""Observables of one's own: each step counts once, forces exactly; looking changes nothing."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flows import COUNTS, GRAINS, assert_same_state

from jaxgran.contact.projected_methods import BarzilaiBorwein
from jaxgran.dynamics.advance import advance
from jaxgran.dynamics.engine import Jax, Numba
from jaxgran.dynamics.numba_engine import observed as records
from jaxgran.dynamics.observer import Observed, middle_of_flight
from jaxgran.dynamics.snapshot import Snapshot, snapshot_of
from jaxgran.model.checks import InputError
from jaxgran.model.flow import ShearFlow
from jaxgran.sampling.sample import BLOCKS
from jaxgran.sampling.sampler import sample
from jaxgran.sampling.steady_state import prepare

STRAIN = 0.32
FLOW = ShearFlow(GRAINS, 0.6, 0.7, 1e-3)  # by the numba engine


def observe(seen: Snapshot) -> dict:
    forces, n = seen.impulses / seen.timestep, seen.contacts.normals
    stress = jnp.einsum("c,ca,cb->ab", forces * seen.contacts.distances, n, n) / seen.state.side**2
    kinetic = seen.state.grains.masses * jnp.sum(seen.state.velocities**2, axis=1) / 2
    pushes = seen.impulses > 0
    return {
        "one": 1,
        "stress": stress,
        "temperature": jnp.mean(kinetic),
        "pushes": jnp.sum(pushes),
        "length": jnp.sum(jnp.where(pushes, seen.contacts.distances, 0)),
        "inside": jnp.all((seen.state.positions >= 0) & (seen.state.positions < seen.state.side)),
    }


def all_of_step(flow, state, contacts, impulses) -> dict:
    """The same for an advance."""
    return observe(snapshot_of(flow, state, contacts, impulses, jnp.int32(0)))


@pytest.fixture(scope="module")
def observed(flowing):
    return sample(FLOW, flowing(0.7), STRAIN, observe=observe)


@pytest.fixture(scope="module")
def plain_sample(flowing):
    return sample(FLOW, flowing(0.7), STRAIN)


def test_looking_changes_no_bit_of_a_block(flowing) -> None:
    state, measured = sample(FLOW, flowing(0.7), STRAIN, 1, observe)
    unobserved = state, replace(measured, tally=replace(measured.tally, observed=None))
    jax.tree.map(np.testing.assert_array_equal, unobserved, sample(FLOW, flowing(0.7), STRAIN, 1))


def test_every_step_counts_once_in_every_block(observed) -> None:
    measured = observed[1]
    np.testing.assert_array_equal(measured.observed_sums["one"], measured.tally.steps)
    np.testing.assert_array_equal(measured.observed_sums["inside"], measured.tally.steps)


def test_forces_are_averaged_exactly(observed, plain_sample) -> None:
    """Stress and number of contacts and their errors are the engine's, to rounding."""
    means, errors = observed[1].observed()
    np.testing.assert_allclose(means["stress"], plain_sample[1].contact_stress, rtol=1e-12)
    np.testing.assert_allclose(
        errors["stress"], plain_sample[1].errors()["contact_stress"], rtol=1e-9
    )
    assert 2 * means["pushes"] / GRAINS == pytest.approx(
        float(plain_sample[1].averages["coordination_number"]), rel=1e-12
    )


def test_velocities_are_averaged_up_to_the_strain_of_a_flight(observed, plain_sample) -> None:
    # at the beginning of a flight of strain γ, T is too small by γ |T_xy| / 2, with |T_xy| < T
    means, _ = observed[1].observed()
    flight = STRAIN / float(jnp.sum(plain_sample[1].tally.solves))
    assert means["temperature"] == pytest.approx(
        float(plain_sample[1].granular_temperature), rel=2 * flight
    )


@pytest.mark.parametrize(("engine", "strain"), [(Numba(), 100.0), (Jax(), 10.0)])
def test_kinetic_averages_of_a_dilute_flow_are_the_exact_ones(engine, strain) -> None:
    """Its flights are long. At their beginnings grains are too cold by 1 to 2 %."""
    flow = ShearFlow(16, 0.3, 0.1, 1e-3)
    state = prepare(flow, jax.random.key(1), equilibrate=2.0)
    _, measured = sample(flow, state, strain, observe=observe, engine=engine)
    exact = float(measured.granular_temperature)
    assert measured.observed()[0]["temperature"] == pytest.approx(exact, rel=2e-3)
    assert measured.errors()["granular_temperature"] > 2e-3 * exact


def test_error_of_a_ratio_is_that_of_the_ratio(observed) -> None:
    length, error = observed[1].observed(lambda mean: {"length": mean["length"] / mean["pushes"]})
    sums = observed[1].observed_sums
    assert length["length"] == pytest.approx(
        float(jnp.sum(sums["length"]) / jnp.sum(sums["pushes"]))
    )
    assert 0.9 < length["length"] < 1.1
    assert 0 < error["length"] < 0.1  # of a sample shorter than its correlation


def test_records_that_fill_their_room_go_on_in_the_next(observed, flowing, monkeypatch) -> None:
    """With room for three, a call ends after every other step with contacts; none counts twice."""
    monkeypatch.setattr(records, "_MOST_ROOM", 3)
    steps = jnp.int32(320)
    end, tally = jax.jit(lambda state: advance(FLOW, state, steps, observe))(flowing(0.7))
    own = tally.observed
    plain_end, plain = jax.jit(lambda state: advance(FLOW, state, steps))(flowing(0.7))
    assert_same_state(end, plain_end, 1e-9)
    for name in COUNTS:
        assert getattr(tally, name) == getattr(plain, name), name
    assert tally.solves == jnp.sum(observed[1].tally.solves) > 50
    assert own["one"] == own["inside"] == tally.steps == 320
    np.testing.assert_allclose(
        own["stress"] * FLOW.timestep * end.side**2, tally.contact_moment, rtol=1e-12
    )
    assert own["temperature"] == pytest.approx(
        float(jnp.sum(observed[1].observed_sums["temperature"])), rel=1e-3
    )


def test_engine_jax_observes_the_same(flowing, run) -> None:
    state, steps = flowing(0.7), jnp.int32(200)
    end, tally = jax.jit(lambda state: advance(FLOW, state, steps, observe, engine=Jax()))(state)
    own = tally.observed
    plain_end, plain_tally = run(FLOW, state, 200, solver=BarzilaiBorwein())
    np.testing.assert_allclose(end.velocities, plain_end.velocities, atol=1e-9)
    assert tally.solves == plain_tally.solves > 20
    assert own["one"] == own["inside"] == 200
    np.testing.assert_allclose(
        own["stress"] * FLOW.timestep * state.side**2, tally.contact_moment, rtol=1e-12
    )
    recorded = jax.jit(lambda state: advance(FLOW, state, steps, observe))(state)[1].observed
    assert own.keys() == recorded.keys()
    for name in own:
        np.testing.assert_allclose(own[name], recorded[name], rtol=1e-3, atol=1e-3, err_msg=name)


def test_what_is_observed_may_depend_on_what_is_differentiated(flowing) -> None:
    """The sums are then those of the engine "jax", which derivatives go through."""

    def found(scale):
        _, measured = sample(
            FLOW, flowing(0.7), STRAIN, observe=lambda seen: scale * jnp.sum(seen.impulses)
        )
        return measured.observed_sums

    primals, tangents = jax.jit(lambda scale: jax.jvp(found, (scale,), (1.0,)))(2.0)
    assert primals.shape == (BLOCKS,)
    np.testing.assert_allclose(primals, 2 * tangents, rtol=1e-12)
    each = jax.jit(jax.vmap(found))(jnp.asarray([1.0, 2.0]))
    np.testing.assert_allclose(each, [tangents, primals], rtol=1e-9)


def test_callback_is_told_of_every_block_and_may_end_the_sample(flowing) -> None:
    told, sampled = [], partial(sample, FLOW, flowing(0.7), STRAIN, 8)
    end, whole = sampled()

    def callback(state, so_far):
        told.append((state, so_far))
        return len(told) == 5

    state, short = sampled(callback=callback)
    assert [len(so_far.tally.steps) for _, so_far in told] == [1, 2, 3, 4, 5]
    np.testing.assert_array_equal(short.tally.steps, whole.tally.steps[:5])
    np.testing.assert_allclose(short.tally.impulse, whole.tally.impulse[:5], rtol=1e-9)
    np.testing.assert_array_equal(state.positions, told[-1][0].positions)
    told_end, told_whole = sampled(callback=lambda *_: None)
    np.testing.assert_array_equal(told_whole.tally.steps, whole.tally.steps)
    np.testing.assert_allclose(told_end.velocities, end.velocities, atol=1e-9)


def test_callback_is_refused_under_a_transformation(flowing) -> None:
    with pytest.raises(InputError, match="callback must be None where"):
        jax.jit(lambda state: sample(FLOW, state, STRAIN, callback=print))(flowing(0.7))


def test_the_fewest_records_of_a_call_give_the_same_sums(flowing, observed, monkeypatch) -> None:
    monkeypatch.setattr(records, "_MOST_BYTES", 1)
    _, own = sample(FLOW, flowing(0.7), STRAIN, observe=lambda seen: observe(seen))
    same = partial(np.testing.assert_allclose, rtol=1e-9)  # by other lists of near pairs
    same(own.observed_sums.pop("temperature"), observed[1].observed_sums["temperature"], rtol=1e-3)
    jax.tree.map(
        same,
        own.observed_sums,
        {name: observed[1].observed_sums[name] for name in own.observed_sums},
    )


@pytest.mark.parametrize(("step_observed", "middle"), [(0.0, 2.5), (1.0, 3.0)])
def test_a_flight_is_observed_in_the_middle_of_its_steps_that_are_not_in_the_sums(
    step_observed: float, middle: float
) -> None:
    assert middle_of_flight(Observed(None, jnp.asarray(step_observed)), jnp.int32(5)) == middle
