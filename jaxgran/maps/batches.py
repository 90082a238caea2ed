"""Batches of a map: replicas of one number of grains and of similar cost, the most expensive first.

So no core is idle for long at the end. The numbers of a replica do not depend on its batch.
"""

from collections.abc import Sequence
from heapq import heappop, heappush

from jaxgran.dynamics.batch import predicted_cost
from jaxgran.environment import default_device, on_processor
from jaxgran.maps.replica import ReplicaId
from jaxgran.maps.settings import MapSettings
from jaxgran.model.flow import ShearFlow
from jaxgran.sampling.thresholds import LEAST_PREPARATION, LEAST_SAMPLE, RELAXATION_STRAIN
from jaxgran.sampling.timestep import COARSE_TIMESTEP

_PAIR_BYTES = 48  # of memory for each pair of grains, in a search that compares all pairs
# of memory for each grain: lists, network and state; grains are rounded up to a power of two
_GRAIN_BYTES = 2500
_SHARE_OF_MEMORY = 0.5  # of a device, for one batch
_DEFAULT_MEMORY = 8 * 2**30  # bytes of a device that does not report its memory
_LARGEST_COST_RATIO = 2  # between replicas that advance in lockstep


def replica_cost(flow: ShearFlow, equilibrate: float | None, strain: float | None) -> float:
    """Relative cost of a whole replica that is steady and precise as early as it can be."""
    preparation = LEAST_PREPARATION if equilibrate is None else equilibrate
    coarse = max(COARSE_TIMESTEP, float(flow.timestep))
    sample = LEAST_SAMPLE if strain is None else strain
    return preparation * predicted_cost(flow, coarse) + (
        sample + RELAXATION_STRAIN
    ) * predicted_cost(flow)


def replica_ids(settings: MapSettings) -> list[ReplicaId]:
    """The replicas that a map measures, by point and seed."""
    points = settings.points
    return [
        ReplicaId(*points[k], seed)
        for k in points_of_part(settings)
        for seed in settings.seed_numbers
    ]


def points_of_part(settings: MapSettings) -> list[int]:
    """The numbers of the points that a map measures: all, or those of its part.

    Each point goes to the part that costs least so far, the most expensive points first. Costs are
    those of ``replica_cost``, which is the same on all machines.
    """
    flows = list(settings.flows.values())
    if settings.part is None:
        return list(range(len(flows)))
    number, count = map(int, settings.part.split("/"))
    shares: list[list[int]] = [[] for _ in range(count)]
    costs = [replica_cost(flow, settings.equilibrate, settings.strain) for flow in flows]
    heap = [(0.0, share) for share in range(count)]
    for point in sorted(range(len(flows)), key=lambda point: -costs[point]):
        cost, share = heappop(heap)
        shares[share].append(point)
        heappush(heap, (cost + costs[point], share))
    return sorted(shares[number - 1])


def batches(settings: MapSettings, replicas: Sequence[ReplicaId]) -> list[list[ReplicaId]]:
    """Replicas in batches of one number of grains and of similar cost, the most expensive first."""
    costs = {point: predicted_cost(flow) for point, flow in settings.flows.items()}
    by_cost = sorted(replicas, key=lambda replica: -costs[replica.point])
    tasks: list[list[ReplicaId]] = []
    for grains in {replica.grains: None for replica in replicas}:
        alike = [replica for replica in by_cost if replica.grains == grains]
        most, batch = batch_size(grains, len(alike)), []
        for replica in alike:
            least = costs[batch[0].point] / _LARGEST_COST_RATIO if batch else 0.0
            if not batch or len(batch) == most or costs[replica.point] < least:
                batch = []
                tasks.append(batch)
            batch.append(replica)
    return sorted(tasks, key=lambda batch: -costs[batch[0].point])


def batch_size(grains: int, count: int) -> int:
    """Replicas of a batch: one on a processor, as many as fit into half the memory of an
    accelerator.
    """
    if on_processor():
        return 1
    memory = (default_device().memory_stats() or {}).get("bytes_limit", _DEFAULT_MEMORY)
    per_replica = (
        _GRAIN_BYTES * max(64, 1 << (grains - 1).bit_length()) + _PAIR_BYTES * min(grains, 512) ** 2
    )
    return int(max(1, min(count, _SHARE_OF_MEMORY * memory / per_replica)))
