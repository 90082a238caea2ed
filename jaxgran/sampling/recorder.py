"""Frames of a flow while it is driven: snapshots at equal distances of strain, handed on as they are taken."""

from collections.abc import Callable, Iterator
from functools import partial, reduce
from operator import add

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxgran.dynamics.snapshots import Snapshot, snapshot
from jaxgran.dynamics.tally import Tally
from jaxgran.model.flow import ShearFlow
from jaxgran.model.state import State
from jaxgran.model.status import Status
from jaxgran.sampling.batch import Drive

Keep = Callable[[Snapshot, int], None]  # given a frame and the time steps since the first one, which has none


class Recorder:
    """Takes frames of a replica while it is driven.

    A frame is taken at the start and after every so many time steps. Where a frame falls within what would have been
    advanced at once, that is done in two parts, whose sum differs by rounding; and a flow of many collisions makes of
    rounding another course of the same flow. Where all frames fall on the ends, every bit stays the same.

    Args:
      every: strain from frame to frame, rounded to whole time steps, at least one.
      keep: what every frame is handed to.
    """

    def __init__(self, every: float, *keep: Keep):
        self.every, self.keep = every, keep
        self.frames = self.steps = 0

    def recording(self, drive: Drive) -> Drive:
        """A drive of a batch of one that records; the frames begin anew with its first call."""
        self.frames = self.steps = 0
        return partial(self._driven, drive)

    def _driven(self, drive: Drive, flow: ShearFlow, state: State, steps: Array) -> tuple[State, Tally]:
        every = max(1, round(self.every / (np.asarray(flow.shear_rate) * np.asarray(flow.timestep)).item()))
        if self.frames == 0:
            self._record(flow, state)
        tallies = []
        for part in _parts(self.steps, np.asarray(steps).item(), every):
            state, tally = drive(flow, state, jnp.full_like(steps, part))
            tallies.append(tally)
            self.steps += part
            if part > 0 and self.steps % every == 0 and np.asarray(tally.status).item() < Status.nonfinite:
                self._record(flow, state)
        return state, reduce(add, tallies)

    def _record(self, flow: ShearFlow, state: State) -> None:
        if not np.isfinite(np.asarray(state.velocities)).all():  # the status says so
            return
        seen = _snapshot_of_one(flow, state)
        for keep in self.keep:
            keep(seen, self.steps)
        self.frames += 1


def _parts(done: int, steps: int, every: int) -> Iterator[int]:
    """The steps in parts that end where a multiple of ``every`` steps is done, and where all are; one part of none."""
    end = done + steps
    while True:
        part = min(every - done % every, end - done)
        yield part
        done += part
        if done >= end:
            return


@jax.jit
def _snapshot_of_one(flow: ShearFlow, state: State) -> Snapshot:
    return snapshot(*jax.tree.map(lambda x: x[0], (flow, state)))
