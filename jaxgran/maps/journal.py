"""Journal of a batch: the tallies of all its advances, and the last state.

The next step of a batch depends on its tallies only. So an interrupted batch is repeated from the
start with the tallies from its journal, which takes almost no time. It then continues from the last
state, with the same results bit for bit as without the interruption.
"""

import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxgran.dynamics.engine import Numerics
from jaxgran.dynamics.tally import Tally, flat_tally, tally_from_flat
from jaxgran.io.arrays import CorruptFile, read_arrays, write_arrays
from jaxgran.maps.replica import ReplicaId
from jaxgran.model.flow import ShearFlow
from jaxgran.model.state import State
from jaxgran.sampling.observe import Observe, ObserveBatch, observed_shapes

SECONDS = 5.0  # shortest time between two writes of a journal
WRITING_SHARE = 0.05  # largest share of the time that is spent on writing
_LONGEST_PAUSE = 45.0  # seconds; longest time between two writes, also of a large journal


class Journal:
    """An ``ObserveBatch`` that keeps a journal of another one, and first repeats the journal of an
    earlier run.

    Args:
      path: file of the journal. If its folder is removed, the journal is not written, and the batch
        continues.
      replicas: what identifies each replica of the batch, in order.
      advance: advances the batch after the end of the journal.

    Raises:
      CorruptFile: the file is the journal of another batch, or cannot be read.
    """

    def __init__(self, path: Path, replicas: Sequence[ReplicaId], advance: ObserveBatch):
        self.path, self.advance = path, advance
        self.replicas = np.asarray(replicas, float)
        self.steps: list[np.ndarray] = []
        self.tallies: list[np.ndarray] = []
        self.leaves: list[np.ndarray] = []
        self.position, self.next = 0, time.monotonic() + SECONDS
        if path.exists():
            self._read()

    def __call__(
        self,
        flow: ShearFlow,
        numerics: Numerics,
        state: State,
        steps: Array | np.ndarray,
        observe: Observe | None = None,
    ) -> tuple[State, Tally]:
        k, self.position = self.position, self.position + 1
        if k < len(self.tallies):
            if not np.array_equal(self.steps[k], steps):
                raise CorruptFile(f"{self.path.name} is the journal of another run")
            observed = None if observe is None else observed_shapes(observe, flow)
            return self._repeated(k, state, observed)
        state, tally = self.advance(flow, numerics, state, steps, observe)
        self.steps.append(np.asarray(steps))
        self.tallies.append(flat_tally(tally, np.shape(steps)))
        if time.monotonic() >= self.next:
            self.leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(state)]
            self._write()
        return state, tally

    def _repeated(self, k: int, state: State, observed: Any) -> tuple[State, Tally]:
        """Tally ``k`` of the journal; with the last tally comes the stored state, and before it the
        given one.
        """
        tally = tally_from_flat(self.tallies[k], state.positions.dtype, observed)
        if k + 1 < len(self.tallies):
            return state, tally
        leaves = [jnp.asarray(leaf) for leaf in self.leaves]
        return jax.tree.unflatten(jax.tree.structure(state), leaves), tally

    def _write(self) -> None:
        begun = time.monotonic()
        longest = max(x.shape[-1] for x in self.tallies)  # those of a sample have a user's sums too
        tallies = [np.pad(x, ((0, 0), (0, longest - x.shape[-1]))) for x in self.tallies]
        arrays = {
            "replicas": self.replicas,
            "steps": np.stack(self.steps),
            "tallies": np.stack(tallies),
            **{f"state_{k}": leaf for k, leaf in enumerate(self.leaves)},
        }
        with suppress(FileNotFoundError):  # ``Checkpoint.add`` makes a removed folder again
            write_arrays(self.path, arrays, {})
        now = time.monotonic()
        self.next = now + max(SECONDS, min((now - begun) / WRITING_SHARE, _LONGEST_PAUSE))

    def _read(self) -> None:
        arrays, _ = read_arrays(self.path)
        if not np.array_equal(arrays["replicas"], self.replicas):
            raise CorruptFile(f"{self.path.name} is the journal of another batch")
        self.steps, self.tallies = list(arrays["steps"]), list(arrays["tallies"])
        self.leaves = [arrays[f"state_{k}"] for k in range(len(arrays) - 3)]
