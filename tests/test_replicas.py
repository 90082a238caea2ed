"""A batch of flows has the results of its replicas: directly, under ``vmap``, one by one."""

import re
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flows import GRAINS
from synthetic import refused
from test_docs import python_of

import jaxgran as jg
from jaxgran.model.state import State
from jaxgran.sampling import sampler

ALPHAS, NUS = jnp.asarray([0.3, 0.5, 0.8]), jnp.asarray([0.5, 0.6, 0.7])
KEYS = jax.random.split(jax.random.key(0), 4)
FLOWS = jg.ShearFlow(GRAINS, restitution=ALPHAS, packing_fraction=NUS, timestep=1e-3)
sample = partial(jg.sample, blocks=4)


@pytest.fixture(scope="module")
def states() -> State:
    return jg.prepare(FLOWS, KEYS[:3], equilibrate=1.0)


def assert_same(one: Any, other: Any, but: str = "nothing") -> None:
    for (path, left), right in zip(
        jax.tree_util.tree_leaves_with_path(one), jax.tree.leaves(other), strict=True
    ):
        name = jax.tree_util.keystr(path)
        rtol = 4 * np.finfo(float).eps if but in name else 0
        np.testing.assert_allclose(left, right, rtol=rtol, atol=0, err_msg=name)


def test_numbers_that_are_the_same_for_all_replicas_are_broadcast() -> None:
    assert {np.shape(leaf) for leaf in jax.tree.leaves(FLOWS)} == {(3,)}
    assert_same(FLOWS[1], jg.ShearFlow(GRAINS, 0.5, 0.6, 1e-3))
    assert_same(replace(FLOWS, timestep=1e-4)[2], jg.ShearFlow(GRAINS, 0.8, 0.7, 1e-4))
    single = jg.ShearFlow(GRAINS, jnp.float32([0.5, 0.6]), 0.6, 1e-3)
    assert single.timestep.dtype == np.dtype(float) and single.timestep[0] == 1e-3
    half = jg.ShearFlow(GRAINS, np.float16([0.5, 0.6]), 0.6, 1e-8)
    assert_same(half[0], jg.ShearFlow(GRAINS, 0.5, 0.6, 1e-8))
    of_traced = jax.jit(lambda x: jg.ShearFlow(GRAINS, ALPHAS, x, 1e-3))(0.6)
    np.testing.assert_array_equal(of_traced.packing_fraction, 0.6)


def test_batch_is_sampled_as_under_vmap_and_as_one_by_one(states: State) -> None:
    """To the bit, but for waves under ``vmap``: cosines of vectors are rounded by their length."""
    together = sample(FLOWS, states, 0.3)
    vmapped = jax.vmap(sample, (0, 0, None))(FLOWS, states, 0.3)
    assert_same(together, vmapped, but="wave_kinetic")
    for k in range(3):
        assert_same(jax.tree.map(lambda x, k=k: x[k], together), sample(FLOWS[k], states[k], 0.3))


def test_what_lacks_the_axis_is_the_same_for_all_replicas(states: State) -> None:
    three = jax.tree.map(lambda x: jnp.stack([x, x, x]), states[1])
    flows = replace(FLOWS, packing_fraction=0.6)
    assert_same(sample(flows, states[1], 0.2), sample(flows, three, 0.2))
    assert_same(
        sample(flows[1], three, np.full(3, 0.2)),
        sample(jax.tree.map(lambda x: x[np.array([1, 1, 1])], flows), three, 0.2),
    )


def test_strains_and_steps_may_differ_between_replicas(states: State) -> None:
    np.testing.assert_array_equal(
        sample(FLOWS, states, np.array([0.1, 0.2, 0.3]))[1]._total.steps, [100, 200, 300]
    )
    np.testing.assert_array_equal(
        jax.jit(jg.advance)(FLOWS, states, np.array([1, 0, 3]))[1].steps, [1, 0, 3]
    )


def test_snapshots_take_a_batch(states: State) -> None:
    series = partial(jg.snapshot_series, strain=0.02, count=2)
    assert_same(series(FLOWS, states), jax.vmap(series)(FLOWS, states))


