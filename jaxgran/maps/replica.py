"""The result of one replica of a map."""

from typing import NamedTuple

from jaxgran.analysis.instant import Instant
from jaxgran.sampling.sample import Sample

Key = tuple[int, int]  # number of the point, in the order of ``MapSettings.flows``; seed


class Replica(NamedTuple):
    """Result of one replica: its sample, its worst status, its strain before the sample, and maybe an instant of it."""

    sample: Sample
    status: int
    strain: float
    instant: Instant | None = None
