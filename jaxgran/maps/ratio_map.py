"""The ratio map: a grid of restitutions and packing fractions, run in batches on all cores, as a
dataset and a file.
"""

import math
import os
import re
import warnings
from collections.abc import Callable, Iterable, Sequence
from contextlib import closing, nullcontext
from dataclasses import replace
from time import perf_counter
from typing import Any, Literal

import numpy as np
import xarray as xr

from jaxgran.contact.projected_methods import ProjectedMethod
from jaxgran.dynamics.engine import Engine
from jaxgran.environment import on_processor, usable_cores
from jaxgran.maps.automatic import chosen_settings, expected_costs, expected_seconds
from jaxgran.maps.batches import replica_ids
from jaxgran.maps.cluster import Provenance
from jaxgran.maps.dataset import map_dataset, run_attributes
from jaxgran.maps.interruption import Interrupted, is_interruption
from jaxgran.maps.own_observables import sums_by_name
from jaxgran.maps.progress import progress
from jaxgran.maps.replica import Advance, Replica, ReplicaId
from jaxgran.maps.run import run_replicas
from jaxgran.maps.settings import OPTIONS, MapSettings, RunOptions, table
from jaxgran.maps.settings_checks import require_engine
from jaxgran.maps.start import with_start
from jaxgran.maps.status_report import (
    BadPoints,
    bad_points,
    bad_points_message,
    short_samples_message,
)
from jaxgran.maps.store import Store, open_store
from jaxgran.maps.variables import COORDINATES, VARIABLES
from jaxgran.model.checks import InputError, refused, short_repr
from jaxgran.model.choices import Activation
from jaxgran.model.display import counted
from jaxgran.sampling.observables import OBSERVABLES

_OF_RUN = (
    *("engine", "solver", "history", "part_points", "automatic_choice", "resumed_replicas"),
    *("wall_time_seconds", "replica_steps_per_second"),
)
"""Attributes of a map that are no parameters and not those of ``run_attributes``."""
_OF_NETCDF = ("CLASS", "NAME", "DIMENSION_LIST", "REFERENCE_LIST")
_NAME = re.compile(r"[^\W\d_]([^/\x00-\x1f]*[^/\x00-\x20])?")  # of an attribute in NetCDF
_FEW_ON_AN_ACCELERATOR = 1000
"""Replicas below which an accelerator is hardly faster than two cores (``device_batch``)."""