def test_batches_of_any_size_are_compiled_once(states: State) -> None:
    jg.sample(FLOWS[:2], states[:2], 0.1, blocks=3)
    compiled = sampler._sample._cache_size()
    for count in (5, 1, 8):
        many = np.arange(count) % 3
        _, found = jg.sample(FLOWS[many], states[many], 0.1, blocks=3)
        assert found.tally.steps.shape == (count, 3)
    assert sampler._sample._cache_size() == compiled


@pytest.mark.parametrize("kind", [float, np.float64, np.float32, partial(jnp.asarray, dtype=float)])
def test_numbers_of_python_numpy_and_jax_share_one_compilation(states: State, kind) -> None:
    flow = jg.ShearFlow(GRAINS, 0.5, 0.6, 1e-3)
    _, expected = jg.sample(flow, states[1], 0.125, blocks=3)
    compiled = sampler._sample._cache_size()
    mixed = replace(flow, restitution=kind(0.5), activation=kind(0.5))
    _, found = jg.sample(mixed, states[1], kind(0.125), blocks=3)
    assert_same(found, expected)
    assert sampler._sample._cache_size() == compiled


def test_callback_of_a_batch_is_told_of_all_replicas_which_are_those_of_their_own_calls(
    states: State,
) -> None:
    lengths = []

    def callback(state: State, so_far: jg.Sample) -> None:
        lengths.append((len(state), *so_far.tally.steps.shape))

    ends, together = sample(FLOWS, states, 0.1, blocks=2, callback=callback)
    assert lengths == [(3, 3, 1), (3, 3, 2)]
    for k in range(3):
        alone = sample(FLOWS[k], states[k], 0.1, blocks=2, callback=lambda *_: None)
        assert_same((ends[k], together[k]), alone)


TWO_AXES = jax.tree.map(lambda x: x[None], FLOWS)
MISTAKES = [
    ("one axis of replicas", lambda s: sample(FLOWS, s[:2], 0.1)),
    ("one axis of replicas", lambda s: sample(FLOWS, s, np.ones(2))),
    ("one axis of replicas", lambda s: sample(TWO_AXES, s, 0.1)),
    ("at least one replica", lambda s: sample(FLOWS[:0], s[:0], 0.1)),
    ("must be 0.5, which", lambda s: sample(replace(FLOWS, packing_fraction=0.6), s, 0.1)),
    ("a positive number", lambda s: sample(FLOWS, s, np.array([0.1, 0.1, -1]))),
    ("a whole number of 0 to", lambda s: jg.advance(FLOWS, s, np.array([1, 2, -1]))),
    ("one for each key", lambda _: jg.prepare(FLOWS, KEYS[0])),
]


@pytest.mark.parametrize(("words", "call"), MISTAKES, ids=range(len(MISTAKES)))
def test_batches_that_do_not_fit_are_refused_in_one_sentence(words, call, states: State) -> None:
    with refused(words):
        call(states)


def test_example_of_the_readme_runs_and_stands_in_the_help(capsys: pytest.CaptureFixture) -> None:
    (example,) = python_of("../README.md")
    assert len(example.splitlines()) <= 13
    assert all(line.strip() in jg.__doc__ for line in example.splitlines())
    batch, in_tutorial = (
        [line for line in text.splitlines() if line.startswith(("alphas", "flows"))]
        for text in (example, python_of("tutorial.md")[1])
    )
    assert len(batch) == 2 and batch == in_tutorial
    exec(example, {})

    def numbers(text: str) -> np.ndarray:
        lines = re.findall("^α = .*: .* ± .*", text, re.MULTILINE)
        return np.array([re.findall(r"\d+\.\d+|nan", line) for line in lines], float)

    shown = numbers((Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8"))
    printed = numbers(capsys.readouterr().out)
    assert printed.shape == (4, 4)
    np.testing.assert_array_equal(printed[:, :2], shown[:, :2])
    errors = np.hypot(np.nan_to_num(printed[:, 3]), shown[:, 3])
    assert np.all(abs(printed[:, 2] - shown[:, 2]) <= 4 * errors + 1e-3)
