"""The ratio map: a grid of restitutions and packing fractions, run in batches on all cores, as a
dataset and a file.
"""

import inspect
import os
import sys
import warnings
from contextlib import closing, suppress
from pathlib import Path
from threading import Thread
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxgran.dynamics.advance import register_numba
from jaxgran.dynamics.engine import Numba, in_lockstep, select_engine
from jaxgran.environment import usable_cores
from jaxgran.io.atomic import require_place
from jaxgran.maps.batches import points_of_part
from jaxgran.maps.checkpoint import Checkpoint
from jaxgran.maps.cluster import Provenance
from jaxgran.maps.interruption import Interrupted, is_interruption
from jaxgran.maps.parameters import RunParameters, takes
from jaxgran.maps.presets import with_start
from jaxgran.maps.replica import Advance, Key, Replica
from jaxgran.maps.run_replicas import run_replicas
from jaxgran.maps.settings import MapSettings, chosen_settings
from jaxgran.model.checks import InputError, refused, require_flag, require_whole, short_repr

if TYPE_CHECKING:
    import xarray as xr

_MOST_WORKERS = 1024
_OF_RUN = (
    *("engine", "solver", "history", "part_points", "automatic_choice", "resumed_replicas"),
    *("wall_time_seconds", "replica_steps_per_second"),
)
"""Attributes of a map that are no parameters and not those of ``run_attributes``."""


@takes(RunParameters)
def ratio_map(*arguments: Any, **parameters: Any) -> "xr.DataTree":
    """Force ratio, stresses and temperature over a grid of restitutions and packing fractions, with
    errors.

    With ``output``, finished batches are kept in a folder beside it while the map runs: an
    unfinished map of the same parameters is continued if ``resume`` is True and is an error
    otherwise, and a finished one is then read from its file. A file with anything else is replaced
    only if ``overwrite`` is True. ``save_figures`` draws the figures of ``jaxgran map``, and
    ``open_map`` reads the file.

    Args:
      {PARAMETERS}

    Returns:
      The DataTree described in ``map_dataset``. It has all observables on (packing_fraction,
      restitution), with standard errors. Lists of numbers of grains and of time steps add the
      dimensions grains and timestep in front. It also has the status of each point, and all
      parameters as attributes.

    Raises:
      InputError: (a ValueError) a parameter is out of its range; the message says what is accepted.
        Or the output belongs to another map, is unfinished, or is being written by another process.
      Interrupted: (a KeyboardInterrupt) Ctrl-C ended the map; ``data`` is the finished part, which
        is also written to the output, unless a finished map is there.

    Warns:
      BadPoints: (a UserWarning) points have a bad status, or their samples are short; the message
        names them.

    Examples:
      >>> data = ratio_map([0.9], [0.5], grains=16, seeds=1, strain=0.4, equilibrate=0.0)
      >>> data.force_ratio.dims
      ('packing_fraction', 'restitution')
    """
    given = inspect.signature(RunParameters).bind(*arguments, **parameters).arguments
    run = RunParameters(**with_start(given))
    output = _checked(run)
    settings, automatic_choice = chosen_settings(run)
    settings.require_engine()
    _require_own_attributes(run, settings)
    workers = _workers(run)
    if automatic_choice:
        _tell(run, f"chosen: {automatic_choice}")
    earlier, difference, finished = (
        (None, "", False) if output is None else _earlier(output, settings)
    )
    if difference and not run.overwrite:
        raise InputError(
            f"output {short_repr(str(output))} already exists and has {difference}; "
            "pass `overwrite=True` to replace it.",
            field="output",
        )
    checkpoint, complete = (
        None if output is None else Checkpoint(output, settings, run.resume),
        False,
    )
    try:
        if checkpoint is not None and run.resume:
            started = checkpoint.done or checkpoint.journals()
            if earlier is not None and finished and not difference and not started:
                complete = True
                _tell(run, f"{output} is finished and is read from its file.")
                return earlier
            _tell_resumed(run, settings, checkpoint)
        results, attributes, interruption = _run(
            run, settings, workers, None if run.record else checkpoint
        )
        from jaxgran.maps.dataset import map_dataset  # here: xarray is loaded while the flows run
        from jaxgran.maps.results import write_dataset

        attributes |= {"automatic_choice": automatic_choice, **(run.attributes or {})}
        data = map_dataset(settings, results, attributes)
        if output is not None and any(results.values()) and not (interruption and finished):
            write_dataset(data, output)
        if interruption is not None:
            raise Interrupted(data) from interruption
        complete = sum(replica is not None for replica in results.values()) == _count(settings)
    except OSError as error:
        if checkpoint is not None and checkpoint.done:
            error.add_note(
                f"finished batches are in {checkpoint.folder}: make room and add `resume=True`"
            )
        raise
    finally:
        if checkpoint is not None:
            checkpoint.close(complete)
    _warn_of_bad_points(data)
    return data


