"""A sample is the strain asked for, in blocks that add up, where positions resolve it."""

import re
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flows import OF_INSTANTS, replica
from synthetic import one_sentence, random_tally, refused, sample_of_tally

from jaxgran.contact.projected_methods import BarzilaiBorwein
from jaxgran.dynamics.batch import stack
from jaxgran.dynamics.tally import EXTREMES, TABLE
from jaxgran.model.checks import InputError
from jaxgran.model.flow import ShearFlow
from jaxgran.model.state import State, require_state
from jaxgran.model.status import Status
from jaxgran.sampling import sample as sample_module
from jaxgran.sampling.averages import averages
from jaxgran.sampling.blocks import Batch
from jaxgran.sampling.observables import OBSERVABLES
from jaxgran.sampling.observe import advance_batch
from jaxgran.sampling.sample import BLOCKS, Sample, relative_error
from jaxgran.sampling.sampler import _sample, check_precision, sample
from jaxgran.sampling.steady_state import prepare, prepare_batch
from jaxgran.sampling.timestep import deepest_overlap

GRAINS, TIMESTEP, STRAIN = 64, 1e-2, 0.64
FLOWS = [ShearFlow(GRAINS, alpha, 0.6, TIMESTEP) for alpha in (0.5, 0.9)]


@pytest.fixture(scope="module")
def batch() -> Batch:
    # numbers, as in a map: compiled once for both
    keys = jax.random.split(jax.random.PRNGKey(0), 2)
    return prepare_batch(stack(FLOWS), keys, equilibrate=0.5)


@pytest.fixture(scope="module")
def state(batch) -> State:
    return replica(batch.state, 0)


@pytest.fixture(scope="module")
def measured(state) -> tuple[State, Sample]:
    return sample(FLOWS[0], state, STRAIN)


def test_strain_is_rounded_to_whole_steps_and_shared_among_the_blocks(state, measured) -> None:
    steps = np.asarray(measured[1].tally.steps)
    assert steps.shape == (BLOCKS,)
    np.testing.assert_array_equal(steps, 2)
    uneven = np.asarray(sample(FLOWS[0], state, 0.753)[1].tally.steps)  # 75 steps
    assert uneven.sum() == 75
    assert uneven.max() - uneven.min() == 1


def test_blocks_add_up_to_the_whole(batch, measured) -> None:
    steps = jnp.asarray([round(STRAIN / TIMESTEP)] * 2, jnp.int32)
    end, whole = advance_batch(batch.flow, batch.numerics, batch.state, steps)
    tally, whole = measured[1].tally, replica(whole, 0)
    for name in TABLE:
        if name not in (*EXTREMES, *OF_INSTANTS):
            np.testing.assert_allclose(
                np.sum(getattr(tally, name), axis=0), getattr(whole, name), rtol=1e-5, atol=1e-9
            )
    assert np.max(tally.largest_overlap) == pytest.approx(float(whole.largest_overlap), rel=1e-5)
    np.testing.assert_allclose(measured[0].velocities, end.velocities[0], atol=1e-6)
    assert np.sum(tally.duration) == pytest.approx(STRAIN)


def test_a_change_of_numbers_compiles_nothing_anew(state, measured) -> None:
    compiled = _sample._cache_size()
    solver = BarzilaiBorwein(tolerance=1e-5, max_steps=70)
    sample(replace(FLOWS[0], restitution=0.6, timestep=9e-3), state, 0.4, solver=solver)
    assert _sample._cache_size() == compiled


def test_averages_are_those_of_all_blocks_together() -> None:
    tally = random_tally(np.random.default_rng(0), BLOCKS)
    sample = sample_of_tally(tally, FLOWS[0])
    assert sample.force_ratio == pytest.approx(tally.impulse.sum() / tally.binary_impulse.sum())
    moment = (tally.contact_moment + tally.kinetic_moment).sum(axis=0)
    stress = moment / tally.duration.sum() / sample.area
    assert sample.pressure == pytest.approx(np.trace(stress) / 2)
    assert sample.shear_stress == pytest.approx(-stress[0, 1])
    assert sample.averages["max_overlap"] == tally.largest_overlap.max()
    for name in (
        "granular_temperature",
        "contact_stress",
        "binary_stress",
        "kinetic_stress",
        "stress_ratio",
    ):
        np.testing.assert_array_equal(getattr(sample, name), sample.averages[name])


