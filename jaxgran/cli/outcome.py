"""Runs the map or the flow of a command, and tells how it ended."""

import os
import shlex
import sys
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxgran.cli.options import with_options
from jaxgran.cli.summary import relative_error, summary_of
from jaxgran.cli.terminal import (
    BAD_STATUS,
    configured_jax,
    interrupted_status,
    require_device,
    say,
    say_written,
    stop,
)
from jaxgran.files import stamp
from jaxgran.maps.interruption import Interrupted, is_interruption
from jaxgran.maps.settings import OPTIONS
from jaxgran.model.display import counted


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
        **parameters,
        **_numerics(parameters),
    }
    output = given.get("output")
    before, interrupted = stamp(output), False
    with warnings.catch_warnings():
        warnings.showwarning = lambda warning, *_, **__: say(f"{warning}")
        warnings.simplefilter("always", UserWarning, append=True)  # after the filters of a command
        warnings.simplefilter("ignore", BadPoints)  # ``finish`` prints these
        with told_how_to_resume(output):
            try:
                data = ratio_map(**given)
            except Interrupted as interruption:
                data, interrupted = interruption.data, True
    return Outcome(data, interrupted, stamp(output) != before)


@contextmanager
def told_how_to_resume(output: Path | None, finished: bool = False) -> Iterator[None]:
    """An interruption of the block ends the command, and says what is saved and how to go on."""
    before = stamp(output)
    try:
        yield
    except BaseException as error:
        if not is_interruption(error):
            raise
        finished = finished or stamp(output) != before
        stop(f"interrupted; {_saved(output, finished, finished)}", interrupted_status())


def _saved(output: Path | None, written: bool, finished: bool = False) -> str:
    """What an interruption left, and the command that continues from it, if one does."""
    if output is not None and (finished or os.path.isfile(f"{output}.unfinished/settings.json")):
        resume = "" if "--resume" in sys.argv else " --resume"
        return f"finished points are saved. Continue: {command_line()}{resume}"
    return "finished points are saved." if written else "nothing is saved."


def _numerics(parameters: Mapping[str, Any]) -> dict[str, Any]:
    """Solver and engine in place of their names, where they are given."""
    from jaxgran.contact.projected_methods import SOLVERS
    from jaxgran.dynamics.engine import engine_named

    made = {"solver": lambda name: SOLVERS[name](), "engine": engine_named}
    return {name: make(parameters[name]) for name, make in made.items() if name in parameters}


def command_line() -> str:
    """The command as given; bytes of a file name that is no text are escaped."""
    return os.fsencode(shlex.join(["jaxgran", *sys.argv[1:]])).decode(errors="backslashreplace")


def _say_errors(data) -> None:
    """Print the largest relative error beside the requested one, and the sampled strains."""
    from jaxgran.sampling.sample import ERROR_OBSERVABLES

    if "error" not in data.attrs:
        return
    summary = summary_of(data)
    errors = np.stack([relative_error(summary, name) for name in ERROR_OBSERVABLES])
    known = np.isfinite(errors).all(axis=0)
    if not known.any():
        return
    strain = data["sums/strain"].where(data["sums/strain"] > 0)
    lost = f" of the {counted(known.sum(), 'point')} with an error" if not known.all() else ""
    say(
        f"relative errors: {data.attrs['error']:g} requested, {errors[:, known].max():.2g} at the "
        f"worst point{lost}; "
        f"sampled strains of {float(strain.min()):g} to {float(strain.max()):g} per seed"
    )


def finish(
    data,
    written: list[Path],
    interrupted: bool,
    quiet: bool = False,
    output: Path | None = None,
    saved: str = "",
) -> None:
    """Print what was written, unless quiet, and what went wrong; exit with the matching status.

    A map that was interrupted goes on from the folder beside its output, if there is one; ``saved``
    says what else an interruption left.
    """
    from jaxgran.maps.status_report import bad_points, bad_points_message, short_samples_message

    if not quiet:
        say_written(written)
        _say_errors(data)
    bad = bad_points(data)
    short = bad.pop("short_sample", [])
    if short:
        say(with_options(short_samples_message(data, short), OPTIONS))
    if interrupted:
        lost = len(bad.get("not_run", []))
        missing = f" with {counted(lost, 'point')} missing" if lost and data.status.size > 1 else ""
        saved = saved or _saved(output, bool(written))
        say(f"jaxgran: interrupted{missing}; {saved}")
        raise SystemExit(interrupted_status())
    if bad:
        say(f"jaxgran: {with_options(bad_points_message(data, bad), OPTIONS)}")
        raise SystemExit(BAD_STATUS)
