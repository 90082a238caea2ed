"""The command ``run``: one flow, its averages, and its frames as a trajectory or movie."""

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from jaxgran.cli.measure import entries, finish, print_large_system, run_map
from jaxgran.cli.options import QUIET, command, of_map
from jaxgran.cli.output import JSON, print_json, print_table
from jaxgran.cli.terminal import configured_jax, counted, say
from jaxgran.io.paths import require_absent
from jaxgran.maps.options import Option
from jaxgran.model.checks import InputError, require_number
from jaxgran.model.display import unit_text, with_error

MOST_RECORDED = 100_000  # frames of a trajectory
_RECORDED_STRAIN = 5.0  # sampled strain where frames are recorded and none is given

_PHYSICS = (  # what is printed without --all, with the shear-stress ratio below the first
    *("force_ratio", "pressure", "shear_stress", "macroscopic_friction", "inertial_number"),
    *(
        "granular_temperature",
        "local_granular_temperature",
        "coordination_number",
        "collision_rate",
    ),
)

RUN_EXAMPLES = {
    "A flow in its steady state: averages with errors": "jaxgran run --restitution 0.5 "
    "--packing-fraction 0.7",
    "A movie of it, about a hundred frames": "jaxgran run --restitution 0.1 --packing-fraction 0.8 "
    "--movie flow.gif",
    "All its frames for other programs, every 0.01 of strain": "jaxgran run --restitution 0.5 "
    "--packing-fraction 0.7 --trajectory flow.gsd --frame-strain 0.01",
}


RUN_OPTIONS = {
    **of_map("run"),
    "trajectory": Option(
        "GSD file of the flow, frame by frame. Recording frames splits the run at different steps, "
        "so averages change within their errors.",
        Path,
        example="FILE.gsd",
    ),
    "movie": Option(
        "GIF or MP4 of the flow: grains by their speed, and the forces between them.",
        Path,
        example="FILE.gif",
    ),
    "frame_strain": Option(
        "Strain between frames, each at the nearest time step.",
        default="a hundredth of --strain, or 0.05 with --error",
    ),
    "force_strain": Option(
        "Strain from each frame on over which its forces are averaged, at most --frame-strain.",
        default="one time step",
    ),
    "all": Option("Print every average, those of the solver's quality last.", bool),
    "json": JSON,
    "quiet": QUIET,
}
RUN_OPTIONS["strain"] = replace(
    RUN_OPTIONS["strain"], default=f"{RUN_OPTIONS['strain'].default}; 5 with frames"
)
RUN_OPTIONS["seeds"] = replace(RUN_OPTIONS["seeds"], default="1")


class FrameFiles(NamedTuple):
    """The files of frames that were asked for."""

    trajectory: Path | None
    movie: Path | None
    frame_strain: float | None
    force_strain: float | None


def run_run_command(
    restitution: float,
    packing_fraction: float,
    trajectory: Path | None = None,
    movie: Path | None = None,
    frame_strain: float | None = None,
    force_strain: float | None = None,
    all: bool = False,
    json: bool = False,
    quiet: bool = False,
    **given: Any,
) -> None:
    files = FrameFiles(trajectory, movie, frame_strain, force_strain)
    chosen = _settled(files, given)
    recorder, film = _recorder(files, chosen.get("strain", _RECORDED_STRAIN))
    record = None if recorder is None else recorder.recording
    plane = {"restitution": (restitution,), "packing_fraction": (packing_fraction,)}
    data, interrupted, written = run_map({**plane, **chosen, "record": record}, quiet)
    if json:
        print_json(entries(data.isel(packing_fraction=0, restitution=0)))
    elif bool(data.force_ratio.notnull().any()):
        _print_averages(data, all)
        print_large_system(data)
    if recorder is not None and recorder.frames:
        _write_frames(files, recorder.frames, film, quiet)
    output = chosen.get("output")
    finish(data, [output] if output is not None and written else [], interrupted, quiet, output)


run_command = command(RUN_OPTIONS, run_run_command, required=("restitution", "packing_fraction"))


def _settled(files: FrameFiles, given: Mapping[str, Any]) -> dict[str, Any]:
    """The parameters of the flow: one seed, and a short strain where frames are recorded."""
    chosen = {"seeds": 1, **given}
    named = {"trajectory": files.trajectory, "movie": files.movie}
    if any(named.values()) and chosen["seeds"] > 1:
        raise InputError(
            "`trajectory` and `movie` show one seed: leave out `seeds`.", field="seeds"
        )
    if any(named.values()) and "error" not in chosen:
        chosen.setdefault("strain", _RECORDED_STRAIN)
    for name, file in named.items():
        if file is not None and not chosen.get("overwrite"):
            require_absent(file, name)
    return chosen