def _checked(run: RunParameters) -> Path | None:
    """The output of a map; InputError if something cannot be accepted about how the map is run and
    kept.
    """
    for name in ("overwrite", "resume"):
        require_flag(name, getattr(run, name))
    if run.workers is not None:
        require_whole("workers", run.workers, 1, _MOST_WORKERS)
    if not isinstance(run.progress, bool) and not callable(run.progress):
        raise refused("progress", run.progress, "must be True, False or a function of one number")
    if run.scheduler is not None and not isinstance(run.scheduler, str):
        raise refused("scheduler", run.scheduler, "must be an address")
    several = run.workers is not None and run.workers > 1
    if run.scheduler is not None and several:
        raise InputError("`scheduler` and `workers` exclude each other.", field="scheduler")
    if run.strain is not None and run.error is not None:
        raise InputError("`strain` and `error` exclude each other.", field="strain")
    if run.record is not None and not callable(run.record):
        raise refused("record", run.record, "must be a function")
    if run.record is not None and (run.resume or several or run.scheduler is not None):
        raise InputError("`record` requires one worker, and excludes `resume`.", field="record")
    if run.attributes is not None and not isinstance(run.attributes, dict):
        raise refused("attributes", run.attributes, "must be a dictionary")
    if run.output is None:
        if run.resume:
            raise InputError("`resume` requires `output`.", field="resume")
        return None
    if not isinstance(run.output, (str, os.PathLike)):
        raise refused("output", run.output, "must be a file name")
    output = Path(run.output)
    require_place(output, "output", ".nc")
    return output


def _require_own_attributes(run: RunParameters, settings: MapSettings) -> None:
    """Raise an InputError if the user's attributes have a name of the map's; only the command may
    be given.
    """
    if not set(run.attributes or {}) - {"command"}:
        return
    from jaxgran.maps.dataset import run_attributes

    names = {*inspect.signature(RunParameters).parameters, *run_attributes(settings), *_OF_RUN}
    for name in set(run.attributes or {}) & names:
        raise refused("attributes", name, "must have names that a map does not have")


def _workers(run: RunParameters) -> int:
    """How many batches run at a time; InputError if they cannot."""
    on_cpu = not in_lockstep()
    if run.workers is None:
        return usable_cores() if on_cpu and run.scheduler is None and run.record is None else 1
    if run.workers > 1 and not on_cpu:
        raise refused("workers", run.workers, "must be 1 on an accelerator")
    return run.workers


def _earlier(output: Path, settings: MapSettings) -> tuple[Any, str, bool]:
    """The map that the output has already, how it differs from one of these settings, and whether
    it is finished.
    """
    if not output.exists():
        return None, "", False
    from jaxgran.maps.results import (
        earlier_map,
        is_finished,
    )  # here, or every map would begin by loading xarray

    data, difference = earlier_map(output, settings)
    return data, difference, data is not None and is_finished(data)


def _run(
    run: RunParameters, settings: MapSettings, workers: int, checkpoint: Checkpoint | None
) -> tuple[dict[Key, Replica | None], dict[str, Any], BaseException | None]:
    """Run what the checkpoint lacks; the results, attributes of the run, and the interruption that
    ended it.
    """
    from jaxgran.maps.progress import progress  # here: a worker of a cluster need not load Rich

    Thread(target=_load_meanwhile, args=(settings,), name="jaxgran-load").start()
    workers, start = min(_count(settings), workers), perf_counter()
    results: dict[Key, Replica | None] = {} if checkpoint is None else dict(checkpoint.done)
    attributes: dict[str, Any] = {"workers": workers, "resumed_replicas": len(results)}
    interruption = None
    with progress(settings, quiet=run.progress is not True) as meter:
        meter.resumed(results)

        def report(advance: Advance) -> None:
            meter.advanced(advance)
            if callable(run.progress):
                run.progress(float(np.sum(advance.steps)))

        made: Provenance = {}
        running = run_replicas(
            settings, workers, report, checkpoint, run.scheduler, run.record, made
        )
        try:
            with closing(running):
                for key, replica in running:
                    results[key] = replica
                    meter.finished(key)
        except BaseException as error:
            if not is_interruption(error):
                raise
            interruption = error
    seconds = perf_counter() - start
    attributes |= {name: "; ".join(values) for name, values in made.items()}
    attributes |= {
        "wall_time_seconds": seconds,
        "replica_steps_per_second": meter.done_steps / seconds,
    }
    return results, attributes, interruption


def _load_meanwhile(settings: MapSettings) -> None:
    """Load what is needed later while the flows run; errors come back where it is used."""
    with suppress(Exception):
        if isinstance(select_engine(settings.flows()[0], settings.numerics), Numba):
            register_numba()
        import xarray

        import jaxgran.maps.dataset
        import jaxgran.maps.results  # noqa: F401

        xarray.Dataset({"numbers": ("numbers", [0.0])})  # the first dataset loads as much again


def _count(settings: MapSettings) -> int:
    """Number of replicas."""
    return len(points_of_part(settings)) * settings.seeds


def _tell(run: RunParameters, sentence: str) -> None:
    """Print a sentence on standard error where progress is shown."""
    if run.progress is True:
        print(sentence, file=sys.stderr)


def _tell_resumed(run: RunParameters, settings: MapSettings, checkpoint: Checkpoint) -> None:
    """Print how much of a map is done, and which files are damaged."""
    under_way = len(checkpoint.journals())
    _tell(
        run,
        f"continued: {len(checkpoint.done)} of {_count(settings)} replicas are done, {under_way} "
        "batches under way.",
    )
    if checkpoint.damaged:
        _tell(run, f"damaged and computed again: {', '.join(checkpoint.damaged)}.")


def _warn_of_bad_points(data: "xr.DataTree") -> None:
    """Warn of points with a bad status and of short samples."""
    from jaxgran.maps.status_report import BadPoints, bad_points, format, format_short

    bad = bad_points(data)
    bad.pop("failed", None)  # batches that were given up have had a warning of their own
    short = bad.pop("short_sample", [])
    if short:
        warnings.warn(format_short(data, short), BadPoints, stacklevel=3)
    if bad:
        warnings.warn(format(data, bad), BadPoints, stacklevel=3)
