"""One replica of a map: its key, its progress and its result."""

from collections.abc import Sequence
from typing import NamedTuple

from jax.typing import ArrayLike

from jaxgran.model.state import State
from jaxgran.sampling.sample import Sample

Key = tuple[int, int]  # number of the point, in the order of ``MapSettings.flows``; seed


class Advance(NamedTuple):
    """What some replicas have been advanced by, for a report of progress."""

    keys: Sequence[Key]
    timestep: ArrayLike | Sequence[float]  # (replicas,)
    steps: ArrayLike | Sequence[float]  # (replicas,)


class Replica(NamedTuple):
    """Result of one replica: its sample, its worst status, its strain before the sample, and maybe
    its last state.
    """

    sample: Sample
    status: int
    strain: float
    state: State | None = None
