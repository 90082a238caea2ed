"""The ratio map: a grid of restitutions and packing fractions, run in batches on all cores, as an xarray.Dataset.

A list of time steps adds an axis to the grid. Every point and seed is a replica. Replicas of like cost form a batch;
batches go through a queue, the most expensive first, so that no core waits for another. A replica's random numbers
depend on its seed and its place in the grid alone, so results do not depend on the batches, their order or the number
of workers.
"""

import math
import warnings
from collections.abc import Callable, Container, Generator, Sequence
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr

from jaxgran.io.atomic import Damaged
from jaxgran.maps.checkpoint import Checkpoint
from jaxgran.maps.cluster import run_on_cluster
from jaxgran.maps.dataset import Key, Replica, map_dataset
from jaxgran.maps.journal import Journal
from jaxgran.maps.pool import Died, run_tasks, send
from jaxgran.maps.settings import MapSettings, automatic
from jaxgran.model.checks import InputError, shown
from jaxgran.model.flow import MAX_REPLICAS, Activation, Engine, ShearFlow, Solver
from jaxgran.model.status import Status
from jaxgran.sampling.batch import Drive, Report, Wrap, advance_batch, in_lockstep, reporting, stack
from jaxgran.sampling.steady_state import prepare_batch, sample_batch
from jaxgran.sampling.timestep import COARSE_TIMESTEP

_LARGEST_CPU_BATCH = 4  # replicas that one core works off between two reports
_SEARCH_BYTES = 48  # per pair of grains, working memory of a search that compares all pairs
_GRAIN_BYTES = 2500  # lists, network and state of a replica: for each grain, filled up to a power of two
_SHARE_OF_MEMORY = 0.5
_MOST_WORKERS = 1024
_LIKE = 2  # replicas that advance in lockstep differ in cost by at most this factor


def ratio_map(
    restitution: Sequence[float],
    packing_fraction: Sequence[float],
    *,
    grains: int = 256,
    seeds: int = 2,
    timestep: float | Sequence[float] | Literal["auto"] = 1e-3,
    equilibrate: float | None = None,
    strain: float = 10.0,
    error: float | None = None,
    tolerance: float | Literal["auto"] = 1e-4,
    target_error: float = 0.02,
    solver: Solver = "barzilai-borwein",
    activation: Activation = "midpoint",
    engine: Engine = "auto",
    batch: int | Literal["auto"] = "auto",
    workers: int = 1,
    report: Report | None = None,
) -> xr.Dataset:
    """Force ratio, stresses and temperature over a grid of restitutions and packing fractions, with standard errors.

    Args:
      restitution: values of α in [0, 1], sorted.
      packing_fraction: values of ν in (0, 0.83], sorted.
      grains: number of grains of a replica.
      seeds: replicas of each point.
      timestep: dt of the sample in units of 1/γ̇; a sorted list of them adds a dimension to the map; "auto" for the
        longest whose stresses are within the target error at every point.
      equilibrate: strain before the sample, or None to shear until the flow is steady.
      strain: sampled strain of each seed.
      error: relative standard error of force ratio, pressure and shear stress to reach at every point: the strain of a
        seed is doubled until its share of the error is reached, or the strain would exceed 256. None keeps the strain.
      tolerance: relative residual of a contact solve, or "auto".
      target_error: relative error of pressure and shear stress that "auto" aims at.
      solver: projected method of the contact solve, see ``projected_methods``.
      activation: "midpoint" or "touching".
      engine: what advances the flows, see ``ShearFlow``; "auto" for the fastest that can. "jax" advances the replicas
        of a batch in lockstep by ``vmap``, on a processor too.
      batch: replicas that run together, or "auto".
      workers: processes; more than one only on a CPU, and then a script must guard its main part by
        ``if __name__ == "__main__":``.
      report: called with the replica-steps done since the last call.

    Returns:
      The dataset described in ``map_dataset``: every observable on (packing_fraction, restitution), or on (timestep,
      packing_fraction, restitution) where a list of time steps is given, with its standard error and its values by
      seed, the status of each point, and every parameter as an attribute.

    Raises:
      ValueError: a parameter is out of range; the sentence says what is accepted.
    """
    choices = {
        "restitution": restitution,
        "packing_fraction": packing_fraction,
        "grains": grains,
        "seeds": seeds,
        "timestep": timestep,
        "equilibrate": equilibrate,
        "strain": strain,
        "error": error,
        "tolerance": tolerance,
        "solver": solver,
        "activation": activation,
        "engine": engine,
    }
    numbers, automatic_choice = automatic({name: _plain(x) for name, x in choices.items()}, target_error)
    settings = MapSettings(**numbers)
    check_batches(batch, workers)
    if report is not None and not callable(report):
        raise InputError(f"report must be a function of one number, not {shown(report)}.")
    start, done = perf_counter(), 0.0

    def count(steps: float) -> None:
        nonlocal done
        done += steps
        if report is not None:
            report(steps)

    results = dict(replicas(settings, batch, workers, count))
    seconds = perf_counter() - start
    run = {
        "automatic_choice": automatic_choice,
        "wall_time_seconds": seconds,
        "replica_steps_per_second": done / seconds,
        "workers": workers,
    }
    return map_dataset(settings, results, run)


