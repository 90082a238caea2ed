"""The command ``run``: one flow, its averages, and its frames as a trajectory or movie."""

import math
import os
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from jaxgran.cli.arguments import QUIET, command, of_map
from jaxgran.cli.json_output import JSON, Entry, print_json
from jaxgran.cli.measure import finish, print_budget, run_map
from jaxgran.cli.tables import Table, print_table
from jaxgran.cli.terminal import configured_jax, counted, say
from jaxgran.maps.options import Option
from jaxgran.model.checks import InputError, require_number, short_repr
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
    frames_wanted = any(x is not None for x in (trajectory, movie))
    chosen = {"seeds": 1, **given}
    if frames_wanted:
        if chosen["seeds"] > 1:
            raise InputError(
                "`trajectory` and `movie` show one seed: leave out `seeds`.", field="seeds"
            )
        if "error" not in chosen:
            chosen.setdefault("strain", _RECORDED_STRAIN)
    strain = chosen.get("strain", _RECORDED_STRAIN)
    for name, file in (("trajectory", trajectory), ("movie", movie)):
        if file is not None and os.path.isfile(file) and not chosen.get("overwrite"):
            raise InputError(
                f"{name} {short_repr(str(file))} already exists; pass `overwrite=True` to replace "
                "it.",
                field=name,
            )
    recorder, frames = _recorder(trajectory, movie, frame_strain, force_strain, strain)
    record = None if recorder is None else recorder.recording
    output = chosen.get("output")
    plane = {"restitution": (restitution,), "packing_fraction": (packing_fraction,)}
    data, interrupted, written = run_map({**plane, **chosen, "record": record}, quiet)
    if json:
        print_json(_entries(data))
    elif bool(data.force_ratio.notnull().any()):
        print_table(_summary_table(data, all))
        print_budget(data)
    if recorder is not None and recorder.frames:
        say(
            "recording frames split the run at different steps, so averages change within their "
            "errors."
        )
        if trajectory is not None:
            say(f"wrote {trajectory}: {recorder.frames} frames")
        if movie is not None:
            _write_movie(movie, frames, quiet)
    finish(data, [output] if output is not None and written else [], interrupted, output)


run_command = command(RUN_OPTIONS, run_run_command, required=("restitution", "packing_fraction"))


def _recorder(
    trajectory: Path | None,
    movie: Path | None,
    frame_strain: float | None,
    force_strain: float | None,
    strain: float,
):
    """The recorder of the flow and the frames of its movie; None if there is no file for it."""
    if trajectory is None and movie is None:
        for name, value in (("frame_strain", frame_strain), ("force_strain", force_strain)):
            if value is not None:
                raise InputError(f"`{name}` requires `trajectory` or `movie`.", field=name)
        return None, None
    configured_jax()
    from jaxgran.io.trajectory import check_trajectory, write_frame
    from jaxgran.plotting.movie import MOST_DRAWN, Frames, check_movie
    from jaxgran.sampling.recorder import Recorder

    if frame_strain is not None:
        most_frames = MOST_RECORDED if movie is None else MOST_DRAWN
        least, most = strain / most_frames, strain
        accepted = (
            f"at least {least:g}, for {most_frames} frames, and at most the sampled strain, "
            f"{most:g}"
        )
        require_number(
            "frame_strain", frame_strain, lambda x: (x >= 0.99 * least) & (x <= most), accepted
        )
    every = strain / 100 if frame_strain is None else frame_strain
    if force_strain is not None:
        accepted = f"above 0 and at most the strain between frames, {every:g}"
        require_number("force_strain", force_strain, lambda x: (x > 0) & (x <= every), accepted)
    keep, frames = [], Frames()
    if trajectory is not None:
        check_trajectory(trajectory)
        keep.append(partial(write_frame, trajectory))
    if movie is not None:
        check_movie(movie)
        keep.append(frames.keep)
    return Recorder(every, *keep, force_strain=force_strain or 0.0), frames


