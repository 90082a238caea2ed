"""Runs a map or a single flow: progress, checkpoint, dataset, and the messages at the end."""

import os
import shlex
import sys
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from threading import Thread
from typing import Any, Literal, NamedTuple

from jaxgran.cli.tables import Table, print_table
from jaxgran.cli.terminal import (
    BAD_STATUS,
    NO_FILE,
    configured_jax,
    is_interruption,
    require_device,
    say,
    say_written,
    stop,
    stop_interrupted,
)
from jaxgran.environment import usable_cores
from jaxgran.maps.progress import progress
from jaxgran.model.checks import InputError, short_repr

_BUDGETED = ("force_ratio", "pressure", "shear_stress", "granular_temperature", "local_granular_temperature")


class Outcome(NamedTuple):
    """The dataset of a map, whether its run was interrupted, and whether the dataset was written."""

    data: Any
    interrupted: bool
    written: bool


def measured(
    chosen: dict[str, Any],
    batch: int | Literal["auto"],
    workers: int | None,
    output: Path | None,
    quiet: bool,
    target_error: float = 0.02,
    resume: bool | None = None,
    scheduler: str | None = None,
    record: Callable | None = None,
    load: Iterable[str] = (),
    overwrite: bool = False,
) -> "Outcome":
    """Run a map with progress, and write its dataset.

    If ``resume`` is True or False, a checkpoint is kept beside the output. True continues an earlier one, and takes a
    finished map from its file. A file with anything but the same map is replaced only with ``overwrite``, and a
    finished map never by an interrupted one. For ``record`` and the other arguments see ``replicas``. Modules named in
    ``load`` are imported while the flows run.
    """
    jax = configured_jax()
    require_device()
    from jaxgran.maps.checkpoint import Checkpoint
    from jaxgran.maps.output import check_output, remove_pictures
    from jaxgran.maps.ratio_map import check_batches, predicted_cost, replicas
    from jaxgran.maps.settings import MapSettings, automatic

    if output is not None:
        check_output(output)
    numbers, automatic_choice = automatic(_with_objects(chosen), target_error)
    settings = MapSettings(**numbers)
    if automatic_choice:
        say(f"chosen: {automatic_choice}")
    on_cpu = jax.default_backend() == "cpu"
    check_batches(batch, 1 if workers is None else workers)
    count = len(settings.flows()) * settings.seeds
    workers = min(count, workers or (usable_cores() if on_cpu else 1))
    costs = [predicted_cost(flow) for flow in settings.flows()]
    folder, kept = None, False
    if output is not None:
        earlier, lost, kept = _earlier(output, settings)
        if lost and not overwrite:
            raise InputError(
                f"output must be another file, or --overwrite be given: {short_repr(str(output))} has {lost}."
            )
        folder = Checkpoint(output, settings, bool(resume))
        if resume and kept and not lost and not folder.done and not folder.journals():
            folder.close(finished=True)
            say(f"{output} is finished: it is shown and drawn from the file.")
            return Outcome(earlier, False, False)
    checkpoint = None if resume is None else folder
    results: dict[Any, Any] = {} if checkpoint is None else dict(checkpoint.done)
    run: dict[str, Any] = {
        "automatic_choice": automatic_choice,
        "command": os.fsencode(shlex.join(["jaxgran", *sys.argv[1:]])).decode(errors="backslashreplace"),
        "workers": workers,
        "resumed_replicas": len(results),
    }
    if resume:
        _say_resumed(checkpoint, count)

    Thread(target=_load_beside, args=(settings, load), daemon=True).start()
    start, interrupted, finished, written = time.perf_counter(), False, False, False
    try:
        with progress(costs, settings.seeds, quiet) as meter:
            meter.resumed(point for point, _ in results)
            running = replicas(settings, batch, workers, meter.steps, checkpoint, say, scheduler, record)
            try:
                for key, replica in running:
                    results[key] = replica
                    meter.replica(key[0])
            except BaseException as error:
                if not is_interruption(error):
                    raise
                interrupted = True
            finally:
                running.close()
        seconds = time.perf_counter() - start
        from jaxgran.maps.dataset import map_dataset
        from jaxgran.maps.results import write_dataset

        speed = {"wall_time_seconds": seconds, "replica_steps_per_second": meter.done_steps / seconds}
        data = map_dataset(settings, results, run | speed)
        if output is not None and any(results.values()) and not (interrupted and kept):
            write_dataset(data, output)
            remove_pictures(output)
            written = True
        finished = sum(replica is not None for replica in results.values()) == count
    except OSError as error:
        advice = "" if checkpoint is None else f"; what is done is in {checkpoint.folder}: make room and add --resume"
        stop(f"stopped by the file system, {error.strerror or error}{advice}.", NO_FILE)
    finally:
        if folder is not None:
            folder.close(finished or checkpoint is None)
    return Outcome(data, interrupted, written)


