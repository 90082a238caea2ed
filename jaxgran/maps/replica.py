"""One replica of a map: its key, its progress and its result."""

import struct
import zlib
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from jax.typing import ArrayLike

from jaxgran.maps.settings import MapSettings
from jaxgran.model.state import State
from jaxgran.sampling.sample import Sample

Key = tuple[int, int]  # number of the point, in the order of ``MapSettings.flows``; seed


class ReplicaId(NamedTuple):
    """What identifies a replica among all maps of the same other settings."""

    restitution: float
    packing_fraction: float
    grains: int
    timestep: float
    seed: int  # counted from 0, whatever the ``first_seed`` of a map

    @property
    def checksum(self) -> int:
        """CRC-32 of the numbers of the flow, as little-endian float64 and int64."""
        return zlib.crc32(struct.pack("<ddqd", *self[:-1]))


def replica_ids(settings: MapSettings, keys: Iterable[Key]) -> list[ReplicaId]:
    """What identifies the replicas of a map with these keys."""
    flows = settings.flows()
    return [
        ReplicaId(
            float(flows[point].restitution),
            float(flows[point].packing_fraction),
            int(flows[point].grains),
            float(flows[point].timestep),
            settings.first_seed + seed,
        )
        for point, seed in keys
    ]


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
