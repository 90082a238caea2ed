"""The block loop: a batch of replicas is advanced block by block, with a tally for each.

Preparation, maps and samples with a callback run this loop in Python, as they decide, report or
record after each block. ``sample`` without a callback needs one compiled call for all blocks.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxgran.dynamics.engine import Numerics
from jaxgran.dynamics.tally import Tally
from jaxgran.model.flow import ShearFlow, steps_of_blocks, steps_of_strain
from jaxgran.model.state import State
from jaxgran.model.status import GIVEN_UP, Status
from jaxgran.sampling.correlation_strain import total_mass
from jaxgran.sampling.observe import AdvanceBatch
from jaxgran.sampling.sample import Sample


class Batch(NamedTuple):
    """Replicas in preparation; all arrays but those of ``numerics`` have a leading (replicas,)
    axis.
    """

    flow: ShearFlow
    numerics: Numerics
    state: State
    status: Int[np.ndarray, " replicas"]
    strain: Float[np.ndarray, " replicas"]  # before the sample
    correlation_strain: Float[np.ndarray, " replicas"]


def advance_by_block(
    advance: AdvanceBatch,
    batch: tuple[ShearFlow, Numerics, State],
    strain: Float[np.ndarray | Array, " replicas"],
    blocks: int,
    given_up: Bool[np.ndarray, " replicas"],
    stop: Callable[[State, Sequence[Tally]], Any] = lambda *_: False,
) -> tuple[State, list[Tally]]:
    """Advance a batch block by block: its state at the end, and a tally (replicas,) of each block.

    The numbers of time steps of the blocks differ by one at most. A replica that is given up, at
    first or by the status of a block, stays as it is.

    Args:
      advance: advances the batch by numbers of time steps.
      batch: flows, numerics and states.
      strain: that of each replica, over all blocks.
      blocks: number of blocks.
      given_up: which replicas are not advanced.
      stop: called after each block with the state and all tallies; the last block is the one for
        which it is true.
    """
    flow, numerics, state = batch
    tallies: list[Tally] = []
    for steps in steps_of_blocks(steps_of_strain(flow, strain), blocks).T:
        state, tally = advance(flow, numerics, state, np.where(given_up, 0, steps).astype(np.int32))
        tallies.append(jax.tree.map(np.asarray, tally))
        given_up = given_up | (tallies[-1].status >= GIVEN_UP)
        if stop(state, tallies):
            break
    return state, tallies


def sample_of_blocks(flow: ShearFlow, state: State, tallies: Sequence[Tally]) -> Sample:
    """The sample of a batch from the tallies (replicas,) of successive blocks."""
    tally = jax.tree.map(lambda *x: np.stack(x, axis=1), *tallies)
    side = np.asarray(state.side)
    numbers = jax.tree.map(lambda x: np.asarray(x, side.dtype), flow)
    return Sample(tally, side**2, total_mass(state.grains), numbers)


def shear_by_block(
    batch: Batch, strain: Float[np.ndarray, " replicas"], blocks: int, advance: AdvanceBatch
) -> tuple[Batch, Sample]:
    """Shear every replica by its own strain; the sample of this strain."""
    state, tallies = advance_by_block(
        advance, (batch.flow, batch.numerics, batch.state), strain, blocks, batch.status >= GIVEN_UP
    )
    sample = sample_of_blocks(batch.flow, state, tallies)
    worst = sample.tally.status.max(axis=1)
    failed = np.where(worst >= GIVEN_UP, worst, Status.ok)  # the sample reports milder ones
    return batch._replace(state=state, status=np.maximum(batch.status, failed)), sample
