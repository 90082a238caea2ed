"""The command ``run``: one flow, its averages, and its frames as a trajectory, movie or page."""

import math
import os
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from jaxgran.cli.arguments import RelativeError, chosen_for, numbers_or_auto, require_one
from jaxgran.cli.measure import finish, measured, print_budget
from jaxgran.cli.tables import Table, print_table
from jaxgran.cli.terminal import configured_jax, say
from jaxgran.maps.progress import counted
from jaxgran.model.checks import InputError, require_number, short_repr
from jaxgran.model.choices import Activation, EngineName, SolverName
from jaxgran.model.display import with_error

MOST_RECORDED = 100_000  # frames of a trajectory
_RECORDED_STRAIN = 5.0  # sampled strain where frames are kept and none is given

_GROUPS = {  # names of observables by what they tell; those that are not here are of the last group
    "Forces": ("force_ratio", "contact_force", "binary_force", "force_second_moment"),
    "Stresses": (
        *("pressure", "contact_pressure", "binary_pressure", "kinetic_pressure"),
        *("shear_stress", "contact_shear_stress", "binary_shear_stress", "kinetic_shear_stress"),
        *("bagnold_pressure", "bagnold_shear_stress", "macroscopic_friction", "inertial_number"),
    ),
    "Motion and structure": (
        *("granular_temperature", "local_granular_temperature", "longwave_energy_ratio", "collision_rate"),
        *("coordination_number", "network_size", "cluster_pressure_share", "cluster_shear_share"),
    ),
}
_LAST_GROUP = "Quality of the run"

RUN_EXAMPLES = {
    "A flow in its steady state: averages with errors": "jaxgran run --restitution 0.5 --packing-fraction 0.7",
    "A movie of it, about a hundred frames": "jaxgran run --restitution 0.1 --packing-fraction 0.8 --movie flow.gif",
    "The same as a page for a browser, which pauses and steps": "jaxgran run --restitution 0.1 --packing-fraction 0.8 "
    "--page flow.html",
    "All its frames for other programs, every 0.01 of strain": "jaxgran run --restitution 0.5 --packing-fraction 0.7 "
    "--trajectory flow.gsd --every 0.01",
}


