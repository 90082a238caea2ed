"""ShearFlow: accepted ranges, refusals in one sentence, behaviour as a pytree."""

import re
from dataclasses import replace
from decimal import Decimal
from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
import xarray as xr
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxgran.model.checks import InputError
from jaxgran.model.choices import MAX_PACKING_FRACTION, MIN_GRAINS
from jaxgran.model.flow import ShearFlow, require_sheared, steps_of_strain

FLOW = ShearFlow(grains=64, restitution=0.5, packing_fraction=0.7, timestep=1e-3)
NUMBERS = ("restitution", "packing_fraction", "timestep", "shear_rate", "polydispersity")


def refusal(**change) -> str:
    with pytest.raises(ValueError) as caught:
        replace(FLOW, **change)
    return str(caught.value)


@pytest.mark.parametrize("array", [np.array, jnp.asarray])
def test_one_bad_replica_refuses_the_batch(array):
    assert re.match("restitution must be between 0 and 1", refusal(restitution=array([0.5, 1.5])))
    assert re.match("packing_fraction must be", refusal(packing_fraction=array([0.5, np.nan])))


@given(
    st.integers(MIN_GRAINS, 10**6),
    st.floats(0, 1),
    st.floats(0, MAX_PACKING_FRACTION, exclude_min=True),
    st.floats(0, 0.1, exclude_min=True),
)
def test_every_value_of_the_ranges_is_accepted(grains, restitution, packing_fraction, timestep):
    flow = ShearFlow(grains, restitution, packing_fraction, timestep)
    assert (flow.restitution, flow.packing_fraction, flow.timestep) == (
        restitution,
        packing_fraction,
        timestep,
    )


def test_a_flow_may_be_without_shear():
    assert replace(FLOW, shear_rate=0.0, timestep=7.0).shear_rate == 0
    for flow in (FLOW, replace(FLOW, shear_rate=jnp.array([1.0, 2.0]))):
        require_sheared(flow)
    for rate in (0.0, np.array([1.0, 0.0])):
        with pytest.raises(InputError, match="shear_rate must be above 0 where strain is counted"):
            require_sheared(replace(FLOW, shear_rate=rate))


def test_flow_is_a_pytree_of_its_numbers():
    leaves, structure = jax.tree.flatten(FLOW)
    assert leaves == [*(getattr(FLOW, name) for name in NUMBERS), 0.5]
    assert jax.tree.unflatten(structure, leaves) == replace(FLOW, activation=0.5)
    assert jax.tree.structure(replace(FLOW, activation="touching")) == structure
    assert jax.tree.structure(replace(FLOW, grains=65)) != structure


def test_batch_of_flows_is_a_flow_of_arrays():
    batch = replace(
        FLOW, restitution=np.array([0.1, 0.5, 0.9]), timestep=jnp.array([1e-3, 1e-4, 1e-5])
    )
    axes = jax.tree.map(lambda values: 0 if np.ndim(values) else None, batch)
    products = jax.vmap(lambda flow: flow.restitution * flow.timestep, in_axes=(axes,))(batch)
    np.testing.assert_array_equal(products, batch.restitution * np.asarray(batch.timestep))
    stacked = jax.tree.map(lambda *values: np.stack(values), FLOW, replace(FLOW, restitution=0.9))
    assert stacked.grains == 64
    np.testing.assert_array_equal(stacked.restitution, [0.5, 0.9])


def test_traced_numbers_are_not_judged():
    assert jax.jit(lambda value: replace(FLOW, restitution=value).restitution)(2.0) == 2.0
    slopes = jax.grad(lambda flow: flow.restitution * flow.timestep, allow_int=True)(FLOW)
    assert slopes.restitution == FLOW.timestep


@given(
    st.floats(1e-6, 0.0999),
    st.floats(0.1, 10),
    st.floats(0, 1e3),
    st.sampled_from([np.float32, np.float64]),
)
@settings(max_examples=50)
def test_time_steps_of_a_strain_are_the_same_bits_traced_or_not(
    dt: float, rate: float, strain: float, kind
) -> None:
    numbers = [kind(x) for x in (strain, rate, dt / rate)]

    def steps(strain, rate, dt):
        return steps_of_strain(replace(FLOW, shear_rate=rate, timestep=dt), strain)

    known, traced = steps(*numbers), jax.jit(steps)(*numbers)
    assert isinstance(known, np.generic | np.ndarray) and known.dtype == traced.dtype == kind
    assert known == traced == round(known.item())
    exact = strain / (rate * (dt / rate))
    assert abs(known - exact) <= 0.5 + 4 * np.finfo(kind).eps * exact


def test_time_steps_of_a_strain_are_those_of_each_flow_of_a_batch() -> None:
    flows = replace(FLOW, timestep=[1e-3, 2e-3])
    assert steps_of_strain(flows, 0.0204).tolist() == [20, 10]
    assert steps_of_strain(flows, np.array([0.0204, 0.0408])).tolist() == [20, 20]


@pytest.mark.parametrize("kind", [Decimal, Fraction, xr.DataArray, np.float16, jnp.bfloat16])
def test_a_number_of_any_library_is_a_number(kind) -> None:
    assert float(np.asarray(replace(FLOW, restitution=kind(0.5)).restitution)) == 0.5
    assert "must be between 0 and 1, not" in refusal(restitution=kind(1.5))


def test_what_is_no_number_is_named_by_its_type() -> None:
    assert replace(FLOW, restitution=pd.Series([0.5, 0.6])).restitution.tolist() == [0.5, 0.6]
    assert refusal(restitution=None).endswith(
        "as a number or an array of numbers, not None of type NoneType."
    )