def check_batches(batch: int | Literal["auto"], workers: int) -> None:
    """Raise a ValueError in one sentence where replicas cannot be run in such batches by so many processes."""
    for name, value in (("batch", batch), ("workers", workers)):
        whole = isinstance(value, (int, np.integer)) and not isinstance(value, bool) and value >= 1
        if not whole and not (name == "batch" and isinstance(value, str) and value == "auto"):
            words = "auto or a whole number" if name == "batch" else "a whole number"
            raise InputError(f"{name} must be {words} of at least 1, not {shown(value)}.")
    if workers > _MOST_WORKERS:
        raise InputError(f"workers must be at most {_MOST_WORKERS}, not {shown(workers)}.")
    if workers > 1 and jax.default_backend() != "cpu":
        raise InputError("workers must be 1 on an accelerator.")


def replicas(
    settings: MapSettings,
    batch: int | Literal["auto"] = "auto",
    workers: int = 1,
    report: Report | None = None,
    checkpoint: Checkpoint | None = None,
    warn: Callable[[str], None] = warnings.warn,
    scheduler: str | None = None,
    record: Wrap | None = None,
) -> Generator[tuple[Key, Replica]]:
    """Run every replica of a map and yield it, with its point and seed, as soon as its batch is done.

    Args:
      settings: the map.
      batch: replicas that run together, or "auto": a few on a CPU, what the memory holds on an accelerator.
      workers: processes; more than one only on a CPU. They end when the iterator is closed.
      report: told the replica-steps done since the last call.
      checkpoint: where to keep what is done; replicas that are done there are not run and not yielded again.
      warn: told in one sentence what went wrong with a batch that is given up.
      scheduler: address of a Dask cluster whose workers run the batches, in place of processes of this machine. A
        journal is kept where they see the folder of the checkpoint; the report follows whole batches.
      record: wraps the drive of every sample, not of what precedes it; heard in this process alone.
    """
    tasks = _remaining(settings, batch, workers, checkpoint)
    calls = [(settings, task, None if checkpoint is None else checkpoint.journal_path(task)) for task in tasks]
    configuration = (jax.config.read("jax_enable_x64"), jax.config.values["jax_compilation_cache_dir"])
    hear = report or (lambda _: None)
    if scheduler is not None:
        outcomes = run_on_cluster(scheduler, _run_task, calls, _configure, (configuration[0], None))
    elif workers > 1:
        outcomes = run_tasks(_run_task, calls, workers, _configure, configuration, hear)
    else:
        outcomes = ((number, _run_task(*call, report, record)) for number, call in enumerate(calls))
    with closing(outcomes):
        for number, outcome in outcomes:
            if isinstance(outcome, Died):
                warn(f"{outcome}: {_points(settings, tasks[number])} not measured.")
                continue
            if checkpoint is not None:
                checkpoint.add(dict(outcome))
            if scheduler is not None:
                hear(float(sum(replica.sample.tally.steps.sum() for _, replica in outcome)))
            yield from outcome


def _plain(value: Any) -> Any:
    """A number as it is in Python, a list or array of them as a tuple; what is neither is left for ``MapSettings``."""
    try:
        if isinstance(value, np.ma.MaskedArray) or (isinstance(value, Sequence) and len(value) > MAX_REPLICAS):
            return value
        array = np.asarray(value)
    except (TypeError, ValueError):  # a key, or lists of several lengths
        return value
    plain = array.astype(float).tolist() if array.ndim and array.dtype.kind in "iu" else array.tolist()
    return tuple(plain) if isinstance(plain, list) else plain


def predicted_cost(flow: ShearFlow) -> float:
    """Relative cost of a unit of strain of a flow, from measurements.

    Dense and dissipative flows form networks, at dt = 1e-3 as in the first factor. Steps without contact are jumped
    over, so that ten times as many steps cost little more than twice as much.
    """
    alpha, nu, dt = (float(x) for x in (flow.restitution, flow.packing_fraction, flow.timestep))
    return (8 + 600 * (1 - alpha) * math.exp((nu - 0.8) / 0.04)) * (1e-3 / dt) ** 0.35


def _remaining(
    settings: MapSettings, batch: int | Literal["auto"], workers: int, checkpoint: Checkpoint | None
) -> list[list[Key]]:
    """The batches that are still to be run, those that are under way first."""
    if checkpoint is None:
        return _tasks(settings, batch, workers)
    begun = checkpoint.journals()
    return begun + _tasks(settings, batch, workers, {*checkpoint.done, *(key for task in begun for key in task)})


