"""Runs the replicas of a map, in batches: in threads of this process, or on a cluster.

The random numbers of a replica depend on its flow and its seed only, see ``random_key``. So its
results do not depend on the other points of the map, on the batches, their order or the number of
workers.
"""

import warnings
from collections.abc import Callable, Generator, Sequence
from contextlib import closing
from functools import partial
from itertools import chain
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, UInt32

from jaxgran.dynamics.batch import in_threads, replicas_of, stack
from jaxgran.io.arrays import CorruptFile
from jaxgran.maps.automatic import sampling_targets
from jaxgran.maps.batches import batches
from jaxgran.maps.checkpoint import Checkpoint
from jaxgran.maps.cluster import Provenance, run_on_cluster
from jaxgran.maps.journal import Journal
from jaxgran.maps.replica import Advance, Key, Replica, ReplicaId, replica_ids
from jaxgran.maps.settings import MapSettings
from jaxgran.sampling.observe import AdvanceWrapper, ObserveBatch, advance_batch, reporting
from jaxgran.sampling.sample_batch import sample_batch
from jaxgran.sampling.steady_state import prepare_batch


def run_replicas(
    settings: MapSettings,
    workers: int = 1,
    report: Callable[[Advance], None] | None = None,
    checkpoint: Checkpoint | None = None,
    scheduler: str | None = None,
    record: AdvanceWrapper | None = None,
    made: Provenance | None = None,
) -> Generator[tuple[Key, Replica | None]]:
    """Run every replica of a map and yield its key and result when its batch is done; None if it
    was given up.

    Args:
      settings: the map.
      workers: number of threads; more than one only on a CPU. See ``in_threads`` for how they end.
      report: called after each advance.
      checkpoint: keeps the finished replicas. Replicas that it already has are neither run nor
        yielded.
      scheduler: address of a Dask scheduler, whose workers run the batches instead of this process.
        They keep journals if they can access the folder of the checkpoint. ``report`` is then
        called after whole batches.
      record: wraps the function that advances a sampled batch, but not the one of its preparation.
        It has an effect only with one worker, and each of its batches is one replica.
      made: receives what the workers of a cluster computed with.
    """
    tasks, flows = _remaining_batches(settings, checkpoint), settings.flows()
    if record is not None:  # a recorder follows one replica
        tasks = [[key] for task in tasks for key in task]
    calls = [
        (settings, task, None if checkpoint is None else checkpoint.journal_path(task))
        for task in tasks
    ]
    report = report or (lambda _: None)
    if scheduler is not None:
        outcomes = run_on_cluster(scheduler, _run_task, calls, made)
    elif workers > 1:
        outcomes = in_threads(_run_task, calls, workers, report)
    else:
        outcomes = ((number, _run_task(*call, report, record)) for number, call in enumerate(calls))
    with closing(outcomes):
        for number, outcome in outcomes:
            if outcome is None:
                lost = _points(settings, tasks[number])
                warnings.warn(
                    f"a batch has killed its workers too often: {lost} not measured.", stacklevel=2
                )
                yield from ((key, None) for key in tasks[number])
                continue
            if checkpoint is not None:
                checkpoint.add(dict(outcome))
            if scheduler is not None:
                keys, steps = zip(
                    *((key, replica.sample.tally.steps.sum()) for key, replica in outcome),
                    strict=True,
                )
                report(Advance(keys, [float(flows[point].timestep) for point, _ in keys], steps))
            yield from outcome


def _remaining_batches(settings: MapSettings, checkpoint: Checkpoint | None) -> list[list[Key]]:
    """The batches that a checkpoint does not have yet, the interrupted ones first."""
    if checkpoint is None:
        return batches(settings)
    interrupted = checkpoint.interrupted
    return interrupted + batches(settings, {*checkpoint.done, *chain(*interrupted)})


def _points(settings: MapSettings, task: Sequence[Key]) -> str:
    """The points of a batch, each once, for a message."""
    flows = settings.flows()
    points = dict.fromkeys(
        (float(flows[p].restitution), float(flows[p].packing_fraction)) for p, _ in task
    )
    size = (
        f", {flows[task[0][0]].grains} grains" if "grains" in settings.axes else ""
    )  # one for the whole batch
    return ", ".join(
        f"(restitution {alpha:g}, packing fraction {nu:g}{size})" for alpha, nu in points
    )


def _run_task(
    settings: MapSettings,
    task: Sequence[Key],
    journal: Path | None = None,
    report: Callable[[Advance], None] | None = None,
    record: AdvanceWrapper | None = None,
) -> list[tuple[Key, Replica]]:
    """Prepare and sample the replicas of one batch; a batch that does not fit into memory is
    halved.
    """
    advance, replicas = _reporting(task, report), replica_ids(settings, task)
    try:
        if journal is not None:
            advance = Journal(journal, replicas, advance)
        return _measured(settings, task, replicas, advance, record)
    except CorruptFile:
        assert journal is not None
        journal.unlink(missing_ok=True)
        return _run_task(settings, task, journal, report, record)
    except jax.errors.JaxRuntimeError as error:
        if "RESOURCE_EXHAUSTED" not in str(error) or len(task) == 1:
            raise
        middle = len(task) // 2  # the halves have no journal: it is that of the whole batch
        return [
            done
            for half in (task[:middle], task[middle:])
            for done in _run_task(settings, half, None, report, record)
        ]


def _reporting(task: Sequence[Key], report: Callable[[Advance], None] | None) -> ObserveBatch:
    """The function that advances the replicas of a task and reports it."""
    if report is None:
        return advance_batch
    return reporting(advance_batch, lambda timestep, steps: report(Advance(task, timestep, steps)))


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


def _measured(
    settings: MapSettings,
    task: Sequence[Key],
    replicas: Sequence[ReplicaId],
    advance: ObserveBatch,
    record: AdvanceWrapper | None = None,
) -> list[tuple[Key, Replica]]:
    """Prepare and sample the replicas of a batch."""
    flows = settings.flows()
    flow = stack([flows[point] for point, _ in task])
    keys = np.stack(list(map(random_key, replicas)))
    grains = settings.grains_of(flow.grains, len(task))
    batch = prepare_batch(
        flow, keys, settings.equilibrate, advance, grains=grains, numerics=settings.numerics
    )
    strain_before = batch.strain
    targets = sampling_targets(settings, flow)
    sampling = advance if settings.observe is None else partial(advance, observe=settings.observe)
    batch, sample = sample_batch(
        batch, settings.strain, sampling if record is None else record(sampling), targets
    )
    states = replicas_of(batch.state) if settings.snapshots else [None] * len(task)
    columns = replicas_of(sample), batch.status.tolist(), strain_before.tolist(), states
    return [(key, Replica(*values)) for key, *values in zip(task, *columns, strict=True)]
