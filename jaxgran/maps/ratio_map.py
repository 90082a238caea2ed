"""The ratio map: a grid of restitutions and packing fractions, run in batches on all cores, as an xarray.Dataset.

A list of numbers of grains or of time steps adds an axis to the grid. Every point and seed is a replica. Replicas of
one number of grains and of similar cost form a batch. The most expensive batches run first, so that no core waits long
at the end. The random numbers of a replica depend on its seed and its point only. So results do not depend on the
batches, their order or the number of workers.
"""

import math
import os
import warnings
from collections.abc import Callable, Container, Generator, Sequence
from contextlib import closing, contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, UInt32

from jaxgran.cache.persistent_jit import persistent_jit
from jaxgran.io.atomic import CorruptFile, require_place
from jaxgran.maps.checkpoint import Checkpoint
from jaxgran.maps.cluster import run_on_cluster
from jaxgran.maps.instants import first_instants
from jaxgran.maps.journal import Journal
from jaxgran.maps.pool import WorkerDied, require_processes, run_tasks, send
from jaxgran.maps.replica import Key, Replica
from jaxgran.maps.settings import MapSettings, automatic
from jaxgran.model.checks import InputError, short_repr
from jaxgran.model.choices import MAX_REPLICAS, Activation, Engine, Solver
from jaxgran.model.flow import ShearFlow
from jaxgran.model.status import Status
from jaxgran.sampling.batch import AdvanceBatch, AdvanceWrapper, Report, advance_batch, in_lockstep, reporting, stack
from jaxgran.sampling.budget import sampling_error
from jaxgran.sampling.steady_state import prepare_batch, sample_batch
from jaxgran.sampling.timestep import COARSE_TIMESTEP

if TYPE_CHECKING:
    import xarray as xr

_LARGEST_CPU_BATCH = 4  # replicas of one core between two reports
_SEARCH_BYTES = 48  # memory for each pair of grains, in a search that compares all pairs
_GRAIN_BYTES = 2500  # memory for each grain, of lists, network and state; the number is rounded up to a power of two
_SHARE_OF_MEMORY = 0.5  # of a device, for one batch
_DEFAULT_MEMORY = 8 * 2**30  # bytes of a device that does not report its memory
_MOST_WORKERS = 1024
_LARGEST_COST_RATIO = 2  # between replicas that advance in lockstep