def _tasks(
    settings: MapSettings, batch: int | Literal["auto"], workers: int, without: Container[Key] = ()
) -> list[list[Key]]:
    """The replicas in batches of like cost, the most expensive first."""
    costs = [predicted_cost(flow) for flow in settings.flows()]
    order = sorted(range(len(costs)), key=lambda point: -costs[point])
    keys = [(point, seed) for point in order for seed in range(settings.seeds) if (point, seed) not in without]
    size = _batch_size(settings.grains, len(keys), workers) if batch == "auto" and keys else batch
    lockstep = in_lockstep(settings.engine)
    tasks: list[list[Key]] = []
    for key in keys:
        full = not tasks or len(tasks[-1]) == size
        if full or (lockstep and costs[key[0]] < costs[tasks[-1][0][0]] / _LIKE):
            tasks.append([])
        tasks[-1].append(key)
    return tasks


def _batch_size(grains: int, count: int, workers: int) -> int:
    devices, device = jax.device_count(), jax.local_devices()[0]
    if device.platform == "cpu":
        largest = max(min(devices, count), min(_LARGEST_CPU_BATCH * devices, count // (8 * workers)))
        return next(size for size in range(largest, 0, -1) if count % size == 0)  # a smaller last one compiles again
    memory = (device.memory_stats() or {}).get("bytes_limit", 8 * 2**30)
    per_replica = _GRAIN_BYTES * max(64, 1 << (grains - 1).bit_length()) + _SEARCH_BYTES * min(grains, 512) ** 2
    return int(max(1, min(count, _SHARE_OF_MEMORY * memory * devices / per_replica)))


def _configure(x64: bool, cache: str | None) -> None:
    """Set up a worker with the precision of its parent.

    XLA keeps its flags: with others, small matrix products would be summed in another order than in the parent.
    """
    jax.config.update("jax_enable_x64", x64)
    if cache is not None:
        jax.config.update("jax_compilation_cache_dir", cache)


def _points(settings: MapSettings, task: Sequence[Key]) -> str:
    flows = settings.flows()
    places = {(float(flows[p].restitution), float(flows[p].packing_fraction)): None for p, _ in task}
    return ", ".join(f"(restitution {alpha:g}, packing fraction {nu:g})" for alpha, nu in places)


def _run_task(
    settings: MapSettings,
    task: Sequence[Key],
    journal: Path | None = None,
    report: Report | None = None,
    record: Wrap | None = None,
) -> list[tuple[Key, Replica]]:
    """Prepare and sample the replicas of one batch; one that does not fit into the memory is halved."""
    drive = reporting(advance_batch, report or send)
    measured = _measured if record is None else partial(_measured, record=record)
    try:
        done = measured(settings, task, drive if journal is None else Journal(journal, task, drive))
        return _retried(settings, done, partial(measured, drive=drive, refinement=2))
    except Damaged:
        assert journal is not None
        journal.unlink(missing_ok=True)
        return _run_task(settings, task, journal, report, record)
    except jax.errors.JaxRuntimeError as error:
        if "RESOURCE_EXHAUSTED" not in str(error) or len(task) == 1:
            raise
        middle = len(task) // 2  # without a journal, which is that of the whole batch
        return [
            done for half in (task[:middle], task[middle:]) for done in _run_task(settings, half, None, report, record)
        ]


def _retried(
    settings: MapSettings, done: list[tuple[Key, Replica]], refined: Callable[..., list[tuple[Key, Replica]]]
) -> list[tuple[Key, Replica]]:
    """The replicas of a batch, those that came to nothing once more from another start and with half the time steps."""
    failed = [key for key, replica in done if replica.status >= Status.infeasible]
    again = dict(refined(settings, failed)) if failed else {}
    return [(key, again[key] if key in again and again[key].status < one.status else one) for key, one in done]


def _measured(
    settings: MapSettings, task: Sequence[Key], drive: Drive, refinement: int = 1, record: Wrap | None = None
) -> list[tuple[Key, Replica]]:
    flows = settings.flows()
    flow = stack([replace(flows[point], timestep=flows[point].timestep / refinement) for point, _ in task])
    keys = jnp.stack([jax.random.fold_in(jax.random.key(seed), point) for point, seed in task])
    if refinement > 1:
        keys = jax.vmap(jax.random.fold_in, (0, None))(keys, refinement)
    batch = prepare_batch(flow, keys, settings.equilibrate, drive, COARSE_TIMESTEP / refinement)
    prepared = batch.strain
    error = None if settings.error is None else settings.error * math.sqrt(settings.seeds)
    batch, sample = sample_batch(batch, settings.strain, drive if record is None else record(drive), error)
    return [
        (key, Replica(jax.tree.map(lambda x, k=k: x[k], sample), int(batch.status[k]), float(prepared[k])))
        for k, key in enumerate(task)
    ]
