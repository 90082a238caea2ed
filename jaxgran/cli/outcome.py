"""Runs the map or the flow of a command, and prints its errors and its outcome."""

import os
import shlex
import sys
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxgran.cli.options import with_options
from jaxgran.cli.output import Entry, print_table, print_text
from jaxgran.cli.terminal import (
    BAD_STATUS,
    configured_jax,
    interrupted_status,
    require_device,
    say,
    say_written,
    stop,
)
from jaxgran.maps.interruption import Interrupted, is_interruption
from jaxgran.maps.settings import OPTIONS
from jaxgran.model.display import counted, to_two_digits, with_error

_PRINTED = {
    "force_ratio": "force ratio",
    "pressure": "pressure",
    "shear_stress": "shear stress",
    "granular_temperature": "T",
    "local_granular_temperature": "local T",
    "macroscopic_friction": "friction τ/p",
}
_SOURCES = {"sampling": "sampling", "timestep": "dt", "size": "size"}  # of errors above 0.4 %
_SMALLER = (
    "Smaller errors: of sampling by --strain or --seeds, of dt by --timestep, of the size by "
    "--grains, of all by --error."
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
        **parameters,
        **_numerics(parameters),
    }
    output = given.get("output")
    before, interrupted = _stamp(output), False
    with warnings.catch_warnings():
        warnings.showwarning = lambda warning, *_, **__: say(f"{warning}")
        warnings.simplefilter("always", UserWarning, append=True)  # after the filters of a command
        warnings.simplefilter("ignore", BadPoints)  # ``finish`` prints these
        with told_how_to_resume(output):
            try:
                data = ratio_map(**given)
            except Interrupted as interruption:
                data, interrupted = interruption.data, True
    return Outcome(data, interrupted, _stamp(output) != before)


@contextmanager
def told_how_to_resume(output: Path | None, finished: bool = False) -> Iterator[None]:
    """An interruption of the block ends the command, and says what is saved and how to go on."""
    try:
        yield
    except BaseException as error:
        if not is_interruption(error):
            raise
        stop(f"interrupted; {_saved(output, finished, finished)}", interrupted_status())


def _saved(output: Path | None, written: bool, finished: bool = False) -> str:
    """What an interruption left, and the command that continues from it, if one does."""
    if output is not None and (finished or os.path.isdir(f"{output}.unfinished")):
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


def _stamp(path: Path | None) -> tuple[int, int] | None:
    """What changes when a file is replaced; None if there is none."""
    with suppress(OSError, TypeError):
        status = os.stat(path)  # type: ignore[arg-type]
        return status.st_ino, status.st_mtime_ns
    return None


def entries(data) -> dict[str, Entry]:
    """The parameters of a flow or of a map, the averages, the shear-stress ratio, and what kinetic
    theory predicts; lists are by packing fraction, then by restitution.
    """
    from jaxgran.maps.schema import flag_names, flattened, path_of, shear_stress_ratio
    from jaxgran.sampling.budget import LARGE_SYSTEM
    from jaxgran.sampling.observables import OBSERVABLES

    flat = flattened(data)
    axes = ("grains", "timestep", "packing_fraction", "restitution")
    shown = {
        name: Entry(
            flat[name].values,
            flat[name].long_name,
            flat[name].attrs.get("reduced_unit", flat[name].units),
        )
        for name in axes
        if name in flat
    }
    statuses = np.vectorize(flag_names(flat.status).get)(flat.status.values)
    shown |= {
        "strain": Entry(flat["sums/strain"].sum("seed").values, "sampled strain of all seeds"),
        "engine": Entry(data.attrs["engine"], "program that advanced the flow", None),
        "solver": Entry(data.attrs["solver"], "method of the contact solve", None),
        "status": Entry(statuses, "worst status", None),
    }
    for name, row in OBSERVABLES.items():
        path, stderr = path_of(name), flat.get(f"{path_of(name)}_stderr")
        errors = None if stderr is None else stderr.values
        shown[name] = Entry(flat[path].values, row.meaning, row.unit, errors)
        if name in LARGE_SYSTEM:
            total = flat[f"{name}_large_system_ci95"].sel(error_source="total").values
            large, words = flat[f"{name}_large_system"].values, f"{row.meaning}, of a large system"
            shown[f"{name}_large_system"] = Entry(large, words, row.unit, ci95=total)
        if f"theory/{name}" in flat:
            words = f"{row.meaning}, by kinetic theory"
            shown[f"theory/{name}"] = Entry(flat[f"theory/{name}"].values, words, row.unit)
    ratio, error = (x.values for x in shear_stress_ratio(flat))
    words = "contact shear stress over binary shear stress"
    shown["shear_stress_ratio"] = Entry(ratio, words, "1", error)
    return shown