def _with_objects(chosen: dict[str, Any]) -> dict[str, Any]:
    """The parameters with a solver and an engine in place of their names."""
    from jaxgran.contact.projected_methods import SOLVERS
    from jaxgran.dynamics.engine import engine_named

    solver, engine = chosen.get("solver"), chosen.get("engine")
    made = {"solver": SOLVERS[solver]()} if isinstance(solver, str) and solver in SOLVERS else {}
    return chosen | made | ({"engine": engine_named(engine)} if isinstance(engine, str) else {})


def _earlier(output: Path, settings) -> tuple[Any, str, bool]:
    """The map that the output holds already, what is lost with it in words, and whether it is finished."""
    if not output.exists():
        return None, "", False
    from jaxgran.maps.results import earlier_map, is_finished  # here, or every map would begin by loading xarray

    data, lost = earlier_map(output, settings)
    return data, lost, data is not None and is_finished(data)


def _load_beside(settings, modules: Iterable[str]) -> None:
    """Load, beside the flows, their numba engine and what is needed at the end; errors come back where it is used."""
    with suppress(Exception):
        from jaxgran.dynamics.advance import register_numba
        from jaxgran.dynamics.engine import Numba, select_engine

        if isinstance(select_engine(settings.flows()[0], settings.numerics), Numba):
            register_numba()
        for name in ("jaxgran.maps.dataset", "jaxgran.maps.results", *modules):
            import_module(name)
        import xarray

        xarray.Dataset({"numbers": ("numbers", [0.0])})  # the first dataset loads as much again


def _say_resumed(checkpoint, count: int) -> None:
    """Print how much of a map is done, and which files are damaged."""
    journals = len(checkpoint.journals())
    say(f"continued: {len(checkpoint.done)} of {count} replicas are done, {journals} batches are under way.")
    if checkpoint.damaged:
        say(f"damaged and computed anew: {', '.join(checkpoint.damaged)}.")


def _say_imprecise(data) -> None:
    """Print the largest whole error beside its target, and the sampled strains, if a target was given."""
    from jaxgran.maps.schema import relative_ci95
    from jaxgran.sampling.sample import ERROR_OBSERVABLES

    if "error" not in data.attrs:
        return
    worst = max(float(relative_ci95(data, name)["total"].max()) for name in ERROR_OBSERVABLES)
    strain = data["seeds/strain"]
    say(
        f"whole relative errors: {data.attrs['error']:g} asked for, {worst:.2g} at the worst point; strains of "
        f"{float(strain.min()):g} to {float(strain.max()):g} per seed"
    )


def print_budget(data) -> None:
    """Print the parts of the whole error: those of each point, or their median and largest over a map."""
    from jaxgran.maps.schema import relative_ci95

    title = f"Whole error, 95 %, relative to a large system{'' if data.status.size == 1 else ': median (largest)'}"
    table = Table(title, ("observable", "sampling", "time step", "size", "tolerance", "together"))
    for name in _BUDGETED:
        parts = relative_ci95(data, name)
        ordered = (parts[part] for part in ("sampling", "timestep", "size", "tolerance", "total"))
        cells = [_percent(part) for part in ordered]
        cells[1] = "at its dt" if name == "force_ratio" else cells[1]
        table.rows.append([name.replace("_", " "), *cells])
    print_table(table)


def _percent(part) -> str:
    """The median of a part of the error over the points, and the largest one if there are several."""
    import numpy as np

    known = part[np.isfinite(part)]
    if known.size == 0:
        return ""
    median, largest = (f"{float(f'{100 * x:.2g}'):g}" for x in (np.median(known), known.max()))
    return f"{median} %" if part.size == 1 else f"{median} ({largest}) %"


def _say_retried(data) -> None:
    """Print how many replicas failed and were run again with half the time step."""
    timestep = data.timestep if "timestep" in data.dims else data.attrs["timestep"]
    retried = int((data["seeds/sample_timestep"] < 0.75 * timestep).sum())
    if retried:
        say(f"retried with half the time step: {retried} replicas, see sample_timestep in the group seeds.")


def finish(data, written: list[Path], interrupted: bool, can_resume: bool = False) -> None:
    """Print what was written and what went wrong, and exit with the matching status."""
    from jaxgran.maps.status_report import bad_points, in_words, short_in_words

    say_written(written)
    _say_imprecise(data)
    _say_retried(data)
    bad = bad_points(data)
    short = bad.pop("short_sample", [])
    if short:
        say(short_in_words(data, short, "--strain "))
    if interrupted:
        missing = len(bad.get("not_run", []))
        started = can_resume and bool((data["seeds/status"] >= 0).any())
        saved = "; what is done is saved" if started or written else ""
        resume = " --resume" if can_resume and "--resume" not in data.attrs["command"] else ""
        stop_interrupted(f"interrupted with {missing} points missing{saved}. Continue: {data.attrs['command']}{resume}")
    if bad:
        which = "the flow has" if data.status.size == 1 else "points marked * have"
        stop(f"finished, but {which} a bad status. {in_words(bad)}", BAD_STATUS)
