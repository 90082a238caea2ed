"""The ratio map: a grid of restitutions and packing fractions, run in batches on all cores, as a
dataset and a file.
"""

import inspect
import math
import os
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import fields, replace
from functools import wraps
from time import perf_counter
from typing import Any, Literal, NamedTuple, ParamSpec, TypeVar

import numpy as np
import xarray as xr

from jaxgran.contact.projected_methods import ProjectedMethod
from jaxgran.dynamics.batching import in_lockstep
from jaxgran.dynamics.engine import Engine
from jaxgran.environment import usable_cores
from jaxgran.maps.automatic import chosen_settings, expected_costs, expected_seconds
from jaxgran.maps.checkpoint import Checkpoint
from jaxgran.maps.cluster import Provenance
from jaxgran.maps.dataset import map_dataset, run_attributes
from jaxgran.maps.interruption import Interrupted, is_interruption
from jaxgran.maps.own_observables import sums_by_name
from jaxgran.maps.progress import progress
from jaxgran.maps.replica import Advance, Key, Replica
from jaxgran.maps.run_replicas import run_replicas
from jaxgran.maps.settings import OPTIONS, MapSettings, RunOptions, table
from jaxgran.maps.settings_checks import require_engine
from jaxgran.maps.start import with_start
from jaxgran.maps.status_report import (
    BadPoints,
    bad_points,
    bad_points_message,
    short_samples_message,
)
from jaxgran.maps.store import Store, open_store, replica_count
from jaxgran.maps.variables import COORDINATES, VARIABLES
from jaxgran.model.checks import InputError, refused, short_repr
from jaxgran.model.choices import Activation
from jaxgran.model.display import counted
from jaxgran.sampling.observables import OBSERVABLES

P = ParamSpec("P")
R = TypeVar("R")
_OF_RUN = (
    *("engine", "solver", "history", "part_points", "automatic_choice", "resumed_replicas"),
    *("wall_time_seconds", "replica_steps_per_second"),
)
"""Attributes of a map that are no parameters and not those of ``run_attributes``."""
_FEW_ON_AN_ACCELERATOR = 1000
"""Replicas below which an accelerator is hardly faster than two cores (``device_batch``)."""


def fill_from_start(function: Callable[P, R]) -> Callable[P, R]:
    """Decorator: what is not given comes from the preset or the file that a map starts from."""
    signature = inspect.signature(function)

    @wraps(function)
    def started(*args: P.args, **kwargs: P.kwargs) -> R:
        given = signature.bind(*args, **kwargs).arguments
        return function(**with_start(given))  # type: ignore[call-arg]

    if function.__doc__:  # none under python -OO
        started.__doc__ = function.__doc__.replace("{PARAMETERS}", table())
    return started


