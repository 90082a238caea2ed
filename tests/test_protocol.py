"""A flow starts as theory says, is sheared until steady, and its time step is shortened."""

import re
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flows import assert_same_bits, replica
from synthetic import one_sentence

from jaxgran.dynamics.batch import run_batch, stack
from jaxgran.dynamics.engine import Numerics
from jaxgran.model.checks import InputError
from jaxgran.model.flow import ShearFlow
from jaxgran.model.status import Status
from jaxgran.sampling import sample_batch as extension
from jaxgran.sampling import steady_state, timestep
from jaxgran.sampling.blocks import Batch
from jaxgran.sampling.heated import heat_replica, replicas_of_keys
from jaxgran.sampling.observe import advance_batch, reporting
from jaxgran.sampling.prediction import predicted
from jaxgran.sampling.sample import Sample, relative_error
from jaxgran.sampling.sample_batch import sample_batch
from jaxgran.sampling.steady_state import prepare, prepare_batch
from jaxgran.sampling.timestep import check_timestep

GRAINS, TIMESTEP = 32, 1e-2  # with keys that are numbers, as in a map: compiled once
FLOWS = [ShearFlow(GRAINS, alpha, 0.6, TIMESTEP) for alpha in (0.5, 0.9)]


def with_timesteps(*timesteps: float) -> ShearFlow:
    return stack([replace(flow, timestep=dt) for flow, dt in zip(FLOWS, timesteps, strict=True)])


@pytest.fixture(scope="module")
def keys() -> jax.Array:
    return jax.random.split(jax.random.PRNGKey(0), 2)


@pytest.fixture(scope="module")
def batch(keys) -> Batch:
    """Two replicas, sheared by 0.5."""
    return prepare_batch(stack(FLOWS), keys, equilibrate=0.5)


def test_same_key_gives_the_same_state_and_another_key_another(batch, keys) -> None:
    assert_same_bits(prepare_batch(stack(FLOWS), keys, equilibrate=0.5).state, batch.state)
    other = prepare_batch(stack(FLOWS), keys[::-1], equilibrate=0.5)
    assert not np.any(np.asarray(other.state.velocities) == np.asarray(batch.state.velocities))
    np.testing.assert_array_equal(batch.strain, 0.5)


def test_start_has_the_temperature_asked_for_and_no_momentum(keys) -> None:
    temperature = jnp.asarray([0.3, 2.0])
    state, found = run_batch(heat_replica, (stack(FLOWS), keys, temperature, None))
    masses, velocities = np.asarray(state.grains.masses), np.asarray(state.velocities)
    assert np.all(found)
    np.testing.assert_allclose(np.sum(masses[..., None] * velocities, axis=1), 0, atol=1e-12)
    measured = np.sum(masses[..., None] * velocities**2, axis=(1, 2)) / (2 * GRAINS)
    np.testing.assert_allclose(measured, temperature, rtol=1e-12)
    assert np.all(state.tilt == 0)


def test_shearing_ends_for_each_replica_when_it_is_steady(monkeypatch) -> None:
    rng, sheared = np.random.default_rng(3), []

    def shear(batch: Batch, strain: np.ndarray, *_):
        sheared.append(strain)
        n = len(sheared)
        temperature = np.exp(
            [0.02 * rng.normal(), n / 10, rng.normal(), 0.02 * rng.normal(), np.nan]
        )
        pressure = np.exp([0.02 * rng.normal(), 0.0, rng.normal(), -n / 10, np.nan])
        averages = {"granular_temperature": temperature, "pressure": pressure}
        return batch, SimpleNamespace(averages=averages)

    monkeypatch.setattr(steady_state, "shear_by_block", shear)
    monkeypatch.setattr(steady_state, "_with_correlation_strain", lambda batch, _: batch)
    start: Any = SimpleNamespace(side=np.full(5, 10.0))
    status = np.array([0, 0, 0, 0, Status.nonfinite])
    flow = stack([FLOWS[0]] * 5)
    end = steady_state._until_steady(
        Batch(flow, Numerics(), start, status, np.zeros(5), np.full(5, 3.2)), None
    )
    bad = Status.not_steady
    # the third only fluctuates
    np.testing.assert_array_equal(end.status, [Status.ok, bad, Status.ok, bad, Status.nonfinite])
    strain = np.array(sheared)
    assert np.all(strain[:, 4] == 0)  # no work is done for a replica that is not finite
    np.testing.assert_allclose(end.strain, strain.sum(axis=0))
    assert 9 <= np.count_nonzero(strain[:, 0]) < 30
    assert np.all(strain[:, 1] > 0)
    assert strain[0, 0] == 0.8  # a chunk is a quarter of the correlation strain


