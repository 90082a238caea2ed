"""Every public name is transformed by JAX, or says that it is not; nothing runs here."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import pytest
from flows import GRAINS, flow_of
from synthetic import refused, snapshot_of

import jaxgran as jg
from jaxgran.model.checks import InputError
from jaxgran.model.state import State

COUNT = GRAINS
STEPS = jnp.int32(20)
FLOW = flow_of(0.7)
KEY = jax.random.key(0)
PAIR = jg.DelassusProblem(jnp.eye(2), -jnp.ones(2))
X = 0.6  # a restitution, a packing fraction, a length


@cache
def seen() -> jg.Snapshot:
    """Two grains in contact, of a series of one time."""
    series = snapshot_of([[[1.0, 1.0], [2.0, 1.0]]], [[(0, 1, 0.1)]])
    return jax.tree.map(lambda x: jnp.asarray(x[0]), series)


def traced_sample(x: Any, state: State) -> jg.Sample:
    """A sample whose numbers are all one that JAX traces."""
    shapes = jax.eval_shape(lambda state: jg.sample(FLOW, state, 0.1, blocks=2)[1], state)
    return jax.tree.map(lambda one: (x + jnp.zeros(one.shape)).astype(one.dtype), shapes)


# Functions of one number, and of a state that is closed over.
TRANSFORMED: dict[str, Callable[[Any, State], Any]] = {
    "advance": lambda x, state: jg.advance(replace(FLOW, restitution=x), state, STEPS),
    "sample": lambda x, state: (
        jg.sample(replace(FLOW, restitution=x), state, 0.1, blocks=2)[1].averages
    ),
    "snapshot_series": lambda x, state: jg.snapshot_series(
        replace(FLOW, restitution=x), state, 0.1, 2
    ),
    "count_events": lambda x, state: jg.count_events(replace(FLOW, restitution=x), state, STEPS),
    "pack": lambda x, state: jg.pack(replace(FLOW, packing_fraction=x), KEY, state.grains),
    "polydisperse": lambda x, _: jg.polydisperse(COUNT, x / 2, KEY),
    "own_grains": lambda x, _: jg.own_grains(x + jnp.arange(4.0)),
    "grid": lambda x, _: jg.grid(x, 3),
    "fields_at": lambda x, _: jg.fields_at(seen(), jnp.asarray([[1.0, 1.2]]), x),
    "jax_md_space": lambda x, state: jg.jax_md_space(replace(state, tilt=x))[2],
    "solve_contacts": lambda x, _: jg.solve_contacts(PAIR, x).velocities,
    "validity": lambda x, _: jg.validity(x, 0.7).measured,
    "constitutive_law": lambda x, _: jg.constitutive_law()(x, 0.7, 2 * x),
}
NOT_BACKWARD = {"advance", "sample", "snapshot_series", "count_events", "pack"}
# Those take long to trace with their tangents; the derivatives of an advance are in the tests of
# the gradients.
LONG = {"count_events", "pack", "advance", "sample", "snapshot_series"}

REFUSED: dict[str, Callable[[Any, State], Any]] = {
    "prepare": lambda x, _: jg.prepare(replace(FLOW, restitution=x), KEY),
    "heated": lambda x, _: jg.heated(FLOW, KEY, grains=jg.own_grains(x * jnp.ones(COUNT))),
    "fit_trajectory": lambda x, state: jg.fit_trajectory(
        replace(FLOW, restitution=x), state, state, 9, 1e-3, 1e-3
    ),
    "flow_figure": lambda x, _: jg.flow_figure(replace(seen(), restitution=x)),
    "Sample": lambda x, state: traced_sample(x, state).errors(),
    "ratio_map": lambda x, _: jg.ratio_map([x], [0.6]),
}

# Classes, and what takes datasets and files.
WITHOUT_ARRAYS = """
    ContactNetwork DelassusProblem Grains InputError ShearFlow Snapshot State Status Tally
    averages_against_grains cluster_shares explore ratio_against_timestep ratio_contours
    ratio_curves BarzilaiBorwein Jacobi Nesterov ProjectedMethod Jax Numba merge_maps open_map
    read_trajectory save_figures theory_errors enskog_factors write_trajectory use_cache
"""


@pytest.fixture(scope="module")
def state(flowing) -> State:
    return flowing(0.7)


def test_every_public_name_is_among_these() -> None:
    assert {*TRANSFORMED, *REFUSED, *WITHOUT_ARRAYS.split()} == set(jg.__all__)


@pytest.mark.parametrize("name", TRANSFORMED)
def test_jit_vmap_and_lax_map_apply(name: str, state: State) -> None:
    numbers = jnp.asarray([X, X])

    def one(x):
        return TRANSFORMED[name](x, state)

    def shapes(function, x):
        return [leaf.shape for leaf in jax.tree.leaves(jax.eval_shape(function, x))]

    batch = [(2, *shape) for shape in shapes(one, X)]
    assert shapes(jax.vmap(one), numbers) == shapes(lambda x: jax.lax.map(one, x), numbers) == batch


@pytest.mark.parametrize("name", sorted(TRANSFORMED.keys() - LONG))
def test_derivatives_in_forward_mode_apply(name: str, state: State) -> None:
    values, changes = jax.eval_shape(
        lambda x: jax.jvp(lambda y: TRANSFORMED[name](y, state), (x,), (1.0,)), X
    )
    assert jax.tree.map(lambda x: x.shape, values) == jax.tree.map(lambda x: x.shape, changes)


def total(values: Any) -> Any:
    return sum(jnp.sum(x) for x in jax.tree.leaves(values) if jnp.issubdtype(x.dtype, jnp.floating))


@pytest.mark.parametrize("name", sorted(TRANSFORMED.keys() - NOT_BACKWARD))
def test_derivatives_in_reverse_mode_apply(name: str, state: State) -> None:
    assert jax.eval_shape(jax.grad(lambda x: total(TRANSFORMED[name](x, state))), X).shape == ()


@pytest.mark.parametrize(
    ("name", "transformed"),
    [
        *((name, how) for name in REFUSED for how in (jax.jit, jax.grad)),
        *((name, lambda f: lambda x: jax.vmap(f)(jnp.asarray([x]))) for name in REFUSED),
    ],
)
def test_what_computes_in_python_says_so(name: str, transformed: Callable, state: State) -> None:
    with refused():
        transformed(lambda x: REFUSED[name](x, state))(X)


def test_prepare_within_jit_says_so_whatever_it_is_given() -> None:
    with pytest.raises(
        InputError, match=r"^prepare cannot be transformed by jax.jit.*: call it before"
    ):
        jax.jit(lambda: jg.prepare(FLOW, KEY))()