def test_overlaps_are_judged_by_their_mean_over_the_gap_between_grains() -> None:
    """Whatever block they are in. At ν = 0.8386, where random discs jam, there is no gap; 64 grains
    come 0.016 closer to it, and at (0.5, 0.8) a mean overlap of 3.9e-4 put their pressure off by
    8 %.
    """
    tally = random_tally(np.random.default_rng(1), BLOCKS)
    densest = FLOWS[0].packing_fraction + 0.16 / GRAINS**0.55
    allowed = 0.0175 * (0.8386 - densest) / (2 * densest)
    tally.overlap[:] = 0

    def status() -> int:
        return int(sample_of_tally(tally, FLOWS[0]).status)

    tally.overlap[0] = 0.99 * allowed * tally.contacts.sum()  # all in one block
    assert status() == Status.ok
    tally.overlap[0] *= 1.03
    assert status() == Status.deep_overlap
    tally.status[3] = Status.capacity
    assert status() == Status.capacity
    assert deepest_overlap(0.8, GRAINS) < 3.9e-4 < deepest_overlap(0.8, 10**6)


def test_averages_and_errors_are_computed_once_and_cannot_be_written_to(monkeypatch) -> None:
    calls = []
    monkeypatch.setattr(
        sample_module, "averages", lambda *x, **y: (calls.append(1), averages(*x, **y))[1]
    )
    tally = random_tally(np.random.default_rng(2), BLOCKS)
    sample = sample_of_tally(tally, FLOWS[0])
    once = (sample.pressure, sample.contact_stress, sample.errors()["pressure"], len(calls))
    again = (sample.pressure, sample.contact_stress, sample.errors()["pressure"], len(calls))
    assert all(map(np.array_equal, once, again))
    sample.averages["pressure"] = sample.errors()["pressure"] = 0.0  # of a copy
    assert sample.pressure == once[0] and sample.errors()["pressure"] == once[2]
    with pytest.raises(ValueError, match="read-only"):
        sample.contact_stress[0, 0] = 0.0


def test_errors_of_a_batch_are_those_of_each_replica_which_an_index_takes() -> None:
    both = sample_of_tally(random_tally(np.random.default_rng(3), 2, BLOCKS), FLOWS[0])
    errors = both.errors()
    assert set(errors) == set(OBSERVABLES)
    for k, single in enumerate(both):
        jax.tree.map(np.testing.assert_array_equal, single, replica(both, k))
        for name, error in single.errors().items():
            np.testing.assert_array_equal(errors[name][k], error)
    np.testing.assert_array_equal(both[1:].pressure, both.pressure[1:])
    with pytest.raises(IndexError):
        both[2]
    with pytest.raises(InputError, match=r"^this is one Sample, not a batch, and has no index"):
        both[0][0]


def test_averages_of_a_sample_are_of_numpy_and_those_that_jax_traces(measured) -> None:
    """JAX would compile dozens of small sums at the first access."""
    assert all(isinstance(x, np.ndarray | np.generic) for x in measured[1].averages.values())
    traced = jax.jit(lambda traced_sample: (traced_sample.averages, traced_sample.status))(
        measured[1]
    )
    jax.tree.map(
        partial(np.testing.assert_allclose, rtol=1e-9, atol=1e-15), traced[0], measured[1].averages
    )
    assert traced[1] == measured[1].status


def in_float32(state: State) -> State:
    return jax.tree.map(lambda x: jnp.asarray(np.asarray(x), jnp.float32), state)


def test_float32_is_refused_where_it_cannot_resolve_the_time_step(state) -> None:
    with jax.enable_x64(False):
        single = in_float32(state)
        with pytest.raises(ValueError, match="float64") as caught:
            sample(replace(FLOWS[0], timestep=1e-5), single, 1.0)
        message = str(caught.value)
        assert one_sentence(message)
        assert "float32" in message
        least = float(re.search(r"at least ([\d.e+-]+) ", message)[1])
        assert 1e-5 < least < 1e-4
        check_precision(replace(FLOWS[0], timestep=least), single)
    check_precision(replace(FLOWS[0], timestep=1e-5), state)  # float64 resolves it


def test_a_flow_that_is_not_that_of_the_state_is_refused(state) -> None:
    nu = FLOWS[0].packing_fraction
    with refused(f"^packing_fraction must be {nu}, which the state has, not 0.601: "):
        sample(replace(FLOWS[0], packing_fraction=0.601), state, STRAIN)
    require_state(FLOWS[0], in_float32(state))


