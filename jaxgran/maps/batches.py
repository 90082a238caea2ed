"""Batches of a map: replicas of one number of grains and of similar cost, the most expensive first.

So no core is idle for long at the end. The numbers of a replica do not depend on its batch.
"""

from collections.abc import Container
from heapq import heappop, heappush

import jax

from jaxgran.dynamics.batch import predicted_cost
from jaxgran.dynamics.batching import in_lockstep
from jaxgran.maps.replica import Key
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


def points_of_part(settings: MapSettings) -> list[int]:
    """The points that a map measures: all, or those of its part.

    Each point goes to the part that costs least so far, the most expensive points first. Costs are
    those of ``replica_cost``, which is the same on all machines.
    """
    flows = settings.flows()
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


def batches(settings: MapSettings, without: Container[Key] = ()) -> list[list[Key]]:
    """The replicas in batches of one number of grains and of similar cost, the most expensive
    first.
    """
    flows = settings.flows()
    costs = [predicted_cost(flow) for flow in flows]
    order = sorted(range(len(costs)), key=lambda point: -costs[point])
    lockstep, chosen = in_lockstep(), set(points_of_part(settings))
    tasks: list[list[Key]] = []
    for grains in {flow.grains: None for flow in flows}:
        points = [point for point in order if flows[point].grains == grains and point in chosen]
        keys = [
            (point, seed)
            for point in points
            for seed in range(settings.seeds)
            if (point, seed) not in without
        ]
        most = batch_size(grains, len(keys)) if keys else 0
        alike: list[list[Key]] = []
        for key in keys:
            full = not alike or len(alike[-1]) == most
            if full or (lockstep and costs[key[0]] < costs[alike[-1][0][0]] / _LARGEST_COST_RATIO):
                alike.append([])
            alike[-1].append(key)
        tasks += alike
    return sorted(tasks, key=lambda task: -costs[task[0][0]])


def batch_size(grains: int, count: int) -> int:
    """Replicas of a batch: one on a processor, as many as fit into half the memory of an
    accelerator.
    """
    device = jax.local_devices()[0]
    if device.platform == "cpu":
        return 1
    memory = (device.memory_stats() or {}).get("bytes_limit", _DEFAULT_MEMORY)
    per_replica = (
        _GRAIN_BYTES * max(64, 1 << (grains - 1).bit_length()) + _PAIR_BYTES * min(grains, 512) ** 2
    )
    return int(max(1, min(count, _SHARE_OF_MEMORY * memory / per_replica)))