def test_time_steps_are_shortened_geometrically_to_the_one_asked_for(monkeypatch) -> None:
    record = []

    def sheared(batch: Batch, strain: np.ndarray, advance):
        record.append((np.asarray(batch.flow.timestep), strain))
        return batch

    monkeypatch.setattr(steady_state, "_sheared", sheared)
    flow, coarse = with_timesteps(1e-5, 2e-4), with_timesteps(1e-3, 1e-3)
    state: Any = SimpleNamespace(side=jnp.full(2, 10.0))
    end = steady_state._shortened(
        Batch(coarse, Numerics(), state, np.zeros(2), np.zeros(2), np.ones(2)), flow, None
    )
    timesteps = np.array([dt for dt, _ in record])
    strains = np.array([strain for _, strain in record])
    ladder = np.vstack([coarse.timestep, timesteps])
    np.testing.assert_allclose(ladder[1:, 0] / ladder[:-1, 0], 10**-0.5, rtol=1e-6)
    np.testing.assert_allclose(ladder[1:2, 1] / ladder[:1, 1], 0.2**0.5, rtol=1e-6)
    np.testing.assert_array_equal(timesteps[-1], flow.timestep)
    np.testing.assert_array_equal(strains[-1], 0.5)
    np.testing.assert_array_equal(strains[:-1] > 0, [[True, True], [True, False], [True, False]])
    assert end.flow is flow

    record.clear()
    steady_state._shortened(
        Batch(flow, Numerics(), state, np.zeros(2), np.zeros(2), np.ones(2)), flow, None
    )
    assert record == []


def test_preparation_of_a_replica_does_not_depend_on_the_time_steps_of_the_others(
    monkeypatch,
) -> None:
    monkeypatch.setattr(steady_state, "RELAXATION_STRAIN", 0.02)
    monkeypatch.setattr(steady_state, "SHORTENING_STRAIN", 0.02)
    flows = [ShearFlow(32, 0.5, 0.7, dt) for dt in (1e-2, 1e-3)]
    keys = jax.random.split(jax.random.PRNGKey(5), len(flows))
    together = prepare_batch(stack(flows), keys, equilibrate=0.1)
    for k, flow in enumerate(flows):
        alone = prepare_batch(stack([flow]), keys[k : k + 1], equilibrate=0.1)
        assert_same_bits(replica(together.state, k), replica(alone.state, 0))
        assert (together.strain[k], together.status[k]) == (alone.strain[0], alone.status[0])


def test_flow_is_steady_by_the_last_two_thirds_of_its_record(monkeypatch) -> None:
    """A jump before the sixth chunk is out of them after fifteen chunks; twelve are the fewest."""
    series = iter([5.0] * 5 + [0.001, -0.001] * 30)

    def shear(batch: Batch, *_):
        value = np.exp([next(series)])
        return batch, SimpleNamespace(averages={"granular_temperature": value, "pressure": value})

    monkeypatch.setattr(steady_state, "shear_by_block", shear)
    monkeypatch.setattr(steady_state, "_with_correlation_strain", lambda batch, _: batch)
    flow = stack([ShearFlow(32, 0.5, 0.6, 1e-3)])
    state: Any = SimpleNamespace(side=np.array([6.0]))
    end = steady_state._until_steady(
        Batch(flow, Numerics(), state, np.zeros(1, int), np.zeros(1), np.array([4.0])), None
    )
    assert end.status[0] == Status.ok
    assert end.strain[0] == pytest.approx(15 * 1.0)


