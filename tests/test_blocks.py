"""A long batch that was cut off anywhere goes on from its blocks with the bits that it would have
had.
"""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from synthetic import random_tally

from jaxgran.dynamics.batch import stack
from jaxgran.io.arrays import CorruptFile
from jaxgran.maps import blocks
from jaxgran.maps.blocks import KeptBlocks
from jaxgran.maps.replica import ReplicaId
from jaxgran.model.flow import ShearFlow
from jaxgran.model.grains import Grains
from jaxgran.model.state import State
from jaxgran.sampling.observe import advance_batch
from jaxgran.sampling.sample_batch import sample_batch
from jaxgran.sampling.steady_state import prepare_batch

IDS = [ReplicaId(32, 1e-2, 0.6, alpha, 0) for alpha in (0.5, 0.9)]
GRAINS = (
    32  # as in the tests of the protocol and of maps, whose keys are numbers too: compiled once
)


@pytest.fixture
def after_every_call(monkeypatch: pytest.MonkeyPatch) -> None:
    """The file is written after every call."""
    monkeypatch.setattr(blocks, "SECONDS", 0.0)


class CutOff(Exception):
    pass


def cut_after(advance, calls: int):
    """An advance that dies after a number of calls."""

    def counted(*arguments):
        nonlocal calls
        if calls == 0:
            raise CutOff
        calls -= 1
        return advance(*arguments)

    return counted


def measured(advance) -> Any:
    flow = stack([ShearFlow(GRAINS, alpha, 0.6, 1e-2) for alpha in (0.5, 0.9)])
    batch = prepare_batch(flow, jax.random.split(jax.random.PRNGKey(0), 2), 0.5, advance)
    return sample_batch(batch, 0.64, advance)


@pytest.fixture(scope="module")
def whole() -> Any:
    return measured(advance_batch)


@pytest.mark.parametrize("cuts", [(1,), (5, 20), (3, 3, 3, 40)])
@pytest.mark.usefixtures("after_every_call")
def test_a_batch_that_is_cut_off_goes_on_to_the_same_bits(whole, cuts, tmp_path: Path) -> None:
    for calls in cuts:
        try:
            measured(KeptBlocks(tmp_path / "batch.npz", IDS, cut_after(advance_batch, calls)))
        except CutOff:
            continue
    resumed = measured(KeptBlocks(tmp_path / "batch.npz", IDS, advance_batch))
    jax.tree.map(np.testing.assert_array_equal, resumed, whole)


def fake_drive(flow, numerics, state: State, steps, observe=None):
    """Random numbers that depend on the state alone."""
    seed = int(np.asarray(state.positions).sum() * 1e6) % 2**31
    tally = random_tally(np.random.default_rng(seed), len(steps))
    return jax.tree.map(lambda x: x + 1, state), tally


def small_state() -> State:
    ones = jnp.ones((2, 4))
    return State(
        Grains(ones, ones), jnp.zeros((2, 4, 2)), jnp.zeros((2, 4, 2)), jnp.ones(2), jnp.zeros(2)
    )


def walk(advance, calls: int) -> list:
    state, seen = small_state(), []
    for k in range(calls):
        state, tally = advance(None, None, state, np.array([k, k]))
        seen.append(jax.tree.map(np.asarray, tally))
    return [seen, jax.tree.map(np.asarray, state)]


@pytest.mark.usefixtures("after_every_call")
def test_nothing_is_done_twice(tmp_path: Path) -> None:
    path, done = tmp_path / "batch.npz", []

    def counted(*arguments):
        done.append(arguments)
        return fake_drive(*arguments)

    walk(KeptBlocks(path, IDS, counted), 7)
    again = walk(KeptBlocks(path, IDS, counted), 10)
    assert len(done) == 10
    jax.tree.map(np.testing.assert_array_equal, again, walk(fake_drive, 10))


@pytest.mark.usefixtures("after_every_call")
def test_the_blocks_of_others_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "batch.npz"
    walk(KeptBlocks(path, IDS, fake_drive), 3)
    with pytest.raises(CorruptFile, match="another batch"):
        KeptBlocks(path, IDS[:1], fake_drive)
    kept = KeptBlocks(path, IDS, fake_drive)
    with pytest.raises(CorruptFile, match="another run"):
        kept(None, None, small_state(), np.array([5, 5]))
