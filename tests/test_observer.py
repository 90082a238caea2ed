"""Observables of one's own: every time step counts once, forces exactly, and looking changes nothing."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiled_programs import exact_order
from synthetic import one_sentence

from jaxgran.dynamics import collision
from jaxgran.dynamics.snapshots import Snapshot
from jaxgran.model.checks import InputError
from jaxgran.model.flow import ShearFlow
from jaxgran.sampling.sample import BLOCKS, sample

GRAINS, STRAIN = pytest.GRAINS, 0.32
# With a method by name, looking and not looking take the same advance; with the default, not looking the machine code.
FLOW = ShearFlow(GRAINS, 0.6, 0.7, 1e-3, solver="nesterov")


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


def sampled(state, **options):
    """A sample whose sums are in the same order whatever else is compiled, with two sizes of the contact buffer."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(collision, "contact_capacities", lambda grains: (1, 3 * grains))
        measure = jax.jit(lambda flow, state: sample(flow, state, STRAIN, **options)).lower(FLOW, state)
    return measure.compile(exact_order())(FLOW, state)


@pytest.fixture(scope="module")
def observed(flowing):
    return sampled(flowing(0.7), observe=observe)


@pytest.fixture(scope="module")
def plain(flowing):
    return sampled(flowing(0.7))


def test_looking_changes_nothing(observed, plain) -> None:
    np.testing.assert_array_equal(observed[0].positions, plain[0].positions)
    np.testing.assert_array_equal(observed[0].velocities, plain[0].velocities)
    jax.tree.map(np.testing.assert_array_equal, observed[1].tally, plain[1].tally)
    assert plain[1].own is None


def test_every_step_counts_once_in_every_block(observed) -> None:
    measured = observed[1]
    np.testing.assert_array_equal(measured.own["one"], measured.tally.steps)
    np.testing.assert_array_equal(measured.own["inside"], measured.tally.steps)


def test_forces_are_averaged_exactly(observed, plain) -> None:
    """The stress of the contacts, their number and their errors are the engine's own, to rounding."""
    means, errors = observed[1].observed()
    np.testing.assert_allclose(means["stress"], plain[1].contact_stress, rtol=1e-12)
    np.testing.assert_allclose(errors["stress"], plain[1].errors()["contact_stress"], rtol=1e-9)
    assert 2 * means["pushes"] / GRAINS == pytest.approx(float(plain[1].averages["coordination_number"]), rel=1e-12)


def test_velocities_are_averaged_up_to_the_strain_of_a_flight(observed, plain) -> None:
    # at the beginning of a flight of strain γ, T is too small by γ |T_xy| / 2, with |T_xy| < T
    means, _ = observed[1].observed()
    flight = STRAIN / float(jnp.sum(plain[1].tally.solves))
    assert means["temperature"] == pytest.approx(float(plain[1].granular_temperature), rel=2 * flight)


def test_error_of_a_ratio_is_that_of_the_ratio(observed) -> None:
    length, error = observed[1].observed(lambda mean: {"length": mean["length"] / mean["pushes"]})
    sums = observed[1].own
    assert length["length"] == pytest.approx(float(jnp.sum(sums["length"]) / jnp.sum(sums["pushes"])))
    assert 0.9 < length["length"] < 1.1
    assert 0 < error["length"] < 0.05


def test_callback_is_told_of_every_block_and_may_end_the_sample(flowing) -> None:
    """By the machine code, which compiles quickest; with an observable it is the other engine: see the slow test."""
    flow, told = ShearFlow(GRAINS, 0.6, 0.7, 1e-3), []
    end, whole = sample(flow, flowing(0.7), STRAIN)

    def callback(state, so_far):
        told.append((state, so_far))
        return len(told) == 5

    state, short = sample(flow, flowing(0.7), STRAIN, callback=callback)
    assert [len(so_far.tally.steps) for _, so_far in told] == [1, 2, 3, 4, 5]
    np.testing.assert_array_equal(short.tally.steps, whole.tally.steps[:5])
    np.testing.assert_allclose(short.tally.impulse, whole.tally.impulse[:5], rtol=1e-9)
    np.testing.assert_array_equal(state.positions, told[-1][0].positions)
    told_end, told_whole = sample(flow, flowing(0.7), STRAIN, callback=lambda *_: None)
    np.testing.assert_array_equal(told_whole.tally.steps, whole.tally.steps)
    np.testing.assert_allclose(told_end.velocities, end.velocities, atol=1e-9)


@pytest.mark.slow
def test_callback_and_observable_together_find_what_the_observable_finds_alone(flowing, observed) -> None:
    _, told = sample(FLOW, flowing(0.7), STRAIN, observe=observe, callback=lambda *_: None)
    np.testing.assert_array_equal(told.own["one"], observed[1].own["one"])
    np.testing.assert_allclose(told.own["stress"], observed[1].own["stress"], rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize("axis_name", [pytest.param("replica", marks=pytest.mark.slow), None])
def test_transformations_apply(flowing, axis_name) -> None:
    states = jax.tree.map(lambda *x: jnp.stack(x), flowing(0.7), flowing(0.7, 1))

    def shear(states):
        if axis_name is None:
            return jax.lax.map(lambda state: sample(FLOW, state, STRAIN, observe=observe), states)
        return jax.vmap(lambda state: sample(FLOW, state, STRAIN, observe=observe), axis_name=axis_name)(states)

    _, both = jax.eval_shape(shear, states)
    assert both.own["stress"].shape == (2, BLOCKS, 2, 2)


@pytest.mark.slow
def test_a_batch_observes_what_each_of_it_observes(flowing, observed) -> None:
    states = jax.tree.map(lambda *x: jnp.stack(x), flowing(0.7), flowing(0.7, 1))
    shear = jax.jit(jax.vmap(lambda state: sample(FLOW, state, STRAIN, observe=observe), axis_name="replica"))
    _, both = shear(states)
    np.testing.assert_array_equal(both.own["one"], both.tally.steps)
    np.testing.assert_allclose(both.own["stress"][0], observed[1].own["stress"], rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"observe": 3}, "observe must be a function or None, not 3"),
        ({"callback": "tell"}, "callback must be a function or None, not 'tell'"),
        ({"observe": lambda seen: seen.impulses}, "observe must return sums over the contacts"),
        ({"observe": lambda _: 1j}, "observe must return real numbers"),
        ({"observe": lambda _: "much"}, "observe must return real numbers"),
    ],
)
def test_what_cannot_be_observed_is_refused_in_one_sentence(flowing, changed: dict, words: str) -> None:
    with pytest.raises(InputError, match=words) as caught:
        sample(FLOW, flowing(0.7), STRAIN, **changed)
    assert one_sentence(str(caught.value))


def test_callback_is_refused_under_a_transformation(flowing) -> None:
    with pytest.raises(InputError, match="callback must be None where"):
        jax.jit(lambda state: sample(FLOW, state, STRAIN, callback=print))(flowing(0.7))


def test_what_was_not_observed_cannot_be_asked_for(plain) -> None:
    with pytest.raises(InputError, match="sampled with observe"):
        plain[1].observed()