def test_coarse_time_step_is_never_shorter_than_the_one_asked_for() -> None:
    flow = with_timesteps(1e-4, 2e-2)
    coarse = np.asarray(timestep.bounded_coarse_timestep(flow, predicted(flow)))
    assert coarse[0] == timestep.COARSE_TIMESTEP
    assert coarse[1] == 2e-2


@pytest.mark.parametrize("alphas", [(0.5, 0.9), (0.85, 0.4)])
def test_a_time_step_too_long_is_a_sentence_that_names_the_longest(
    alphas: tuple[float, float],
) -> None:
    flow = replace(
        with_timesteps(0.1, 0.1), restitution=jnp.asarray(alphas), packing_fraction=jnp.full(2, 0.4)
    )
    theory = predicted(flow)
    with pytest.raises(ValueError, match="timestep must be at most") as caught:
        check_timestep(flow, theory)
    message = str(caught.value)
    assert isinstance(caught.value, InputError)
    assert one_sentence(message)
    assert f"restitution {max(alphas)} and packing fraction 0.4" in message  # the hotter of the two
    longest = float(re.search(r"at most ([\d.e+-]+) at", message)[1])
    # at thermal speed
    crossed = longest * np.sqrt(2 * np.max(np.asarray(theory.granular_temperature)))
    assert 0.09 < crossed <= 0.1
    check_timestep(replace(flow, timestep=jnp.full(2, longest)), theory)


def test_prepare_of_many_keys_gives_the_state_of_each(batch, keys) -> None:
    """Whether numbers of the flow are single or of the batch, and with grains of all or of each."""
    flows = replace(FLOWS[0], restitution=jnp.asarray([0.5, 0.9]))
    states = prepare(flows, keys, equilibrate=0.5)
    assert_same_bits(states, jax.tree.map(jnp.asarray, batch.state))
    assert_same_bits(states[1], prepare(FLOWS[1], keys[1], equilibrate=0.5))
    grains = states.grains
    given = replicas_of_keys(flows, keys, jax.tree.map(lambda x: x[0], grains))[2]
    np.testing.assert_array_equal(given.radii, jnp.stack([grains.radii[0]] * 2))
    assert_same_bits(replicas_of_keys(flows, keys, grains)[2], grains)


def test_prepare_names_the_replicas_that_failed(batch, keys, monkeypatch) -> None:
    bad = batch._replace(status=np.array([Status.ok, Status.not_steady]))
    monkeypatch.setattr(steady_state, "prepare_batch", lambda *_, **__: bad)
    with pytest.raises(
        RuntimeError, match=r"^not all replicas could be prepared: 1 \(not_steady\); .*`states`"
    ) as caught:
        prepare(FLOWS[0], keys)
    assert caught.value.states[0] == batch.state[0] and caught.value.status[0] == Status.ok


def test_nan_in_one_replica_ends_as_nonfinite_and_leaves_the_others_bit_identical(batch) -> None:
    velocities = jnp.asarray(batch.state.velocities).at[1, 5, 0].set(jnp.nan)
    broken = batch._replace(state=replace(batch.state, velocities=velocities))
    end, measured = sample_batch(batch, strain=1.6)
    broken_end, broken_measured = sample_batch(broken, strain=1.6)
    assert broken_end.status[1] == Status.nonfinite
    assert broken_end.status[0] == end.status[0] < Status.nonfinite
    assert_same_bits(replica(broken_end.state, 0), replica(end.state, 0))
    assert_same_bits(replica(broken_measured, 0), replica(measured, 0))


def only(batch: Batch, k: int) -> Batch:
    """A batch of one replica of another."""
    numerics, replicas = batch.numerics, batch._replace(numerics=None)
    return jax.tree.map(lambda x: x[k : k + 1], replicas)._replace(numerics=numerics)


def test_a_replica_that_is_given_up_is_not_advanced_and_changes_no_other(batch) -> None:
    jammed = batch._replace(status=np.array([Status.ok, Status.infeasible]))
    end, measured = sample_batch(jammed, strain=0.64, error=1e-9)
    _, alone = sample_batch(only(batch, 0), strain=0.64, error=1e-9)
    assert_same_bits(replica(measured, 0), replica(alone, 0))
    assert end.status[1] == Status.infeasible and not np.any(measured.tally.steps[1])
    assert_same_bits(replica(end.state, 1), replica(batch.state, 1))