def ratio_map(
    restitution: Sequence[float],
    packing_fraction: Sequence[float],
    *,
    grains: int | Sequence[int] | Literal["auto"] = 256,
    seeds: int = 2,
    first_seed: int = 0,
    timestep: float | Sequence[float] | Literal["auto"] = 1e-3,
    equilibrate: float | None = None,
    strain: float | None = None,
    error: float | None = None,
    tolerance: float | Literal["auto"] = 1e-4,
    target_error: float = 0.02,
    solver: Solver = "barzilai-borwein",
    activation: Activation = "midpoint",
    engine: Engine = "auto",
    snapshots: bool = False,
    batch: int | Literal["auto"] = "auto",
    workers: int = 1,
    report: Report | None = None,
    progress: bool = False,
    checkpoint: str | os.PathLike | None = None,
) -> "xr.Dataset":
    """Force ratio, stresses and temperature over a grid of restitutions and packing fractions, with standard errors.

    Args:
      restitution: values of α in [0, 1], sorted.
      packing_fraction: values of ν in (0, 0.83], sorted.
      grains: number of grains of a replica. A sorted list adds a dimension to the map, and estimates for a large
        system.
      seeds: replicas of each point.
      first_seed: number of the first replica. The random start of a replica follows from its number, so maps with
        first_seed 0 and 2, of two seeds each, are independent.
      timestep: dt of the sample in units of 1/γ̇. A sorted list adds a dimension to the map. "auto" is the longest one
        with a stress error within ``target_error`` at every point.
      equilibrate: strain before the sample, or None to shear until the flow is steady.
      strain: sampled strain of each seed, or None for six memories of each flow and at least 8.
      error: target for the whole relative error of force ratio, pressure and shear stress at every point, half the
        width of an interval of 95 %, see ``error_budget``. Grains, time step and tolerance that are "auto" are chosen
        for it. The strain of a seed is doubled until its share of the error of sampling is reached, up to 256 or 32
        memories. None keeps ``strain``.
      tolerance: relative residual of a contact solve, or "auto".
      target_error: relative error of pressure and shear stress for "auto".
      solver: projected method of the contact solve, see ``projected_methods``.
      activation: "midpoint" or "touching".
      engine: program that advances the flows, see ``ShearFlow``. "auto" selects it for the backend, precision and
        solver. "jax" advances the replicas of a batch in lockstep by ``vmap``, also on a processor.
      snapshots: whether to keep one instant of every point, see ``instant_variables``: its grains after the sample, and
        the forces between them over a strain of 0.002.
      batch: replicas that run together, or "auto".
      workers: number of processes; more than one only on a CPU. A script with more than one must have its main part
        under ``if __name__ == "__main__":``.
      report: called with the replica-steps done since the last call.
      progress: whether to show on standard error how far the map is: a bar on a terminal, lines elsewhere.
      checkpoint: name of a file for this map, such as "map.nc". While the map is run, what is finished is kept in a
        folder beside it, "map.nc.unfinished". If the run is cut off, the same call continues it, and so does
        ``jaxgran map --output map.nc --resume`` with the same parameters. The file itself is not written.

    Returns:
      The dataset described in ``map_dataset``. It has all observables on (packing_fraction, restitution), with standard
      errors and values by seed. Lists of numbers of grains and of time steps add the dimensions grains and timestep in
      front. It also has the status of each point, and all parameters as attributes.

    Raises:
      InputError: (a ValueError) a parameter is out of range; the message says what is accepted. Or the checkpoint is
        of another map or of other versions, or another process writes it; the message names the difference.

    Warns:
      UserWarning: points have a bad status, or their samples are short; the message names them and says what to do.
    """
    choices = {
        "restitution": restitution,
        "packing_fraction": packing_fraction,
        "grains": grains,
        "seeds": seeds,
        "first_seed": first_seed,
        "timestep": timestep,
        "equilibrate": equilibrate,
        "strain": strain,
        "error": error,
        "tolerance": tolerance,
        "solver": solver,
        "activation": activation,
        "engine": engine,
        "snapshots": snapshots,
    }
    numbers, automatic_choice = automatic(
        {name: _plain(x, name == "grains") for name, x in choices.items()}, target_error
    )
    settings = MapSettings(**numbers)
    check_batches(batch, workers)
    if report is not None and not callable(report):
        raise InputError(f"report must be a function of one number, not {short_repr(report)}.")
    if not isinstance(progress, bool):
        raise InputError(f"progress must be True or False, not {short_repr(progress)}.")
    from jaxgran.maps.progress import progress as meter  # here, so that workers need not load Rich

    costs = [predicted_cost(flow) for flow in settings.flows()]
    with _checkpoint(checkpoint, settings) as kept, meter(costs, settings.seeds, quiet=not progress) as shown_to:

        def count(steps: float) -> None:
            shown_to.steps(steps)
            if report is not None:
                report(steps)

        start = perf_counter()
        results: dict[Key, Replica | None] = {} if kept is None else dict(kept.done)
        run: dict[str, Any] = {"automatic_choice": automatic_choice, "workers": workers}
        if kept is not None:
            run["resumed_replicas"] = len(results)
        shown_to.resumed(point for point, _ in results)
        for key, replica in replicas(settings, batch, workers, count, kept):
            results[key] = replica
            shown_to.replica(key[0])
    seconds = perf_counter() - start
    run |= {"wall_time_seconds": seconds, "replica_steps_per_second": shown_to.done_steps / seconds}
    from jaxgran.maps.dataset import map_dataset  # here, so that workers need not load xarray

    data = map_dataset(settings, results, run)
    _warn_of_bad_points(data)
    return data


@contextmanager
def _checkpoint(file: str | os.PathLike | None, settings: MapSettings) -> Generator[Checkpoint | None]:
    """The checkpoint of a map beside a file, or None; it is removed when the block has run every replica."""
    if file is None:
        yield None
        return
    if not isinstance(file, (str, os.PathLike)):
        raise InputError(f"checkpoint must be a file name, not {short_repr(file)}.")
    require_place(Path(file), "checkpoint", ".nc")
    kept = Checkpoint(Path(file), settings, resume=True)
    try:
        yield kept
    finally:
        kept.close(finished=len(kept.done) == len(settings.flows()) * settings.seeds)


