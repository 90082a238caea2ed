"""Frames of a running flow: snapshots at equal intervals of strain, passed on when they are
taken.
"""

import sys
from collections.abc import Callable
from functools import partial, reduce
from operator import add

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxgran.dynamics.engine import Numerics
from jaxgran.dynamics.snapshot import Snapshot
from jaxgran.dynamics.snapshots import snapshots_from
from jaxgran.dynamics.tally import Tally
from jaxgran.model.flow import ShearFlow, steps_of_strain
from jaxgran.model.state import State
from jaxgran.model.status import Status
from jaxgran.sampling.observe import AdvanceBatch

Keep = Callable[
    [Snapshot, int], None
]  # called with a frame and the number of time steps since the first frame


class Recorder:
    """Takes frames of a replica while it is advanced.

    Frames are taken at the start and then at multiples of a strain, each at the nearest time step.
    If a frame falls inside an advance, it is split, and the sums differ by rounding. In a flow of
    many collisions, rounding leads to another trajectory of the same flow. If all frames fall on
    the ends of advances, all results are the same bit for bit.

    Args:
      every: strain from frame to frame; frames are at least a time step apart.
      keep: functions that are called with every frame.
      force_strain: strain from each frame on in which a copy of the flow is advanced step by step.
        The frame is then the series of these snapshots, which begins at the frame. One time step or
        less for a single snapshot.
      most: number of frames after which no more are taken, or None for frames to the end.

    ``frames`` counts them, and ``status`` is the worst of their statuses.
    """

    def __init__(
        self, every: float, *keep: Keep, force_strain: float = 0.0, most: int | None = None
    ):
        self.every, self.keep, self.force_strain, self.most = every, keep, force_strain, most
        self.frames = self.steps = self._taken = self.status = 0

    def recording(self, advance: AdvanceBatch) -> AdvanceBatch:
        """The advance of a batch of one replica, recording frames; the first call starts a new
        series.
        """
        self.frames = self.steps = self._taken = self.status = 0
        return partial(self._advance, advance)

    def _advance(
        self,
        advance: AdvanceBatch,
        flow: ShearFlow,
        numerics: Numerics,
        state: State,
        steps: Array | np.ndarray,
    ) -> tuple[State, Tally]:
        if self.frames == 0:
            self._record(flow, numerics, state)
        end, tallies = self.steps + np.asarray(steps).item(), []
        while not tallies or self.steps < end:
            frame = self._next_frame(flow)
            part = min(frame, end) - self.steps
            state, tally = advance(flow, numerics, state, jnp.full_like(steps, part))
            tallies.append(tally)
            self.steps += part
            if self.steps == frame:
                self._taken += 1
                if np.asarray(tally.status).item() < Status.nonfinite:
                    self._record(flow, numerics, state)
        return state, reduce(add, tallies)

    def _next_frame(self, flow: ShearFlow) -> int:
        """The time step of the next frame; that of no frame if there are enough."""
        number = self._taken + 1
        if self.most is not None and number >= self.most:
            return sys.maxsize
        return max(number, int(steps_of_strain(flow, number * self.every).item()))

    def _record(self, flow: ShearFlow, numerics: Numerics, state: State) -> None:
        if not np.isfinite(np.asarray(state.velocities)).all():  # the status reports it
            return
        flow, state = jax.tree.map(lambda x: x[0], (flow, state))
        frame = snapshots_from(flow, numerics, state, self.force_strain)
        for keep in self.keep:
            keep(frame, self.steps)
        self.frames += 1
        self.status = max(self.status, int(np.max(frame.status)))