def run_command(
    restitution: Annotated[float, typer.Option(help="Restitution, 0 to 1.")],
    packing_fraction: Annotated[float, typer.Option(help="Packing fraction, up to 0.83.")],
    grains: Annotated[int | None, typer.Option(help="Number of grains. [default: 256]")] = None,
    strain: Annotated[
        float | None, typer.Option(help="Sampled strain. [default: six memories of the flow, 5 where frames are kept]")
    ] = None,
    error: RelativeError = None,
    timestep: Annotated[
        str | None, typer.Option(help="Time step of the sample, in 1/shear rate, or auto. [default: 1e-3]")
    ] = None,
    seeds: Annotated[int, typer.Option(help="Independent replicas, averaged together.")] = 1,
    seed: Annotated[int, typer.Option(help="Number of the first replica: another one begins from other grains.")] = 0,
    tolerance: Annotated[
        str | None, typer.Option(help="Relative residual of a contact solve, or auto. [default: 1e-4]")
    ] = None,
    solver: Annotated[
        SolverName | None,
        typer.Option(help="Method of the contact solve in the engine jax. [default: barzilai-borwein]"),
    ] = None,
    activation: Annotated[Activation | None, typer.Option(help="When a pair is a contact. [default: midpoint]")] = None,
    engine: Annotated[EngineName, typer.Option(help="Program that advances the flow.")] = "auto",
    trajectory: Annotated[
        Path | None,
        typer.Option(
            help="GSD file of the flow, frame by frame. Frames cut the flow elsewhere: its numbers change within their "
            "errors."
        ),
    ] = None,
    every: Annotated[
        float | None,
        typer.Option(help="Strain from frame to frame. [default: a hundredth of --strain, or 0.05 with --error]"),
    ] = None,
    movie: Annotated[
        Path | None, typer.Option(help="GIF or MP4 of the flow: grains by their speed, and the forces between them.")
    ] = None,
    page: Annotated[
        Path | None, typer.Option(help="HTML file that plays the flow in a browser, with its running averages.")
    ] = None,
    output: Annotated[Path | None, typer.Option(help="NetCDF file of the averages.")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace files, whatever they hold.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress on standard error.")] = False,
) -> None:
    step = numbers_or_auto(timestep, "timestep")
    if isinstance(step, tuple):
        raise InputError(f"timestep must be one number or auto, not {short_repr(timestep)}.")
    require_one(strain, error)
    residual = numbers_or_auto(tolerance, "tolerance")
    if isinstance(residual, tuple):
        raise InputError(f"tolerance must be one number or auto, not {short_repr(tolerance)}.")
    frames_wanted = any(x is not None for x in (trajectory, movie, page))
    if seeds > 1 and frames_wanted:
        raise InputError(
            "--trajectory, --movie and --page show one replica: leave out --seeds, or choose one by --seed."
        )
    if strain is None and error is None and frames_wanted:
        strain = _RECORDED_STRAIN
    given = {
        "grains": grains,
        "timestep": step,
        "strain": strain,
        "error": error,
        "tolerance": residual,
        "solver": solver,
        "activation": activation,
    }
    chosen = {
        "restitution": (restitution,),
        "packing_fraction": (packing_fraction,),
        "seeds": seeds,
        "first_seed": seed,
        "engine": engine,
        **chosen_for(error),
        **{name: value for name, value in given.items() if value is not None},
    }
    for name, file in (("trajectory", trajectory), ("movie", movie), ("page", page)):
        if file is not None and os.path.isfile(file) and not overwrite:
            raise InputError(f"{name} must be a new file, or --overwrite be given: {short_repr(str(file))} is there.")
    recorder, frames, film = _recorder(trajectory, movie, page, every, strain or _RECORDED_STRAIN)
    record = None if recorder is None else recorder.recording if film is None else film.recording(recorder)
    data, interrupted, written = measured(chosen, "auto", None, output, quiet, record=record, overwrite=overwrite)
    print_table(_summary_table(data))
    print_budget(data)
    if recorder is not None and recorder.frames:
        say("frames cut the flow elsewhere: its numbers differ from those without frames, within their errors.")
        if trajectory is not None:
            say(f"wrote {trajectory}: {recorder.frames} frames")
        if movie is not None:
            _write_movie(movie, frames, quiet)
        if film is not None and page is not None:
            film.page().save(page)
            say(f"wrote {page}: {len(film.frames.scenes)} frames")
    finish(data, [output] if output and written else [], interrupted)


def _recorder(trajectory: Path | None, movie: Path | None, page: Path | None, every: float | None, strain: float):
    """The recorder of the flow, the frames of its movie, and the film of its page; None if no file is asked for."""
    if trajectory is None and movie is None and page is None:
        if every is not None:
            raise InputError(
                "--every is the strain between frames: add --trajectory FILE.gsd, --movie FILE.gif or --page FILE.html "
                "to have any."
            )
        return None, None, None
    configured_jax()
    from jaxgran.io.atomic import require_place
    from jaxgran.io.trajectory import check_trajectory, write_frame
    from jaxgran.plotting.movie import MOST_DRAWN, Frames, check_movie
    from jaxgran.sampling.recorder import Recorder

    if every is not None:
        most_frames = MOST_RECORDED if movie is None and page is None else MOST_DRAWN
        least, most = strain / most_frames, strain
        words = f"at least {least:g}, for {most_frames} frames, and at most the sampled strain, {most:g}"
        require_number("every", every, lambda x: (x >= 0.99 * least) & (x <= most), words)
    keep, frames, film = [], Frames(), None
    if trajectory is not None:
        check_trajectory(trajectory)
        keep.append(partial(write_frame, trajectory))
    if movie is not None:
        check_movie(movie)
        keep.append(frames.keep)
    if page is not None:
        from jaxgran.page.document import require_plotly
        from jaxgran.page.film import Film

        require_place(page, "page", ".html")
        require_plotly()
        film = Film()
        keep.append(film.frames.keep)
    return Recorder(strain / 100 if every is None else every, *keep), frames, film


def _write_movie(movie: Path, frames, quiet: bool) -> None:
    """Draw and write the movie, with progress unless quiet."""
    from jaxgran.plotting.movie import write_movie

    if not quiet:
        say(f"drawing {len(frames.scenes)} frames")
    write_movie(movie, frames, follow=iter if quiet else partial(counted, words="frames"))
    say(f"wrote {movie}: {len(frames.scenes)} frames")


def _summary_table(data) -> Table:
    """The averages of one flow with errors, units, effective sample sizes and predictions of kinetic theory."""
    from jaxgran.maps.schema import flattened, path_of, shear_stress_ratio
    from jaxgran.sampling.observables import OBSERVABLES, TENSORS

    grains, timestep, rule = (data.attrs[name] for name in ("grains", "timestep", "activation"))
    title = (
        f"{grains} grains, dt = {timestep:g} / shear rate, {rule} activation\n"
        f"engine {data.attrs['engine']}, solver {data.attrs['solver']}"
    )
    columns = ("observable", "value ± standard error", "unit", "effective samples", "kinetic theory")
    table = Table(title, columns, numbers=False)
    point = flattened(data).isel(packing_fraction=0, restitution=0)
    strain = float(point["seeds/strain"].sum())
    correlated = point["diagnostics/correlation_strain"].to_series().to_dict()

    def number(name: str) -> float:
        return float(point[name]) if name in point else math.nan

    scalars = [name for name in OBSERVABLES if name not in TENSORS]
    others = [name for name in scalars if name not in sum(_GROUPS.values(), ())]
    for group, names in {**_GROUPS, _LAST_GROUP: others}.items():
        table.rows.append([group])
        for name in names:
            value = with_error(number(path_of(name)), number(f"{path_of(name)}_stderr"))
            unit = OBSERVABLES[name][1].replace("sigma", "σ").replace("^2", "²").replace(" ", "")
            samples = strain / correlated.get(name, math.nan)
            theory = number(f"theory/{name}")
            texts = ["" if math.isnan(x) else f"{x:.3g}" for x in (samples, theory)]
            table.rows.append([name.replace("_", " "), value, "" if unit == "1" else unit, *texts])
            if name == "force_ratio":
                ratio = with_error(*map(float, shear_stress_ratio(point)))
                table.rows.append(["shear-stress ratio", ratio, "", "", ""])
    return table