def _warn_of_bad_points(data: "xr.Dataset") -> None:
    """Warn of what the command line prints at the end of a map."""
    from jaxgran.maps.status_report import bad_points, in_words, short_in_words

    bad = bad_points(data)
    bad.pop("failed", None)  # batches that were given up have had a warning of their own
    short = bad.pop("short_sample", [])
    if short:
        warnings.warn(short_in_words(data, short, "strain="), stacklevel=3)
    if bad:
        warnings.warn(f"points of the map have a bad status. {in_words(bad).replace('--', '')}", stacklevel=3)


def check_batches(batch: int | Literal["auto"], workers: int) -> None:
    """Raise an InputError if the size of a batch or the number of workers is not accepted."""
    for name, value in (("batch", batch), ("workers", workers)):
        whole = isinstance(value, (int, np.integer)) and not isinstance(value, bool) and value >= 1
        if not whole and not (name == "batch" and isinstance(value, str) and value == "auto"):
            words = "auto or a whole number" if name == "batch" else "a whole number"
            raise InputError(f"{name} must be {words} of at least 1, not {short_repr(value)}.")
    if workers > _MOST_WORKERS:
        raise InputError(f"workers must be at most {_MOST_WORKERS}, not {short_repr(workers)}.")
    if workers > 1 and jax.default_backend() != "cpu":
        raise InputError("workers must be 1 on an accelerator.")
    if workers > 1:
        require_processes()


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
      batch: replicas that run together, or "auto": a few on a CPU, as many as fit into memory on an accelerator.
      workers: number of processes; more than one only on a CPU. They end when the iterator is closed.
      report: called with the replica-steps done since the last call.
      checkpoint: keeps the finished replicas. Replicas that it already has are neither run nor yielded.
      warn: called with one sentence about each batch that is given up.
      scheduler: address of a Dask cluster, whose workers run the batches instead of processes of this machine. They
        keep journals if they can access the folder of the checkpoint. ``report`` is then called after whole batches.
      record: wraps the drive of every sample, but not that of its preparation. It has an effect only if the batches run
        in this process.
    """
    tasks = _remaining(settings, batch, workers, checkpoint)
    calls = [(settings, task, None if checkpoint is None else checkpoint.journal_path(task)) for task in tasks]
    configuration = (jax.config.read("jax_enable_x64"), jax.config.values["jax_compilation_cache_dir"])
    on_steps = report or (lambda _: None)
    if scheduler is not None:
        outcomes = run_on_cluster(scheduler, _run_task, calls, _configure, (configuration[0], None))
    elif workers > 1:
        outcomes = run_tasks(_run_task, calls, workers, _configure, configuration, on_steps)
    else:
        outcomes = ((number, _run_task(*call, report, record)) for number, call in enumerate(calls))
    with closing(outcomes):
        for number, outcome in outcomes:
            if isinstance(outcome, WorkerDied):
                warn(f"{outcome}: {_points(settings, tasks[number])} not measured.")
                yield from ((key, None) for key in tasks[number])
                continue
            if checkpoint is not None:
                checkpoint.add(dict(outcome))
            if scheduler is not None:
                on_steps(float(sum(replica.sample.tally.steps.sum() for _, replica in outcome)))
            yield from outcome


def _plain(value: Any, whole: bool = False) -> Any:
    """A number as a Python number, a list or array of numbers as a tuple; ``MapSettings`` checks all other values.

    Whole numbers of a list stay whole if ``whole``.
    """
    try:
        if isinstance(value, np.ma.MaskedArray) or (isinstance(value, Sequence) and len(value) > MAX_REPLICAS):
            return value
        array = np.asarray(value)
    except (TypeError, ValueError):  # a random key, or lists of different lengths
        return value
    real = array.ndim and array.dtype.kind in "iu" and not whole
    plain = array.astype(float).tolist() if real else array.tolist()
    return tuple(plain) if isinstance(plain, list) else plain


def predicted_cost(flow: ShearFlow) -> float:
    """Relative cost of a unit of strain of a flow, a fit to measured times.

    The cost is proportional to the number of grains. Dense and dissipative flows form contact networks; the second
    factor is their cost at dt = 1e-3. Steps without a contact are jumped over, so ten times as many steps cost little
    more than twice as much.
    """
    alpha, nu, dt = (float(x) for x in (flow.restitution, flow.packing_fraction, flow.timestep))
    return flow.grains * (8 + 600 * (1 - alpha) * math.exp((nu - 0.8) / 0.04)) * (1e-3 / dt) ** 0.35


def _remaining(
    settings: MapSettings, batch: int | Literal["auto"], workers: int, checkpoint: Checkpoint | None
) -> list[list[Key]]:
    """The batches to run, the interrupted ones first."""
    if checkpoint is None:
        return _tasks(settings, batch, workers)
    interrupted = checkpoint.journals()
    excluded = {*checkpoint.done, *(key for task in interrupted for key in task)}
    return interrupted + _tasks(settings, batch, workers, excluded)


def _tasks(
    settings: MapSettings, batch: int | Literal["auto"], workers: int, without: Container[Key] = ()
) -> list[list[Key]]:
    """The replicas in batches of one number of grains and of similar cost, the most expensive first."""
    flows = settings.flows()
    costs = [predicted_cost(flow) for flow in flows]
    order = sorted(range(len(costs)), key=lambda point: -costs[point])
    lockstep = in_lockstep(settings.engine)
    tasks: list[list[Key]] = []
    for grains in {flow.grains: None for flow in flows}:
        points = [point for point in order if flows[point].grains == grains]
        keys = [(point, seed) for point in points for seed in range(settings.seeds) if (point, seed) not in without]
        size = _batch_size(grains, len(keys), workers) if batch == "auto" and keys else batch
        batches: list[list[Key]] = []
        for key in keys:
            full = not batches or len(batches[-1]) == size
            if full or (lockstep and costs[key[0]] < costs[batches[-1][0][0]] / _LARGEST_COST_RATIO):
                batches.append([])
            batches[-1].append(key)
        tasks += batches
    return sorted(tasks, key=lambda task: -costs[task[0][0]])


def _batch_size(grains: int, count: int, workers: int) -> int:
    """Number of replicas of a batch for "auto"."""
    devices, device = jax.device_count(), jax.local_devices()[0]
    if device.platform == "cpu":
        largest = max(min(devices, count), min(_LARGEST_CPU_BATCH * devices, count // (8 * workers)))
        # equal batches: a smaller last one would compile again
        return next(size for size in range(largest, 0, -1) if count % size == 0)
    memory = (device.memory_stats() or {}).get("bytes_limit", _DEFAULT_MEMORY)
    per_replica = _GRAIN_BYTES * max(64, 1 << (grains - 1).bit_length()) + _SEARCH_BYTES * min(grains, 512) ** 2
    return int(max(1, min(count, _SHARE_OF_MEMORY * memory * devices / per_replica)))


def _configure(x64: bool, cache: str | None) -> None:
    """Set up a worker with the precision and the compilation cache of its parent.

    The flags of XLA are not changed: other flags would sum small matrix products in another order than in the parent.
    """
    jax.config.update("jax_enable_x64", x64)
    if cache is not None:
        jax.config.update("jax_compilation_cache_dir", cache)


def _points(settings: MapSettings, task: Sequence[Key]) -> str:
    """The points of a batch in words, each once."""
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
    drive = reporting(advance_batch, report or send)
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
    drive: AdvanceBatch,
    refinement: int = 1,
    record: AdvanceWrapper | None = None,
) -> list[tuple[Key, Replica]]:
    """Prepare and sample the replicas of a batch, with time steps divided by ``refinement``."""
    flows = settings.flows()
    flow = stack([replace(flows[point], timestep=flows[point].timestep / refinement) for point, _ in task])
    keys = jax.device_put(np.stack([_key(settings.first_seed + seed, point, refinement) for point, seed in task]))
    batch = prepare_batch(flow, keys, settings.equilibrate, drive, COARSE_TIMESTEP / refinement)
    strain_before = batch.strain
    error = None if settings.error is None else sampling_error(settings.error) * math.sqrt(settings.seeds)
    batch, sample = sample_batch(batch, settings.strain, drive if record is None else record(drive), error)
    instants = first_instants(batch, task) if settings.snapshots else [None] * len(task)
    numbers = zip(batch.status.tolist(), strain_before.tolist(), instants, strict=True)
    return [
        (key, Replica(jax.tree.map(lambda x, k=k: x[k], sample), *one))
        for k, (key, one) in enumerate(zip(task, numbers, strict=True))
    ]
