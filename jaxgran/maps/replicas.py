"""Runs the replicas of a map, in batches: in threads of this process, or on a cluster.

The random numbers of a replica depend on its seed and its point only. So results do not depend on the batches, their
order or the number of workers.
"""

import math
import warnings
from collections.abc import Callable, Generator, Sequence
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, UInt32

from jaxgran.cache.persistent_jit import persistent_jit
from jaxgran.dynamics.threads import in_threads
from jaxgran.io.atomic import CorruptFile
from jaxgran.maps.batches import remaining_batches
from jaxgran.maps.checkpoint import Checkpoint
from jaxgran.maps.cluster import run_on_cluster
from jaxgran.maps.instants import first_instants
from jaxgran.maps.journal import Journal
from jaxgran.maps.replica import Key, Replica
from jaxgran.maps.settings import MapSettings
from jaxgran.model.status import Status
from jaxgran.sampling.batch import AdvanceWrapper, ObserveBatch, Report, advance_batch, reporting, stack
from jaxgran.sampling.budget import sampling_error
from jaxgran.sampling.steady_state import prepare_batch, sample_batch
from jaxgran.sampling.timestep import COARSE_TIMESTEP


def replicas(
    settings: MapSettings,
    batch: int | Literal["auto"] = "auto",
    workers: int = 1,
    report: Report | None = None,
    checkpoint: Checkpoint | None = None,
    warn: Callable[[str], None] = warnings.warn,
    scheduler: str | None = None,
    record: AdvanceWrapper | None = None,
) -> Generator[tuple[Key, Replica | None]]:
    """Run every replica of a map and yield its key and result when its batch is done; None if it was given up.

    Args:
      settings: the map.
      batch: number of replicas that run together, or "auto", see ``batch_size``.
      workers: number of threads; more than one only on a CPU. See ``in_threads`` for how they end.
      report: called with the replica-steps done since its last call.
      checkpoint: keeps the finished replicas. Replicas that it already has are neither run nor yielded.
      warn: called with one sentence about each batch that is given up.
      scheduler: address of a Dask scheduler, whose workers run the batches instead of this process. They
        keep journals if they can access the folder of the checkpoint. ``report`` is then called after whole batches.
      record: wraps the function that advances a sampled batch, but not the one of its preparation. It has an effect
        only with one worker.
    """
    tasks = remaining_batches(settings, batch, workers, checkpoint)
    calls = [(settings, task, None if checkpoint is None else checkpoint.journal_path(task)) for task in tasks]
    on_steps = report or (lambda _: None)
    if scheduler is not None:
        outcomes = run_on_cluster(scheduler, _run_task, calls)
    elif workers > 1:
        outcomes = in_threads(_run_task, calls, workers, on_steps)
    else:
        outcomes = ((number, _run_task(*call, report, record)) for number, call in enumerate(calls))
    with closing(outcomes):
        for number, outcome in outcomes:
            if outcome is None:
                warn(f"a batch has killed its workers too often: {_points(settings, tasks[number])} not measured.")
                yield from ((key, None) for key in tasks[number])
                continue
            if checkpoint is not None:
                checkpoint.add(dict(outcome))
            if scheduler is not None:
                on_steps(float(sum(replica.sample.tally.steps.sum() for _, replica in outcome)))
            yield from outcome


def _points(settings: MapSettings, task: Sequence[Key]) -> str:
    """The points of a batch, each once, for a message."""
    flows = settings.flows()
    points = dict.fromkeys((float(flows[p].restitution), float(flows[p].packing_fraction)) for p, _ in task)
    size = f", {flows[task[0][0]].grains} grains" if "grains" in settings.axes else ""  # one for the whole batch
    return ", ".join(f"(restitution {alpha:g}, packing fraction {nu:g}{size})" for alpha, nu in points)


def _run_task(
    settings: MapSettings,
    task: Sequence[Key],
    journal: Path | None = None,
    report: Report | None = None,
    record: AdvanceWrapper | None = None,
) -> list[tuple[Key, Replica]]:
    """Prepare and sample the replicas of one batch; a batch that does not fit into memory is halved."""
    drive = reporting(advance_batch, report)
    measured = _measured if record is None else partial(_measured, record=record)
    try:
        done = measured(settings, task, drive if journal is None else Journal(journal, task, drive))
        return _retried(settings, done, partial(measured, drive=drive, refinement=2))
    except CorruptFile:
        assert journal is not None
        journal.unlink(missing_ok=True)
        return _run_task(settings, task, journal, report, record)
    except jax.errors.JaxRuntimeError as error:
        if "RESOURCE_EXHAUSTED" not in str(error) or len(task) == 1:
            raise
        middle = len(task) // 2  # the halves have no journal: it is that of the whole batch
        return [
            done for half in (task[:middle], task[middle:]) for done in _run_task(settings, half, None, report, record)
        ]


def _retried(
    settings: MapSettings, done: list[tuple[Key, Replica]], refined: Callable[..., list[tuple[Key, Replica]]]
) -> list[tuple[Key, Replica]]:
    """The replicas of a batch. Failed ones are run again once, from another packing and with half the time steps.

    The second result is kept if its status is better.
    """
    failed = [key for key, replica in done if replica.status >= Status.infeasible]
    second = dict(refined(settings, failed)) if failed else {}
    return [(key, second[key] if key in second and second[key].status < first.status else first) for key, first in done]


@persistent_jit
def _key(seed: Array, point: Array, refinement: Array) -> UInt32[Array, "2"]:
    """The random key of a replica, as numbers; another one for its second run."""
    key = jax.random.fold_in(jax.random.key(seed), point)
    return jax.random.key_data(jnp.where(refinement > 1, jax.random.fold_in(key, refinement), key))


def _measured(
    settings: MapSettings,
    task: Sequence[Key],
    drive: ObserveBatch,
    refinement: int = 1,
    record: AdvanceWrapper | None = None,
) -> list[tuple[Key, Replica]]:
    """Prepare and sample the replicas of a batch, with time steps divided by ``refinement``."""
    flows = settings.flows()
    flow = stack([replace(flows[point], timestep=flows[point].timestep / refinement) for point, _ in task])
    keys = jax.device_put(np.stack([_key(settings.first_seed + seed, point, refinement) for point, seed in task]))
    coarse = COARSE_TIMESTEP / refinement
    batch = prepare_batch(flow, keys, settings.equilibrate, drive, coarse, numerics=settings.numerics)
    strain_before = batch.strain
    error = None if settings.error is None else sampling_error(settings.error) * math.sqrt(settings.seeds)
    sampling = drive if settings.observe is None else partial(drive, observe=settings.observe)
    batch, sample = sample_batch(batch, settings.strain, sampling if record is None else record(sampling), error)
    instants = first_instants(batch, task) if settings.snapshots else [None] * len(task)
    numbers = zip(batch.status.tolist(), strain_before.tolist(), instants, strict=True)
    return [
        (key, Replica(jax.tree.map(lambda x, k=k: x[k], sample), *one))
        for k, (key, one) in enumerate(zip(task, numbers, strict=True))
    ]