@fill_from_start
def ratio_map(
    restitution: float | Sequence[float] | None = None,
    packing_fraction: float | Sequence[float] | None = None,
    *,
    grains: int | Sequence[int] | Literal["auto"] = 256,
    seeds: int = 2,
    timestep: float | Sequence[float] | Literal["auto"] = 1e-3,
    equilibrate: float | None = None,
    strain: float | None = None,
    error: float | None = None,
    tolerance: float | None = None,
    solver: ProjectedMethod | None = None,
    activation: Activation = "midpoint",
    engine: Engine | None = None,
    grains_by_point: Sequence[int] | None = None,
    snapshots: bool = False,
    first_seed: int = 0,
    observe: Callable[..., Any] | None = None,
    polydispersity: float = 0.26,
    diameters: Sequence[float] | None = None,
    part: str | None = None,
    preset: str = "quick",
    from_map: str | os.PathLike | None = None,
    output: str | os.PathLike | None = None,
    overwrite: bool = False,
    resume: bool = False,
    workers: int | None = None,
    scheduler: str | None = None,
    progress: bool | Callable[[float], object] = False,
    record: Callable[..., Any] | None = None,
    attributes: dict[str, Any] | None = None,
) -> xr.DataTree:
    """Force ratio, stresses and temperature over a grid of restitutions and packing fractions, with
    errors.

    With ``output``, finished replicas are kept in a folder beside it while the map runs. If
    ``resume`` is True, an unfinished map of the same parameters is continued, also with other axes,
    seeds or part, and a finished one is read from its file, if it is of this version; otherwise
    both are errors. A file is replaced only if ``overwrite`` is True. ``save_figures`` draws the
    figures of ``jaxgran map``, and ``open_map`` reads the file.

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
    settings, run = settle(locals())  # all parameters by name
    with open_store(settings, run) as store:
        if store.result is not None:
            run.tell(f"{store.output} is finished and is read from its file.")
            return store.result
        measured = run_missing(settings, run, store)
        data = map_dataset(settings, measured.replicas, measured.attributes)
        store.write(data, interrupted=measured.interruption is not None)
        if measured.interruption is not None:
            raise Interrupted(data) from measured.interruption
    _warn_of_bad_points(data)
    return data


class Measured(NamedTuple):
    """The replicas of a map, the attributes of their run, and what interrupted it, or None."""

    replicas: dict[Key, Replica | None]
    attributes: dict[str, Any]
    interruption: BaseException | None


def settle(parameters: Mapping[str, Any]) -> tuple[MapSettings, RunOptions]:
    """The settings of a map, with numbers for "auto", and how it is run, with the number of
    workers.

    Raises:
      InputError: (a ValueError) something cannot be accepted.
    """
    run = RunOptions(**{row.name: parameters[row.name] for row in fields(RunOptions)})
    settings, automatic_choice = chosen_settings(parameters)
    require_engine(settings)
    _require_own_observables(settings)
    _require_own_attributes(run, settings)
    attributes = {"automatic_choice": automatic_choice, **(run.attributes or {})}
    run = replace(run, workers=_workers(run), attributes=attributes)
    if automatic_choice:
        run.tell(f"chosen: {automatic_choice}")
    if in_lockstep() and replica_count(settings) < _FEW_ON_AN_ACCELERATOR:
        run.tell(
            f"{replica_count(settings)} replicas are few for an accelerator; a processor may "
            "be faster: set JAX_PLATFORMS=cpu."
        )
    return settings, run


def run_missing(settings: MapSettings, run: RunOptions, store: Store) -> Measured:
    """Run the replicas that the checkpoint lacks."""
    checkpoint = None if run.record else store.checkpoint
    if checkpoint is not None and run.resume:
        _tell_resumed(settings, run, checkpoint)
    workers, start = min(replica_count(settings), run.workers or 1), perf_counter()
    results: dict[Key, Replica | None] = {} if checkpoint is None else dict(checkpoint.done)
    attributes: dict[str, Any] = {"workers": workers, "resumed_replicas": len(results)}
    made: Provenance = {}
    interruption = None
    costs, known = expected_costs(settings), not in_lockstep() and run.scheduler is None
    expected = expected_seconds(settings, costs) / workers if known else math.inf
    with progress(settings, costs, run.progress is not True, expected) as meter:
        meter.resumed(results)

        def report(advance: Advance) -> None:
            meter.advanced(advance)
            if callable(run.progress):
                run.progress(float(np.sum(advance.steps)))

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
    return Measured(results, attributes | (run.attributes or {}), interruption)


def _require_own_observables(settings: MapSettings) -> None:
    """Raise an InputError if one of the user's observables has a name of the map's."""
    names = {*OBSERVABLES, *COORDINATES, *(row.path.partition("/")[0] for row in VARIABLES)}
    for name in sums_by_name(settings) or ():
        if name in names or name.endswith(("_stderr", "_ci95")):
            raise InputError(
                f"observe must return names that a map does not have, not {short_repr(name)}."
            )


def _require_own_attributes(run: RunOptions, settings: MapSettings) -> None:
    """Raise an InputError if the user's attributes have a name of the map's; only the command may
    be given.
    """
    names = set(run.attributes or {}) - {"command"}
    if not names:
        return
    for name in names & {*OPTIONS, *run_attributes(settings), *_OF_RUN}:
        raise refused("attributes", name, "must have names that a map does not have")
    for name in names:
        value = (run.attributes or {})[name]
        if not isinstance(value, str | int | float):
            raise refused("attributes", value, "must be texts or numbers")


def _workers(run: RunOptions) -> int:
    """How many batches run at a time; InputError if they cannot."""
    on_cpu = not in_lockstep()
    if run.workers is None:
        return usable_cores() if on_cpu and run.scheduler is None and run.record is None else 1
    if run.workers > 1 and not on_cpu:
        raise refused("workers", run.workers, "must be 1 on an accelerator")
    return run.workers


def _tell_resumed(settings: MapSettings, run: RunOptions, checkpoint: Checkpoint) -> None:
    """Print how much of a map is done, and which files are damaged."""
    run.tell(
        f"continued: {len(checkpoint.done)} of {counted(replica_count(settings), 'replica')} done, "
        f"{counted(len(checkpoint.interrupted), 'batch')} under way."
    )
    if checkpoint.damaged:
        run.tell(f"damaged and computed again: {', '.join(checkpoint.damaged)}.")


def _warn_of_bad_points(data: xr.DataTree) -> None:
    """Warn of points with a bad status and of short samples."""
    bad = bad_points(data)
    bad.pop("failed", None)  # batches that were given up have had a warning of their own
    short_samples = bad.pop("short_sample", [])
    if short_samples:
        warnings.warn(short_samples_message(data, short_samples), BadPoints, stacklevel=4)
    if bad:
        warnings.warn(bad_points_message(data, bad), BadPoints, stacklevel=4)
