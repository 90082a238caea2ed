"""The blocks of a long batch on disk: what each of its advances returned, and the last state.

The next step of a batch depends on its tallies only. So one that was interrupted is repeated from
the start with the tallies that were kept, which takes almost no time, and then continues from the
last state, with the same bits as without the interruption. A short batch keeps nothing.
"""

import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

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
from jaxgran.sampling.observe import AdvanceBatch, Observe, observed_shapes

SECONDS = 60.0  # shortest time before the first write and between two


class KeptBlocks:
    """An ``AdvanceBatch`` that keeps what another one returns, and first returns what was kept of
    an earlier run.

    Args:
      path: the file. If its folder is removed, nothing is kept, and the batch continues.
      replicas: what identifies the replicas of the batch.
      advance: advances the batch after what was kept.

    Raises:
      CorruptFile: the file is that of another batch, or cannot be read.
    """

    def __init__(self, path: Path, replicas: Sequence[ReplicaId], advance: AdvanceBatch):
        self.path, self.advance = path, advance
        self.about = {"replicas": [list(replica) for replica in replicas]}
        self.steps: list[np.ndarray] = []
        self.tallies: list[np.ndarray] = []
        self.leaves: list[np.ndarray] = []  # of the last state
        self.returned, self.next_write = 0, time.monotonic() + SECONDS
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
        k, self.returned = self.returned, self.returned + 1
        if k < len(self.tallies):
            if not np.array_equal(self.steps[k], steps):
                raise CorruptFile(f"{self.path.name} is of another run")
            shapes = None if observe is None else observed_shapes(observe, flow)
            tally = tally_from_flat(self.tallies[k], state.positions.dtype, shapes)
            if k + 1 < len(self.tallies):
                return state, tally
            leaves = map(jnp.asarray, self.leaves)
            return jax.tree.unflatten(jax.tree.structure(state), leaves), tally
        state, tally = self.advance(flow, numerics, state, steps, observe)
        self.steps.append(np.asarray(steps))
        self.tallies.append(flat_tally(tally, np.shape(steps)))
        if time.monotonic() >= self.next_write:
            self.leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(state)]
            self._write()
            self.next_write = time.monotonic() + SECONDS
        return state, tally

    def _write(self) -> None:
        parts = {"steps": self.steps, "tally": self.tallies, "state": self.leaves}
        arrays = {f"{name}_{k}": x for name, part in parts.items() for k, x in enumerate(part)}
        with suppress(FileNotFoundError):  # the folder was removed
            write_arrays(self.path, arrays, self.about)

    def _read(self) -> None:
        arrays, about = read_arrays(self.path)
        if about != self.about:
            raise CorruptFile(f"{self.path.name} is of another batch")
        for name, part in (("steps", self.steps), ("tally", self.tallies), ("state", self.leaves)):
            count = sum(key.startswith(f"{name}_") for key in arrays)
            part += [arrays[f"{name}_{k}"] for k in range(count)]
