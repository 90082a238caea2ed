"""Runs the map or the flow of a command, and prints its errors and its outcome."""

import os
import shlex
import sys
import warnings
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from jaxgran.cli.mistakes import with_options
from jaxgran.cli.tables import Table, print_table
from jaxgran.cli.terminal import (
    BAD_STATUS,
    configured_jax,
    require_device,
    say,
    say_written,
    stop,
    stop_interrupted,
)
from jaxgran.maps.interruption import Interrupted
from jaxgran.maps.settings import options
from jaxgran.model.checks import refused

_BUDGETED = (
    "force_ratio",
    "pressure",
    "shear_stress",
    "granular_temperature",
    "local_granular_temperature",
)


class Outcome(NamedTuple):
    """The dataset of a map, whether its run was interrupted, and whether a dataset was written."""

    data: Any
    interrupted: bool
    written: bool


def run_map(parameters: Mapping[str, Any], quiet: bool) -> Outcome:
    """Run ``ratio_map`` on all cores, with progress."""
    configured_jax()
    require_device()
    from jaxgran.maps.ratio_map import ratio_map
    from jaxgran.maps.status_report import BadPoints

    given: dict[str, Any] = {
        "progress": not quiet,
        "attributes": {"command": command_line()},
        **_numerics(parameters),
    }
    output = given.get("output")
    before, interrupted = _stamp(output), False
    with warnings.catch_warnings():
        warnings.showwarning = lambda warning, *_, **__: say(f"{warning}")
        warnings.simplefilter("always", UserWarning, append=True)  # after the filters of a command
        warnings.simplefilter("ignore", BadPoints)  # ``finish`` prints these
        try:
            data = ratio_map(**given)
        except Interrupted as interruption:
            data, interrupted = interruption.data, True
    return Outcome(data, interrupted, _stamp(output) != before)


def _numerics(parameters: Mapping[str, Any]) -> dict[str, Any]:
    """The parameters with values in place of the names of a solver and an engine."""
    from jaxgran.contact.projected_methods import SOLVERS
    from jaxgran.dynamics.engine import engine_named

    given = dict(parameters)
    solver = given.get("solver")
    if isinstance(solver, str):
        if (
            solver not in SOLVERS
        ):  # of a file, which has the name of a user's class and not the class
            raise refused(
                "solver",
                solver,
                f"must be {', '.join(SOLVERS)}, or a class that is passed to ratio_map",
            )
        given["solver"] = SOLVERS[solver]()
    if isinstance(given.get("engine"), str):
        given["engine"] = engine_named(given["engine"])
    return given


def command_line() -> str:
    """The command as given; bytes of a file name that is no text are escaped."""
    return os.fsencode(shlex.join(["jaxgran", *sys.argv[1:]])).decode(errors="backslashreplace")


def _stamp(path: Path | None) -> tuple[int, int] | None:
    """What changes when a file is replaced; None if there is none."""
    with suppress(OSError, TypeError):
        status = os.stat(path)  # type: ignore[arg-type]
        return status.st_ino, status.st_mtime_ns
    return None


def _say_imprecise(data) -> None:
    """Print the largest relative error beside the requested one, and the sampled strains."""
    import numpy as np

    from jaxgran.maps.schema import relative_ci95
    from jaxgran.sampling.sample import ERROR_OBSERVABLES

    if "error" not in data.attrs:
        return
    errors = np.stack([relative_ci95(data, name)["total"] for name in ERROR_OBSERVABLES])
    known = np.isfinite(errors).all(axis=0)
    if not known.any():
        return
    strain = data["sums/strain"].where(data["sums/strain"] > 0)
    lost = f" of the {known.sum()} points with an error" if not known.all() else ""
    say(
        f"relative errors: {data.attrs['error']:g} requested, {errors[:, known].max():.2g} at the "
        f"worst point{lost}; "
        f"sampled strains of {float(strain.min()):g} to {float(strain.max()):g} per seed"
    )


def print_budget(data) -> None:
    """Print the parts of the error where any is known: those of each point, or their median and
    largest over a map.
    """
    import numpy as np

    from jaxgran.maps.schema import relative_ci95

    if not np.isfinite(data.force_ratio).any():
        return
    title = (
        "Relative error, 95 %, of a large "
        f"system{'' if data.status.size == 1 else ': median (largest)'}"
    )
    if "comment" in data.force_ratio_ci95.attrs:
        title += f"\n{data.force_ratio_ci95.attrs['comment']}"
    table = Table(title, ("observable", "sampling", "time step", "size", "tolerance", "total"))
    for name in _BUDGETED:
        parts = relative_ci95(data, name)
        ordered = (parts[part] for part in ("sampling", "timestep", "size", "tolerance", "total"))
        cells = [_percent(part) for part in ordered]
        cells[1] = "at its dt" if name == "force_ratio" else cells[1]
        table.rows.append([name.replace("_", " "), *cells])
    print_table(table)


def _percent(part) -> str:
    """The median of a part of the error over the points, and the largest one if there are
    several.
    """
    import numpy as np

    known = part[np.isfinite(part)]
    if known.size == 0:
        return ""
    median, largest = (f"{float(f'{100 * x:.2g}'):g}" for x in (np.median(known), known.max()))
    return f"{median} %" if part.size == 1 else f"{median} ({largest}) %"


def finish(data, written: list[Path], interrupted: bool, output: Path | None = None) -> None:
    """Print what was written and what went wrong, and exit with the matching status.

    A map that was interrupted goes on from the folder beside its output, if there is one.
    """
    from jaxgran.maps.status_report import bad_points, bad_points_message, short_samples_message

    say_written(written)
    _say_imprecise(data)
    bad = bad_points(data)
    short = bad.pop("short_sample", [])
    if short:
        say(with_options(short_samples_message(data, short), options("map")))
    if interrupted:
        missing = (
            "" if data.status.size == 1 else f" with {len(bad.get('not_run', []))} points missing"
        )
        saved = "nothing is saved."
        if output is not None and os.path.isdir(f"{output}.unfinished"):
            resume = "" if "--resume" in data.attrs["command"] else " --resume"
            saved = f"finished points are saved. Continue: {data.attrs['command']}{resume}"
        elif written:
            saved = "finished points are saved."
        stop_interrupted(f"interrupted{missing}; {saved}")
    if bad:
        stop(with_options(bad_points_message(data, bad), options("map")), BAD_STATUS)
