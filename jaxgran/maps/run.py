"""Runs the replicas of a map, in batches: in threads of this process, or on a cluster.

The random numbers of a replica depend on its flow and its seed only, see ``random_key``. So its
results do not depend on the other points of the map, on the batches, their order or the number of
workers.
"""

import warnings
from collections.abc import Callable, Generator, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, UInt32

from jaxgran.dynamics.batch import in_threads, replicas_of, stack
from jaxgran.io.arrays import CorruptFile
from jaxgran.maps.automatic import sampling_targets
from jaxgran.maps.batches import batches
from jaxgran.maps.blocks import KeptBlocks
from jaxgran.maps.cluster import Provenance, run_on_cluster
from jaxgran.maps.replica import Advance, Replica, ReplicaId
from jaxgran.maps.settings import MapSettings
from jaxgran.model.status import Status
from jaxgran.sampling.observe import AdvanceBatch, AdvanceWrapper, advance_batch, reporting
from jaxgran.sampling.sample_batch import sample_batch
from jaxgran.sampling.steady_state import prepare_batch

Batch = Sequence[ReplicaId]


def run_replicas(
    settings: MapSettings,
    replicas: Batch,
    workers: int = 1,
    report: Callable[[Advance], None] = lambda _: None,
    scheduler: str | None = None,
    record: AdvanceWrapper | None = None,
    blocks_path: Callable[[Batch], Path] | None = None,
    made: Provenance | None = None,
) -> Generator[Replica]:
    """Run replicas of a map and yield each when its batch is done.

    Args:
      settings: the map.
      replicas: those that are missing.
      workers: number of threads; more than one only on a CPU. See ``in_threads`` for how they end.
      report: called after each advance.
      scheduler: address of a Dask scheduler, whose workers run the batches instead of this process.
        ``report`` is then called after whole batches.
      record: wraps the function that advances a sampled batch, but not the one of its preparation.
        It has an effect only with one worker, and each of its batches is one replica.
      blocks_path: the file for the blocks of a batch, see ``KeptBlocks``; None to keep none.
        Workers of a cluster use it if they can access its folder.
      made: receives what the workers of a cluster computed with.
    """
    tasks = batches(settings, replicas)
    if record is not None:  # a recorder follows one replica
        tasks = [[replica] for task in tasks for replica in task]
    paths = [None if blocks_path is None else blocks_path(task) for task in tasks]
    calls = list(zip([settings] * len(tasks), tasks, paths, strict=True))
    if scheduler is not None:
        outcomes = run_on_cluster(scheduler, _run_batch, calls, made)
    elif workers > 1:
        outcomes = in_threads(_run_batch, calls, workers, report)
    else:
        outcomes = (
            (number, _run_batch(*call, report, record)) for number, call in enumerate(calls)
        )
    with closing(outcomes):
        for number, outcome in outcomes:
            if outcome is None:
                lost = ", ".join(dict.fromkeys(_text(settings, x) for x in tasks[number]))
                warnings.warn(
                    f"a batch has killed its workers too often: {lost} not measured.", stacklevel=2
                )
                yield from (Replica(x, None, Status.failed, np.nan) for x in tasks[number])
                continue
            if scheduler is not None:
                steps = [int(x.sample.tally.steps.sum()) for x in outcome if x.sample is not None]
                report(Advance(tasks[number], [x.id.timestep for x in outcome], steps))
            yield from outcome


def _text(settings: MapSettings, replica: ReplicaId) -> str:
    """The point of a replica, for a message."""
    size = f", {replica.grains} grains" if "grains" in settings.dimensions else ""
    flow = f"restitution {replica.restitution:g}, packing fraction {replica.packing_fraction:g}"
    return f"({flow}{size})"


def _run_batch(
    settings: MapSettings,
    replicas: Batch,
    blocks: Path | None = None,
    report: Callable[[Advance], None] | None = None,
    record: AdvanceWrapper | None = None,
) -> list[Replica]:
    """Prepare and sample the replicas of one batch; one that does not fit into memory is halved."""
    advance: AdvanceBatch = advance_batch
    if report is not None:
        advance = reporting(advance, lambda dt, steps: report(Advance(replicas, dt, steps)))
    try:
        if blocks is not None:
            advance = KeptBlocks(blocks, replicas, advance)
        return _measured(settings, replicas, advance, record)
    except CorruptFile:
        assert blocks is not None
        blocks.unlink(missing_ok=True)
        return _run_batch(settings, replicas, blocks, report, record)
    except jax.errors.JaxRuntimeError as error:
        if "RESOURCE_EXHAUSTED" not in str(error) or len(replicas) == 1:
            raise
        middle = len(replicas) // 2  # the halves keep no blocks: the file is that of the batch
        halves = replicas[:middle], replicas[middle:]
        return [x for half in halves for x in _run_batch(settings, half, None, report, record)]


def _measured(
    settings: MapSettings,
    replicas: Batch,
    advance: AdvanceBatch,
    record: AdvanceWrapper | None = None,
) -> list[Replica]:
    """Prepare and sample the replicas of a batch."""
    flow = stack([settings.flows[replica.point] for replica in replicas])
    keys = np.stack(list(map(random_key, replicas)))
    grains = settings.grains_of(flow.grains, len(replicas))
    batch = prepare_batch(
        flow, keys, settings.equilibrate, advance, grains=grains, numerics=settings.numerics
    )
    strain_before = batch.strain
    targets = sampling_targets(settings, flow)
    sampling = advance if settings.observe is None else partial(advance, observe=settings.observe)
    batch, sample = sample_batch(
        batch, settings.strain, sampling if record is None else record(sampling), targets
    )
    states = replicas_of(batch.state) if settings.snapshots else [None] * len(replicas)
    columns = replicas_of(sample), batch.status.tolist(), strain_before.tolist(), states
    return [Replica(*row) for row in zip(replicas, *columns, strict=True)]


def random_key(replica: ReplicaId) -> UInt32[Array, "2"]:
    """The random key of a replica, as numbers: that of its seed, with the checksum of its flow
    folded in; by threefry2x32, whatever flags JAX has.
    """
    return _folded_key(replica.seed, np.uint32(replica.checksum))


@jax.jit
def _folded_key(seed: Array, number: Array) -> UInt32[Array, "2"]:
    numbers = jnp.stack([jnp.uint32(0), jnp.asarray(seed, jnp.uint32)])  # as of jax.random.key
    key = jax.random.wrap_key_data(numbers, impl="threefry2x32")
    return jax.random.key_data(jax.random.fold_in(key, number))
