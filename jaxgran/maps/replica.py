"""A map is a table of replicas: what identifies one, and its result."""

import struct
import zlib
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from jax.typing import ArrayLike

    from jaxgran.model.state import State
    from jaxgran.sampling.sample import Sample

AXES = ("grains", "timestep", "packing_fraction", "restitution")
"""The axes of a map, outermost first."""

FURTHER, PLANE = AXES[:2], AXES[2:]
"""Axes that are dimensions only of maps with several values, and those of every map."""


class Point(NamedTuple):
    """A point of a map: the numbers that its replicas have in common."""

    grains: int
    timestep: float
    packing_fraction: float
    restitution: float


class ReplicaId(NamedTuple):
    """What identifies a replica among all maps of the same other settings."""

    grains: int
    timestep: float
    packing_fraction: float
    restitution: float
    seed: int  # counted from 0, whatever the ``first_seed`` of a map

    @property
    def point(self) -> Point:
        return Point(*self[:-1])

    @property
    def checksum(self) -> int:
        """CRC-32 of the numbers of the flow, as little-endian float64 and int64."""
        flow = self.restitution, self.packing_fraction, self.grains, self.timestep
        return zlib.crc32(struct.pack("<ddqd", *flow))


class Replica(NamedTuple):
    """A row of the table.

    Attributes:
      id: what identifies it.
      sample: its sample; None if a cluster gave it up.
      status: its worst status.
      strain: its strain before the sample.
      state: its last state, if it is kept.
    """

    id: ReplicaId
    sample: "Sample | None"
    status: int
    strain: float
    state: "State | None" = None


class Advance(NamedTuple):
    """What some replicas have been advanced by, for a report of progress."""

    ids: Sequence[ReplicaId]
    timestep: "ArrayLike | Sequence[float]"  # (replicas,)
    steps: "ArrayLike | Sequence[float]"  # (replicas,)


def union(*tables: Iterable[Replica]) -> dict[ReplicaId, Replica]:
    """The replicas of several maps; of one that occurs twice, the first that has a sample."""
    rows: dict[ReplicaId, Replica] = {}
    for replica in (x for table in tables for x in table):
        known = rows.get(replica.id)
        if known is None or known.sample is None:
            rows[replica.id] = replica
    return rows
