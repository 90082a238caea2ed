"""States, flows, samples and snapshots are values: compared, indexed, counted, averaged."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from synthetic import random_tally, refused, sample_of_tally, snapshot_of

import jaxgran as jg
from jaxgran.model.checks import InputError
from jaxgran.model.status import Status
from jaxgran.sampling.observables import OBSERVABLES
from jaxgran.sampling.sample import BLOCKS, Sample

TIMES = 4
FLOWS = jg.ShearFlow(16, [0.5, 0.9], 0.6, 1e-3)
SERIES = snapshot_of(
    np.random.default_rng(0).uniform(0, 40, (TIMES, 5, 2)), [[(0, 1, 0.1)], [], [], [(2, 3, 0.2)]]
)
SAMPLES = sample_of_tally(random_tally(np.random.default_rng(1), 2, BLOCKS), FLOWS[0])
VALUES = {
    "ShearFlow": FLOWS,
    "State": SERIES.state,
    "Grains": SERIES.state.grains,
    "Snapshot": SERIES,
    "Sample": SAMPLES,
    "Tally": SAMPLES.tally,
}
INDEXED = ("ShearFlow", "State", "Snapshot", "Sample")


@pytest.mark.parametrize("name", VALUES)
def test_a_value_equals_its_copy_and_nothing_else(name: str) -> None:
    value = VALUES[name]
    copy = jax.tree.map(jnp.array, value)
    assert (value == copy) is True and (value != copy) is False
    leaves, structure = jax.tree.flatten(value)
    other = jax.tree.unflatten(structure, [*leaves[:-1], np.asarray(leaves[-1]) + 1])
    shorter = jax.tree.map(lambda x: x[:1], value)
    assert (value == other) is False and (value == shorter) is False and value != 3


def test_nan_equals_nan_and_the_number_of_grains_counts() -> None:
    lost = replace(SAMPLES, area=np.array([np.nan, 1.0]))
    assert lost == jax.tree.map(jnp.asarray, lost) and lost != SAMPLES
    assert replace(SAMPLES, flow=replace(SAMPLES.flow, grains=17)) != SAMPLES


def test_equal_flows_have_equal_hashes_however_they_name_the_rule() -> None:
    named, numbered = (
        jg.ShearFlow(16, 0.5, 0.6, 1e-3, activation=rule) for rule in ("midpoint", 0.5)
    )
    assert named == numbered and len({named, numbered}) == 1
    with pytest.raises(TypeError, match="unhashable"):
        hash(FLOWS)


def test_values_that_jax_traces_are_not_compared() -> None:
    with refused("cannot be compared while JAX traces them"):
        jax.jit(lambda state: state == SERIES.state)(SERIES.state)


@pytest.mark.parametrize("name", INDEXED)
def test_a_value_with_an_axis_is_indexed_sliced_counted_and_iterated(name: str) -> None:
    value = VALUES[name]
    count = len(value)
    assert count == (2 if name in ("ShearFlow", "Sample") else TIMES)
    each = list(value)
    assert len(each) == count and value[-1] == each[-1] == value[count - 1] != value[0]
    assert len(value[1:]) == count - 1 and value[1:][0] == value[1] == value[[1, 0]][0]
    assert jax.tree.map(jnp.asarray, value)[[1, 0]] == value[[1, 0]]
    with pytest.raises(IndexError):
        value[count]
    with pytest.raises(InputError, match=f"this is one {name}, not a"):
        value[0][0]
    with pytest.raises(TypeError, match=f"this is one {name}, not a"):
        len(value[0])
    assert value and value[0]


def test_every_average_is_an_attribute_with_its_meaning() -> None:
    assert {*OBSERVABLES} <= {*dir(SAMPLES)}
    for name in OBSERVABLES:
        np.testing.assert_array_equal(getattr(SAMPLES, name), SAMPLES.averages[name])
    assert "shear stress over pressure, unit 1" in (Sample.macroscopic_friction.__doc__ or "")
    np.testing.assert_allclose(SAMPLES.strain, SAMPLES.tally.duration.sum(axis=1))


@pytest.mark.parametrize("one", [SAMPLES, SAMPLES[1]], ids=["batch", "one"])
def test_dataset_of_a_sample_has_its_averages_errors_and_units(one: Sample) -> None:
    data, errors = one.to_dataset(), one.errors()
    axes = ("replica",) if one is SAMPLES else ()
    for name, row in OBSERVABLES.items():
        np.testing.assert_array_equal(data[name], one.averages[name])
        np.testing.assert_array_equal(data[f"{name}_stderr"], errors[name])
        assert data[name].dims == (*axes, *row.axes)
        assert data[name].long_name == row.meaning
        assert data[name].attrs.get("reduced_unit", "1") == row.unit
    np.testing.assert_array_equal(data.strain, one.strain)
    for name in ("restitution", "packing_fraction", "timestep", "shear_rate"):
        np.testing.assert_array_equal(data[name], getattr(one.flow, name))
    assert data.attrs["version_jaxgran"] == jg.__version__ and "engine" in data.attrs
    worst = Status(int(np.max(one.status)))
    assert data.status.flag_meanings.split()[int(np.max(data.status))] == worst.name


def with_observed(observed: Any) -> Sample:
    return replace(SAMPLES, tally=replace(SAMPLES.tally, observed=observed))


def test_dataset_of_a_sample_has_what_was_observed() -> None:
    rng = np.random.default_rng(3)
    sums = {"torque": rng.uniform(1, 2, (2, BLOCKS)), "fabric": rng.uniform(1, 2, (2, BLOCKS, 3))}
    samples = with_observed(sums)
    data = samples.to_dataset()
    assert data.fabric.dims == ("replica", "fabric_dim_0")
    assert samples[0].to_dataset().fabric.dims == ("fabric_dim_0",)
    for name, x in sums.items():
        steps = SAMPLES.tally.steps.sum(axis=1).reshape(2, *[1] * (x.ndim - 2))
        np.testing.assert_allclose(data[name], x.sum(axis=1) / steps, rtol=1e-12)
        np.testing.assert_array_equal(data[f"{name}_stderr"][1], samples[1].observed()[1][name])
    with refused("names that a sample does not have, not 'pressure'"):
        with_observed({"pressure": sums["torque"]}).to_dataset()


def test_one_replica_of_states_that_share_their_grains_has_all_of_them() -> None:
    states = replace(SERIES.state, grains=SERIES.state[0].grains)
    assert np.shape(states.grains.radii) == (5,)
    assert states[1] == SERIES.state[1]
    assert states[1:3] == SERIES.state[1:3]


def test_observed_tells_what_is_missing() -> None:
    with refused("made without"):
        SAMPLES[0].observed()
    with refused(r"sample\[0\] of this batch"):
        with_observed({"x": np.ones((2, BLOCKS))}).observed()