def _say_errors(data) -> None:
    """Print the largest relative error beside the requested one, and the sampled strains."""
    from jaxgran.maps.schema import relative_ci95
    from jaxgran.sampling.sample import ERROR_OBSERVABLES

    if "error" not in data.attrs:
        return
    errors = np.stack([relative_ci95(data, name)["total"] for name in ERROR_OBSERVABLES])
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


def print_large_system(data) -> None:
    """Print the averages of a large system, and where their errors come from: the values of a flow,
    for each number of grains, beside kinetic theory; or the medians of a map and the largest ones.
    """
    from jaxgran.maps.schema import flattened, parts

    of_flow = data.sizes["packing_fraction"] * data.sizes["restitution"] == 1
    shown = [
        part
        for part in (parts(data) if of_flow else [flattened(data)])
        if np.isfinite(part.force_ratio).any()
    ]
    for part in shown:
        _print_large_system(part)
    if shown:
        print_text(_SMALLER)


def _print_large_system(data) -> None:
    from jaxgran.maps.schema import relative_ci95
    from jaxgran.maps.variables import MEASURED_FLOWS

    point = data.status.size == 1
    values = ("large system", "kinetic theory") if point else ("correction", "total")
    if point:
        size = f" extrapolated from N = {data.attrs['grains']}" if "grains" in data.attrs else ""
        title = f"Averages of a large system{size}, ± 95 %; parts of the errors in %"
    else:
        title = (
            "Averages of a large system: correction for N, and half-widths of 95 % intervals by "
            "source, in %; median over the points, and the largest below it"
        )
    if not _are_measured(data):
        title += f"\nExtrapolated: the corrections were measured at {MEASURED_FLOWS} only"
    predicted, rows = _predicted(data) if point else {}, []
    for name, words in _PRINTED.items():
        errors, large = relative_ci95(data, name), data[f"{name}_large_system"].values
        sources = {source: _percent(errors[source]) for source in _SOURCES}
        sources |= {"timestep": ("–", "–")} if name == "force_ratio" else {}
        medians, largest = zip(*sources.values(), strict=True)
        if point:
            total = data[f"{name}_large_system_ci95"].sel(error_source="total").item()
            value = with_error(large.item(), total)
            rows.append([words, value, predicted.get(name, ""), *medians])
            continue
        both = _percent(large / data[name].values - 1), _percent(errors["total"])
        rows += [[words, *(x[0] for x in both), *medians]]
        rows += [["  largest", *(x[1] for x in both), *largest]]
    print_table(title, ("average", *values, *_SOURCES.values()), rows)


def _predicted(data) -> dict[str, str]:
    """What kinetic theory predicts for one flow, none if it is elastic; its temperature is compared
    with the local one.
    """
    pressure, shear_stress, temperature = (
        data[f"theory/{x}"].item() for x in ("pressure", "shear_stress", "granular_temperature")
    )
    values = {
        "pressure": pressure,
        "shear_stress": shear_stress,
        "local_granular_temperature": temperature,
        "macroscopic_friction": shear_stress / pressure,
    }
    return {name: f"{value:.3g}" for name, value in values.items() if np.isfinite(value)}


def _are_measured(data) -> bool:
    """Whether the laws of a large system were measured for such flows."""
    from jaxgran.sampling.budget import MEASURED_POLYDISPERSITY, MEASURED_RANGES

    values = {"grains": data.get("point_grains", data.grains)}
    values |= {name: data[name] for name in ("restitution", "packing_fraction")}
    within = (
        bool(((low <= values[name]) & (values[name] <= high)).all())
        for name, (low, high) in MEASURED_RANGES.items()
    )
    return data.attrs.get("polydispersity") == MEASURED_POLYDISPERSITY and all(within)


def _percent(part) -> tuple[str, str]:
    """The median of a part of the error over the points, and the largest one."""
    known = part[np.isfinite(part)]
    if known.size == 0:
        return "", ""
    largest = known.flat[np.argmax(abs(known))]
    return to_two_digits(100 * np.median(known)), to_two_digits(100 * largest)


def finish(
    data, written: list[Path], interrupted: bool, quiet: bool = False, output: Path | None = None
) -> None:
    """Print what was written, unless quiet, and what went wrong; exit with the matching status.

    A map that was interrupted goes on from the folder beside its output, if there is one.
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
        missing = (
            ""
            if data.status.size == 1
            else f" with {counted(len(bad.get('not_run', [])), 'point')} missing"
        )
        saved = _saved(output, bool(written))
        say(f"jaxgran: interrupted{missing}; {saved}")
        raise SystemExit(interrupted_status())
    if bad:
        say(f"jaxgran: {with_options(bad_points_message(data, bad), OPTIONS)}")
        raise SystemExit(BAD_STATUS)