def _recorder(files: FrameFiles, strain: float):
    """The recorder of the flow and the frames of its movie; None if there is no file for it."""
    if files.trajectory is None and files.movie is None:
        for name in ("frame_strain", "force_strain"):
            if getattr(files, name) is not None:
                raise InputError(f"`{name}` requires `trajectory` or `movie`.", field=name)
        return None, None
    configured_jax()
    from jaxgran.io.trajectory import check_trajectory, write_frame
    from jaxgran.plotting.movie import MOST_DRAWN, Frames, check_movie
    from jaxgran.sampling.recorder import Recorder

    every = strain / 100
    if files.frame_strain is not None:
        most = MOST_RECORDED if files.movie is None else MOST_DRAWN
        accepted = (
            f"at least {strain / most:g}, for {most} frames, and at most the sampled strain, "
            f"{strain:g}"
        )
        every = files.frame_strain
        require_number(
            "frame_strain", every, lambda x: (x >= 0.99 * strain / most) & (x <= strain), accepted
        )
    if files.force_strain is not None:
        accepted = f"above 0 and at most the strain between frames, {every:g}"
        require_number(
            "force_strain", files.force_strain, lambda x: (x > 0) & (x <= every), accepted
        )
    keep, film = [], Frames()
    if files.trajectory is not None:
        check_trajectory(files.trajectory)
        keep.append(partial(write_frame, files.trajectory))
    if files.movie is not None:
        check_movie(files.movie)
        keep.append(film.keep)
    return Recorder(every, *keep, force_strain=files.force_strain or 0.0), film


def _write_frames(files: FrameFiles, frames: int, film, quiet: bool) -> None:
    """Draw the movie, with progress unless quiet, and say what was written."""
    from jaxgran.plotting.movie import write_movie

    say(
        "recording frames split the run at different steps, so averages change within their errors."
    )
    if files.trajectory is not None:
        say(f"wrote {files.trajectory}: {frames} frames")
    if files.movie is not None:
        if not quiet:
            say(f"drawing {len(film)} frames")
        follow = iter if quiet else partial(counted, words="frames")
        write_movie(files.movie, film, follow=follow)
        say(f"wrote {files.movie}: {len(film)} frames")


def _print_averages(data, all: bool) -> None:
    """Print the averages of one flow with errors, units, effective sample sizes and predictions of
    kinetic theory.
    """
    from jaxgran.maps.schema import flattened, path_of, shear_stress_ratio
    from jaxgran.sampling.enskog_factors import LENGTHS
    from jaxgran.sampling.observables import GROUPS, OBSERVABLES

    grains, timestep, rule = (data.attrs[name] for name in ("grains", "timestep", "activation"))
    title = (
        f"{grains} grains, dt = {timestep:g} / shear rate, {rule} activation\n"
        f"engine {data.attrs['engine']}, solver {data.attrs['solver']}"
    )
    columns = (
        "observable",
        "value ±\nstandard error",
        "unit",
        "effective\nsamples",
        "kinetic\ntheory",
    )
    rows: list[list[str]] = []
    point = flattened(data).isel(packing_fraction=0, restitution=0)
    strain = float(point["sums/strain"].sum())
    correlated = point["diagnostics/correlation_strain"].to_series().to_dict()

    def number(name: str) -> float:
        return float(point[name]) if name in point else math.nan

    for group, names in (GROUPS if all else {"/": _PHYSICS}).items():
        rows += [] if group == "/" else [[group.capitalize()]]
        for name in names:
            if OBSERVABLES[name].tensor:
                continue
            value, error = number(path_of(name)), number(f"{path_of(name)}_stderr")
            value = with_error(value, error) if group != "diagnostics" else f"{value:.3g}"
            samples = strain / correlated.get(name, math.nan)
            theory = number(f"theory/{name}")
            texts = ["" if math.isnan(x) else f"{x:.3g}" for x in (samples, theory)]
            rows.append([name.replace("_", " "), value, unit_text(OBSERVABLES[name].unit), *texts])
            if name == "force_ratio":
                ratio = with_error(*map(float, shear_stress_ratio(point)))
                rows.append(["shear-stress ratio", ratio, "", "", ""])
            if name == "binary_dissipation_rate":
                for length in (f"theory/{name}" for name in LENGTHS):
                    value = with_error(number(length), number(f"{length}_stderr"))
                    rows.append([length[7:].replace("_", " "), value, unit_text("sigma"), "", ""])
    print_table(title, columns, rows, numbers=False)
