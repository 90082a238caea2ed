"""A long batch that was cut off anywhere goes on from its blocks to the same bits."""

from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from jaxgran.dynamics.batch import stack
from jaxgran.io.arrays import CorruptFile
from jaxgran.maps import blocks
from jaxgran.maps.blocks import KeptBlocks
from jaxgran.maps.replica import ReplicaId
from jaxgran.model.flow import ShearFlow
from jaxgran.sampling.observe import advance_batch
from jaxgran.sampling.sample_batch import sample_batch
from jaxgran.sampling.steady_state import prepare_batch

GRAINS = 32  # as in other tests of batches: compiled once
IDS = [ReplicaId(GRAINS, 1e-2, 0.6, alpha, 0) for alpha in (0.5, 0.9)]


@pytest.fixture(autouse=True)
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


def measured(advance, equilibrate: float = 0.5) -> Any:
    flow = stack([ShearFlow(GRAINS, alpha, 0.6, 1e-2) for alpha in (0.5, 0.9)])
    batch = prepare_batch(flow, jax.random.split(jax.random.PRNGKey(0), 2), equilibrate, advance)
    return sample_batch(batch, 0.64, advance)


@pytest.fixture(scope="module")
def whole() -> Any:
    return measured(advance_batch)


@pytest.mark.parametrize("cuts", [(1,), (3, 3, 3, 40)])
def test_a_batch_that_is_cut_off_goes_on_to_the_same_bits(whole, cuts, tmp_path: Path) -> None:
    for calls in cuts:
        try:
            measured(KeptBlocks(tmp_path / "batch.npz", IDS, cut_after(advance_batch, calls)))
        except CutOff:
            continue
    resumed = measured(KeptBlocks(tmp_path / "batch.npz", IDS, advance_batch))
    jax.tree.map(np.testing.assert_array_equal, resumed, whole)


def test_nothing_is_done_twice_and_the_blocks_of_others_are_refused(whole, tmp_path: Path) -> None:
    path = tmp_path / "batch.npz"
    measured(KeptBlocks(path, IDS, advance_batch))
    again = measured(KeptBlocks(path, IDS, cut_after(advance_batch, 0)))
    jax.tree.map(np.testing.assert_array_equal, again, whole)
    with pytest.raises(CorruptFile, match="another batch"):
        KeptBlocks(path, IDS[:1], advance_batch)
    with pytest.raises(CorruptFile, match="another run"):
        measured(KeptBlocks(path, IDS, advance_batch), equilibrate=1.0)
