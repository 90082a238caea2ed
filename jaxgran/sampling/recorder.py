"""Frames of a running flow: snapshots at equal intervals of strain, passed on when they are taken."""

from collections.abc import Callable, Iterator
from functools import partial, reduce
from operator import add

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxgran.contact.projected_methods import ProjectedMethod
from jaxgran.dynamics.engine import Numerics
from jaxgran.dynamics.snapshots import Snapshot, snapshot
from jaxgran.dynamics.tally import Tally
from jaxgran.model.flow import ShearFlow
from jaxgran.model.state import State
from jaxgran.model.status import Status
from jaxgran.sampling.batch import AdvanceBatch

Keep = Callable[[Snapshot, int], None]  # called with a frame and the number of time steps since the first frame


class Recorder:
    """Takes frames of a replica while it is advanced.

    Frames are taken at the start and then at equal numbers of time steps. If a frame falls inside an advance, it
    is split, and the sums differ by rounding. In a flow of many collisions, rounding leads to another trajectory of the
    same flow. If all frames fall on the ends of advances, all results are the same bit for bit.

    Args:
      every: strain from frame to frame, rounded to whole time steps, at least one.
      keep: functions that are called with every frame.
    """

    def __init__(self, every: float, *keep: Keep):
        self.every, self.keep = every, keep
        self.frames = self.steps = 0

    def recording(self, advance: AdvanceBatch) -> AdvanceBatch:
        """The advance of a batch of one replica, recording frames; the first call starts a new series."""
        self.frames = self.steps = 0
        return partial(self._advance, advance)

    def _advance(
        self, advance: AdvanceBatch, flow: ShearFlow, numerics: Numerics, state: State, steps: Array
    ) -> tuple[State, Tally]:
        every = max(1, round(self.every / (np.asarray(flow.shear_rate) * np.asarray(flow.timestep)).item()))
        if self.frames == 0:
            self._record(flow, numerics, state)
        tallies = []
        for part in _parts(self.steps, np.asarray(steps).item(), every):
            state, tally = advance(flow, numerics, state, jnp.full_like(steps, part))
            tallies.append(tally)
            self.steps += part
            if part > 0 and self.steps % every == 0 and np.asarray(tally.status).item() < Status.nonfinite:
                self._record(flow, numerics, state)
        return state, reduce(add, tallies)

    def _record(self, flow: ShearFlow, numerics: Numerics, state: State) -> None:
        if not np.isfinite(np.asarray(state.velocities)).all():  # the status reports it
            return
        frame = _snapshot_of_one(flow, numerics.solver, state)
        for keep in self.keep:
            keep(frame, self.steps)
        self.frames += 1


def _parts(done: int, steps: int, every: int) -> Iterator[int]:
    """The steps in parts, each up to the next multiple of ``every`` or the end; one empty part for zero steps."""
    end = done + steps
    while True:
        part = min(every - done % every, end - done)
        yield part
        done += part
        if done >= end:
            return


@jax.jit
def _snapshot_of_one(flow: ShearFlow, solver: ProjectedMethod, state: State) -> Snapshot:
    return snapshot(*jax.tree.map(lambda x: x[0], (flow, state, solver)))