def _write_movie(movie: Path, frames, quiet: bool) -> None:
    """Draw and write the movie, with progress unless quiet."""
    from jaxgran.plotting.movie import write_movie

    if not quiet:
        say(f"drawing {len(frames)} frames")
    write_movie(movie, frames, follow=iter if quiet else partial(counted, words="frames"))
    say(f"wrote {movie}: {len(frames)} frames")


def _entries(data) -> dict[str, Entry]:
    """The parameters of one flow, its averages, its shear-stress ratio, and what kinetic theory
    predicts.
    """
    from jaxgran.maps.schema import flattened, path_of, shear_stress_ratio
    from jaxgran.maps.status_report import bad_points
    from jaxgran.sampling.observables import OBSERVABLES

    point = flattened(data).isel(packing_fraction=0, restitution=0)
    entries = {
        name: Entry(point[name].values, point[name].long_name)
        for name in ("restitution", "packing_fraction")
    }
    entries |= {
        "grains": Entry(data.attrs["grains"], "number of grains"),
        "timestep": Entry(data.attrs["timestep"], "time step", "1 / shear rate"),
        "strain": Entry(point["sums/strain"].sum().values, "sampled strain of all seeds"),
        "engine": Entry(data.attrs["engine"], "program that advanced the flow", None),
        "solver": Entry(data.attrs["solver"], "method of the contact solve", None),
        "status": Entry(next(iter(bad_points(data)), "ok"), "worst status", None),
    }
    for name, one in OBSERVABLES.items():
        path = path_of(name)
        entries[name] = Entry(
            point[path].values,
            one.meaning,
            one.unit,
            point[f"{path}_stderr"].values if f"{path}_stderr" in point else None,
        )
    ratio, error = shear_stress_ratio(point)
    meaning = "contact shear stress over binary shear stress"
    entries["shear_stress_ratio"] = Entry(ratio.values, meaning, "1", error.values)
    for name, one in OBSERVABLES.items():
        if f"theory/{name}" in point:
            meaning = f"{one.meaning}, by kinetic theory"
            entries[f"theory/{name}"] = Entry(point[f"theory/{name}"].values, meaning, one.unit)
    return entries


def _summary_table(data, all: bool) -> Table:
    """The averages of one flow with errors, units, effective sample sizes and predictions of
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
        "value ± standard error",
        "unit",
        "effective samples",
        "kinetic theory",
    )
    table = Table(title, columns, numbers=False)
    point = flattened(data).isel(packing_fraction=0, restitution=0)
    strain = float(point["sums/strain"].sum())
    correlated = point["diagnostics/correlation_strain"].to_series().to_dict()

    def number(name: str) -> float:
        return float(point[name]) if name in point else math.nan

    for group, names in (GROUPS if all else {"/": _PHYSICS}).items():
        table.rows += [] if group == "/" else [[group.capitalize()]]
        for name in names:
            if OBSERVABLES[name].tensor:
                continue
            value, error = number(path_of(name)), number(f"{path_of(name)}_stderr")
            value = with_error(value, error) if group != "diagnostics" else f"{value:.3g}"
            samples = strain / correlated.get(name, math.nan)
            theory = number(f"theory/{name}")
            texts = ["" if math.isnan(x) else f"{x:.3g}" for x in (samples, theory)]
            table.rows.append(
                [name.replace("_", " "), value, unit_text(OBSERVABLES[name].unit), *texts]
            )
            if name == "force_ratio":
                ratio = with_error(*map(float, shear_stress_ratio(point)))
                table.rows.append(["shear-stress ratio", ratio, "", "", ""])
            if name == "binary_dissipation_rate":
                for length in (f"theory/{name}" for name in LENGTHS):
                    value = with_error(number(length), number(f"{length}_stderr"))
                    table.rows.append(
                        [length[7:].replace("_", " "), value, unit_text("sigma"), "", ""]
                    )
    return table