def test_a_sample_below_four_correlation_strains_says_so_however_it_is_taken(state) -> None:
    """Alone, compiled, in a batch, of ``vmap`` and block by block; nothing is compiled anew."""
    few = 0.32
    taken = [
        sample(FLOWS[0], state, few),
        jax.jit(lambda state: sample(FLOWS[0], state, few))(state),
        sample(FLOWS[0], state, few, 2, callback=lambda *_: False),
    ]
    assert [int(one.status) for _, one in taken] == [Status.short_sample] * 3
    assert all(one.tally.status[-1] > one.tally.status[0] == Status.ok for _, one in taken)
    both = jax.tree.map(lambda x: jnp.stack([jnp.asarray(x)] * 2), state)
    assert np.all(np.asarray(sample(FLOWS[0], both, few)[1].status) == Status.short_sample)
    assert np.all(
        jax.vmap(lambda one: sample(FLOWS[0], one, few)[1].status)(both) == Status.short_sample
    )
    compiled = _sample._cache_size()
    _, long = sample(FLOWS[0], state, 40.0)
    assert long.status == Status.ok and _sample._cache_size() == compiled


def test_another_block_of_a_callback_compiles_nothing(state) -> None:
    compiled, counts = [], []

    def listen(name: str, *_: object, **__: object) -> None:
        if len(counts) < 6 and name.endswith("backend_compile_duration"):
            compiled.append(name)

    def count(_: State, so_far: Sample) -> None:
        assert so_far.pressure > 0
        counts.append(len(compiled))

    jax.monitoring.register_event_duration_secs_listener(listen)
    jax.jit(lambda x: x + len(counts))(np.zeros(7))  # which is heard
    sample(FLOWS[0], state, 0.32, 6, callback=count)
    assert 0 < counts[0] == counts[-1] and len(counts) == 6


def test_spread_of_the_largest_of_one_block_is_unknown() -> None:
    block = sample_of_tally(random_tally(np.random.default_rng(2), 1), FLOWS[0])
    assert np.isnan(block.errors()["max_overlap"]) and np.isnan(block.errors()["pressure"])


def test_momentum_that_cannot_be_seen_before_is_a_status(state) -> None:
    """What a check refuses of numbers, compiled code can only report."""
    moving = replace(state, velocities=state.velocities + jnp.array([[0.0, 0.5]]))
    with refused("no total momentum"):
        sample(FLOWS[0], moving, 0.32)
    compiled = jax.jit(lambda state: sample(FLOWS[0], state, 0.32)[1].status)
    assert compiled(moving) == Status.not_steady
    assert compiled(moving.without_momentum()) < Status.not_steady


def test_a_force_ratio_without_a_cluster_has_the_error_of_those_it_may_have_missed() -> None:
    """Of n collisions none is in a cluster: up to 3/n may be, the rule of three."""
    tally = random_tally(np.random.default_rng(4), BLOCKS)
    binary = replace(tally, impulse=tally.binary_impulse, contact_moment=tally.binary_moment)
    measured = sample_of_tally(binary, FLOWS[0])
    expected = 3 / 1.96 / tally.collisions.sum()
    assert measured.errors()["force_ratio"] == pytest.approx(expected, rel=1e-12)
    assert measured.errors()["stress_ratio"][0, 0] == pytest.approx(expected, rel=0.2)
    assert np.isfinite(relative_error(measured))


def test_intervals_of_samples_shorter_than_their_correlation_hold() -> None:
    """64 windows of less than two correlation strains; nor are their errors far too large."""
    flow = ShearFlow(64, 0.9, 0.5, 1e-3)
    state = prepare(flow, jax.random.key(5))
    _, measured = sample(flow, state, 480.0, blocks=7680)
    windows = jax.tree.map(lambda x: np.asarray(x).reshape(64, 120, *x.shape[1:]), measured.tally)
    pressures, errors = [], []
    for k in range(64):
        window = replace(measured, tally=jax.tree.map(lambda x, k=k: x[k, :32], windows))
        assert window.strain < 2 * window.correlation_strain
        pressures.append(window.pressure)
        errors.append(window.errors()["pressure"])
    held = np.mean(np.abs(np.array(pressures) - measured.pressure) < 1.96 * np.array(errors))
    assert held > 0.95 - 4 * np.sqrt(0.95 * 0.05 / 64)
    assert np.median(errors) < 2 * np.std(pressures)