def test_sample_grows_until_its_error_is_small_and_each_replica_for_itself(
    batch, monkeypatch
) -> None:
    """Both start with a strain of 0.64, in 32 blocks of two steps; the limit is four times that."""
    monkeypatch.setattr(extension, "LONGEST_STRAIN", 2.56)
    monkeypatch.setattr(extension, "LONGEST_CORRELATION_STRAINS", 0)
    _, short = sample_batch(batch, 0.64)
    errors = [relative_error(replica(short, k)) for k in (0, 1)]
    target = np.mean(errors) if abs(np.subtract(*errors)) > 1e-3 else min(errors) * 0.9
    end, grown = sample_batch(batch, 0.64, error=float(target))
    strains = np.asarray(grown.tally.duration).sum(axis=1)
    for k in (0, 1):
        reached = relative_error(replica(grown, k)) <= target
        assert reached or end.status[k] >= Status.imprecise
        assert np.isclose(strains[k], 0.64) == (errors[k] <= target)
        assert reached or np.isclose(strains[k], 2.56)
        _, alone = sample_batch(only(batch, k), 0.64, error=float(target))
        assert_same_bits(replica(alone, 0), replica(grown, k))


def test_sample_that_has_grown_is_the_sample_of_its_strain(batch, monkeypatch) -> None:
    monkeypatch.setattr(extension, "LONGEST_STRAIN", 0.64)
    monkeypatch.setattr(extension, "LONGEST_CORRELATION_STRAINS", 0)
    _, grown = sample_batch(batch, 0.32, error=1e-9)
    _, whole = sample_batch(batch, 0.64)
    np.testing.assert_allclose(grown.tally.steps, whole.tally.steps)
    for name in ("duration", "impulse", "contact_moment", "kinetic_moment", "largest_overlap"):
        np.testing.assert_allclose(
            getattr(grown.tally, name), getattr(whole.tally, name), rtol=1e-6, atol=1e-12
        )


def test_report_is_told_every_replica_step(batch) -> None:
    told = []
    sample_batch(batch, 1.6, reporting(advance_batch, lambda _, steps: told.append(np.sum(steps))))
    assert sum(told) == 2 * round(1.6 / TIMESTEP)


def test_a_sample_lasts_six_memories_and_one_of_less_than_four_says_so(batch, monkeypatch) -> None:
    monkeypatch.setattr(extension, "LEAST_SAMPLE", 0.5)
    monkeypatch.setattr(Sample, "correlation_strain", property(lambda _: ready.correlation_strain))
    ready = batch._replace(status=np.zeros(2, int), correlation_strain=np.array([0.2, 0.4]))
    _, long = sample_batch(ready, None)
    np.testing.assert_allclose(np.sum(long.tally.duration, axis=1), [1.2, 2.4])
    end, _ = sample_batch(ready, 1.0)
    assert (end.status[0] == Status.short_sample, end.status[1] >= Status.short_sample) == (
        False,
        True,
    )


def test_a_sample_for_an_error_is_at_least_twice_as_long_and_its_longest_strain_says_so(
    batch, monkeypatch
) -> None:
    monkeypatch.setattr(extension, "LEAST_SAMPLE", 0.32)
    monkeypatch.setattr(extension, "LONGEST_STRAIN", 0.64)
    monkeypatch.setattr(extension, "LONGEST_CORRELATION_STRAINS", 0)
    monkeypatch.setattr(Sample, "correlation_strain", property(lambda _: ready.correlation_strain))
    ready = batch._replace(status=np.zeros(2, int), correlation_strain=np.full(2, 0.01))
    for error, status in ((1e9, Status.ok), (1e-9, Status.imprecise)):
        end, measured = sample_batch(ready, None, error=error)
        np.testing.assert_allclose(np.sum(measured.tally.duration, axis=1), 0.64)
        np.testing.assert_array_equal(np.maximum(measured.status, status), end.status)


def test_a_preparation_shorter_than_the_correlation_strain_is_not_steady(batch) -> None:
    assert np.all(batch.correlation_strain > 0.5)  # the strain that it took
    assert np.all(batch.status == Status.not_steady)