def ratio_map(
    restitution: float | Sequence[float] | None = None,
    packing_fraction: float | Sequence[float] | None = None,
    *,
    grains: int | Sequence[int] | Literal["auto"] | None = None,
    seeds: int | None = None,
    timestep: float | Sequence[float] | Literal["auto"] | None = None,
    equilibrate: float | None = None,
    strain: float | None = None,
    error: float | None = None,
    tolerance: float | None = None,
    solver: ProjectedMethod | None = None,
    activation: Activation | None = None,
    engine: Engine | None = None,
    grains_by_point: Sequence[int] | None = None,
    snapshots: bool | None = None,
    first_seed: int | None = None,
    observe: Callable[..., Any] | None = None,
    polydispersity: float | None = None,
    diameters: Sequence[float] | None = None,
    part: str | None = None,
    preset: str | None = None,
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

    What is None has the value of the preset, or of the file that is named by ``from_map``. With
    ``output``, finished replicas are kept in a folder beside it while the map runs. If ``resume``
    is True, an unfinished map of the same parameters is continued and a finished one extended, also
    with more points and seeds: only the replicas that are missing are run. Otherwise both are
    errors. A file is replaced only if ``overwrite`` is True. ``save_figures`` draws the figures of
    ``jaxgran map``, and ``open_map`` reads the file.

    Args:
      {PARAMETERS}

    Returns:
      The DataTree described in ``map_dataset``. It has all observables on (packing_fraction,
      restitution), with standard errors. Several numbers of grains or time steps add the
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
    run = RunOptions(
        preset=preset,
        from_map=from_map,
        output=output,  # type: ignore[arg-type]
        overwrite=overwrite,
        resume=resume,
        workers=workers,
        scheduler=scheduler,
        progress=progress,
        record=record,
        attributes=attributes,
    )
    given = {
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
        "grains_by_point": grains_by_point,
        "snapshots": snapshots,
        "first_seed": first_seed,
        "observe": observe,
        "polydispersity": polydispersity,
        "diameters": diameters,
        "part": part,
    }
    given = {name: value for name, value in given.items() if value is not None}
    settings, automatic_choice = chosen_settings(with_start(preset, from_map, given))
    run = settle(settings, run, automatic_choice)
    if run.output is None:
        store = nullcontext(None)
    else:
        store = open_store(run.output, settings, run.resume, run.overwrite)
    with store as kept:
        if kept is not None and kept.finished is not None:
            run.tell(f"{kept.output} is finished and is read from its file.")
            return kept.finished
        replicas, of_run, interruption = _run_missing(settings, run, kept)
        data = map_dataset(settings, replicas, of_run)
        if kept is not None:
            kept.write(data, interrupted=interruption is not None)
        if interruption is not None:
            raise Interrupted(data) from interruption
    _warn_of_bad_points(data)
    return data


if ratio_map.__doc__:  # none under python -OO
    ratio_map.__doc__ = ratio_map.__doc__.replace("{PARAMETERS}", table())


def settle(settings: MapSettings, run: RunOptions, automatic_choice: str) -> RunOptions:
    """How a map is run, with the number of workers and all attributes.

    Raises:
      InputError: (a ValueError) something cannot be accepted.
    """
    require_engine(settings)
    _require_own_observables(settings)
    _require_own_attributes(run, settings)
    attributes = {"automatic_choice": automatic_choice, **(run.attributes or {})}
    run = replace(run, workers=_workers(run), attributes=attributes)
    if automatic_choice:
        run.tell(f"chosen: {automatic_choice}")
    count = len(replica_ids(settings))
    if not on_processor() and count < _FEW_ON_AN_ACCELERATOR:
        run.tell(
            f"{count} replicas are few for an accelerator; a processor may "
            "be faster: set JAX_PLATFORMS=cpu."
        )
    return run


def _run_missing(
    settings: MapSettings, run: RunOptions, store: Store | None
) -> tuple[Iterable[Replica], dict[str, Any], BaseException | None]:
    """Run the replicas that are missing: all that are there then, attributes of the run, and what
    interrupted it.
    """
    done: dict[ReplicaId, Replica] = {} if store is None else dict(store.replicas)
    if store is not None and run.resume:
        count = counted(len(replica_ids(settings)), "replica")
        run.tell(f"continued: {len(done)} of {count} done.")
        if store.damaged:
            run.tell(f"damaged and computed again: {', '.join(store.damaged)}.")
    missing = [x for x in replica_ids(settings) if x not in done]
    workers, start = min(len(missing) or 1, run.workers or 1), perf_counter()
    resumed, made, interruption = len(done), Provenance(), None
    costs, known = expected_costs(settings), on_processor() and run.scheduler is None
    expected = expected_seconds(settings, costs) / workers if known else math.inf
    keeping = None if run.record else store
    with progress(settings, costs, run.progress is not True, expected) as meter:
        meter.resumed(done)

        def report(advance: Advance) -> None:
            meter.advanced(advance)
            if callable(run.progress):
                run.progress(float(np.sum(advance.steps)))

        running = run_replicas(
            settings,
            missing,
            workers,
            report,
            run.scheduler,
            run.record,
            blocks_path=None if keeping is None else keeping.blocks_path,
            made=made,
        )
        try:
            with closing(running):
                for replica in running:
                    if keeping is not None:
                        keeping.add(replica)
                    done[replica.id] = replica
                    meter.finished(replica.id)
        except BaseException as error:
            if not is_interruption(error):
                raise
            interruption = error
    seconds = perf_counter() - start
    attributes = {
        "workers": workers,
        "resumed_replicas": resumed,
        **{name: "; ".join(values) for name, values in made.items()},
        "wall_time_seconds": seconds,
        "replica_steps_per_second": meter.done_steps / seconds,
        **(run.attributes or {}),
    }
    return done.values(), attributes, interruption


def _require_own_observables(settings: MapSettings) -> None:
    """Raise an InputError if one of the user's observables has a name of the map's."""
    names = {*OBSERVABLES, *COORDINATES, *(path.partition("/")[0] for path in VARIABLES)}
    for name in sums_by_name(settings) or ():
        if name in names or name.endswith(("_stderr", "_ci95")):
            raise InputError(
                f"observe must return names that a map does not have, not {short_repr(name)}."
            )


def _require_own_attributes(run: RunOptions, settings: MapSettings) -> None:
    """Raise an InputError if the user's attributes, but for the command, have a name of the map's
    or cannot be held by NetCDF.
    """
    given = {name: x for name, x in (run.attributes or {}).items() if name != "command"}
    if not given:
        return
    taken = {*OPTIONS, *run_attributes(settings), *_OF_RUN, *_OF_NETCDF}
    for name, value in given.items():
        if name in taken:
            raise refused("attributes", name, "must have names that a map does not have")
        if not isinstance(name, str) or not _NAME.fullmatch(name):
            reason = "must have names that begin with a letter and have no slash"
            raise refused("attributes", name, reason)
        whole = isinstance(value, int) and not isinstance(value, bool) and abs(value) < 2**63
        text = isinstance(value, str) and "\0" not in value
        if not whole and not text and not isinstance(value, float):
            raise refused("attributes", value, "must be texts or numbers of 64 bits")


def _workers(run: RunOptions) -> int:
    """How many batches run at a time; InputError if they cannot."""
    if run.workers is None:
        alone = run.scheduler is None and run.record is None
        return usable_cores() if on_processor() and alone else 1
    if run.workers > 1 and not on_processor():
        raise refused("workers", run.workers, "must be 1 on an accelerator")
    return run.workers


def _warn_of_bad_points(data: xr.DataTree) -> None:
    """Warn of points with a bad status and of short samples."""
    bad = bad_points(data)
    bad.pop("failed", None)  # batches that were given up have had a warning of their own
    short_samples = bad.pop("short_sample", [])
    if short_samples:
        warnings.warn(short_samples_message(data, short_samples), BadPoints, stacklevel=3)
    if bad:
        warnings.warn(bad_points_message(data, bad), BadPoints, stacklevel=3)
