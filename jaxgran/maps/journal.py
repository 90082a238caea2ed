"""Journal of a batch: the tallies of all that has been advanced, and the last state.

What a batch does next depends on its tallies alone. So a batch that was cut off is done again from the start with the
tallies from its journal, in no time, and goes on from the last state with the bits that it would have had.
"""

import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxgran.dynamics.tally import Tally, flat_tally, tally_from_flat
from jaxgran.io.atomic import Damaged, read_arrays, write_arrays
from jaxgran.model.flow import ShearFlow
from jaxgran.model.state import State
from jaxgran.sampling.batch import Drive

SECONDS = 5.0  # between two writings of a journal
_SHARE = 0.05  # of the time, at most, that large journals are written
_LONGEST = 45.0  # seconds between two writings, however long they take


class Journal:
    """A ``Drive`` that keeps a journal of another one, and repeats what the journal of an earlier run holds.

    Args:
      path: file of the journal. Its folder may vanish; the journal is then not written, and nothing else suffers.
      keys: what tells the replicas of the batch, in their order; the journal of others is not repeated.
      drive: what advances the batch beyond the journal.
      seconds: time between two writings, or None for ``SECONDS``, and longer where a writing takes long itself.
    """

    def __init__(self, path: Path, keys: Sequence[Sequence[int]], drive: Drive, seconds: float | None = None):
        self.path, self.drive, self.seconds = path, drive, seconds
        self.keys = np.asarray(keys, np.int64)
        self.steps: list[np.ndarray] = []
        self.tallies: list[np.ndarray] = []
        self.leaves: list[np.ndarray] = []
        self.position, self.next = 0, time.monotonic() + (SECONDS if seconds is None else seconds)
        if path.exists():
            self._read()

    def __call__(self, flow: ShearFlow, state: State, steps: Array) -> tuple[State, Tally]:
        k, self.position = self.position, self.position + 1
        if k < len(self.tallies):
            if np.array_equal(self.steps[k], steps):
                return self._repeated(k, state)
            raise Damaged(f"{self.path.name} is the journal of another run")
        state, tally = self.drive(flow, state, steps)
        self.steps.append(np.asarray(steps))
        self.tallies.append(flat_tally(tally, np.shape(steps)))
        if time.monotonic() >= self.next:
            self.leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(state)]
            self._write()
        return state, tally

    def _repeated(self, k: int, state: State) -> tuple[State, Tally]:
        """The tally of a step of the journal, with the last state at its end and any state before."""
        tally = tally_from_flat(self.tallies[k], state.positions.dtype)
        if k + 1 < len(self.tallies):
            return state, tally
        leaves = [jnp.asarray(leaf) for leaf in self.leaves]
        return jax.tree.unflatten(jax.tree.structure(state), leaves), tally

    def _write(self) -> None:
        begun = time.monotonic()
        states = {f"state_{k}": leaf for k, leaf in enumerate(self.leaves)}
        series = {"steps": np.stack(self.steps), "tallies": np.stack(self.tallies)}
        with suppress(FileNotFoundError):  # whoever collects the results will notice
            write_arrays(self.path, {"keys": self.keys, **series, **states}, {})
        now = time.monotonic()
        pause = max(SECONDS, min((now - begun) / _SHARE, _LONGEST)) if self.seconds is None else self.seconds
        self.next = now + pause

    def _read(self) -> None:
        arrays, _ = read_arrays(self.path)
        if not np.array_equal(arrays["keys"], self.keys):
            raise Damaged(f"{self.path.name} is the journal of another batch")
        self.steps, self.tallies = list(arrays["steps"]), list(arrays["tallies"])
        self.leaves = [arrays[f"state_{k}"] for k in range(len(arrays) - 3)]
