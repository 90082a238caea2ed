"""The commands ``map`` and ``plot``: a plane of restitutions and packing fractions, and its figures."""

import os
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from jaxgran.cli.arguments import (
    RelativeError,
    batch_size,
    chosen_for,
    number_list,
    numbers_or_auto,
    require_one,
    whole_numbers,
)
from jaxgran.cli.measure import finish, measured, print_budget
from jaxgran.cli.tables import Table, print_table
from jaxgran.cli.terminal import configured_jax, require_device, say, say_written
from jaxgran.maps.presets import PRESETS
from jaxgran.model.checks import InputError, short_repr
from jaxgran.model.choices import Activation, EngineName, FileFormat, SolverName
from jaxgran.model.display import with_error

MAP_EXAMPLES = {
    "Restitutions 0.2 to 0.8 and packing fractions 0.5 to 0.79, half a minute on two cores": "jaxgran map",
    "Another plane, at an automatic time step": "jaxgran map --restitution 0.1,0.5,0.9 "
    "--packing-fraction 0.5:0.8:4 --timestep auto --output ratio.nc",
    "Until the errors are below 10 %, continued after an interruption": "jaxgran map --error 0.1 --resume",
}
PLOT_EXAMPLES = {
    "The figures of a map, in its folder": "jaxgran plot jaxgran_map.nc",
    "In another folder": "jaxgran plot ratio.nc --output figures",
    "For a manuscript with captions of its own": "jaxgran plot ratio.nc --output figures --format pdf --no-caption",
}


def map_command(
    preset: Annotated[
        Literal["quick", "paper", "dense"], typer.Option(help="Starting point for all other options.")
    ] = "quick",
    restitution: Annotated[
        str | None, typer.Option(help="List of restitutions: 0.1,0.5,0.9 or start:stop:count.")
    ] = None,
    packing_fraction: Annotated[str | None, typer.Option(help="List of packing fractions, up to 0.83.")] = None,
    grains: Annotated[
        str | None, typer.Option(help="Grains of a replica, or a list that adds a dimension: 256,1000,4000.")
    ] = None,
    seeds: Annotated[int | None, typer.Option(help="Replicas of each point.")] = None,
    first_seed: Annotated[
        int | None, typer.Option(help="Number of the first replica: others begin from other grains. [default: 0]")
    ] = None,
    timestep: Annotated[
        str | None,
        typer.Option(help="Time step of the sample, in 1/shear rate, auto, or a list that adds a dimension."),
    ] = None,
    equilibrate: Annotated[float | None, typer.Option(help="Strain before the sample. [default: until steady]")] = None,
    strain: Annotated[
        float | None, typer.Option(help="Sampled strain of each seed. [default: six memories of each flow]")
    ] = None,
    error: RelativeError = None,
    tolerance: Annotated[
        str | None, typer.Option(help="Relative residual of a contact solve, or auto. [default: 1e-4]")
    ] = None,
    target_error: Annotated[
        float, typer.Option(help="Relative error of the stresses that auto aims at, 1e-4 to 0.1.")
    ] = 0.02,
    solver: Annotated[
        SolverName | None,
        typer.Option(help="Method of the contact solve in the engine jax. [default: barzilai-borwein]"),
    ] = None,
    engine: Annotated[EngineName | None, typer.Option(help="Program that advances the flows. [default: auto]")] = None,
    activation: Annotated[Activation | None, typer.Option(help="When a pair is a contact. [default: midpoint]")] = None,
    snapshots: Annotated[
        bool | None,
        typer.Option(
            "--snapshots/--no-snapshots", help="Keep one instant of every point: its grains, and their forces."
        ),
    ] = None,
    batch: Annotated[str, typer.Option(help="Replicas that run together, or auto.")] = "auto",
    workers: Annotated[int | None, typer.Option(help="Processes. [default: one per core on a CPU]")] = None,
    scheduler: Annotated[
        str | None, typer.Option(help="Address of a running Dask cluster, such as tcp://127.0.0.1:8786.")
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(help="NetCDF file; the figures go beside it. [default: jaxgran_map.nc, or jaxgran_map_PRESET.nc]"),
    ] = None,
    format: Annotated[FileFormat, typer.Option(help="Format of the figures.")] = "png",
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the output, whatever it holds.")] = False,
    like: Annotated[
        Path | None, typer.Option(help="Dataset whose map is repeated; other options override its parameters.")
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Continue an unfinished map of this output.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress on standard error.")] = False,
) -> None:
    if scheduler is not None and workers is not None:
        raise InputError("--scheduler and --workers exclude each other: give one of them.")
    require_one(strain, error)
    given = {
        "restitution": None if restitution is None else number_list(restitution, "restitution"),
        "packing_fraction": None if packing_fraction is None else number_list(packing_fraction, "packing_fraction"),
        "grains": whole_numbers(grains, "grains"),
        "seeds": seeds,
        "first_seed": first_seed,
        "timestep": numbers_or_auto(timestep, "timestep"),
        "equilibrate": equilibrate,
        "strain": strain,
        "error": error,
        "tolerance": numbers_or_auto(tolerance, "tolerance"),
        "solver": solver,
        "activation": activation,
        "engine": engine,
        "snapshots": snapshots,
    }
    given = {name: value for name, value in given.items() if value is not None}
    chosen = kept_choices(PRESETS[preset] if like is None else _like(like), given) | chosen_for(error) | given
    if output is None:
        output = Path("jaxgran_map.nc" if preset == "quick" else f"jaxgran_map_{preset}.nc")
    figures = ["jaxgran.plotting.map_figures"]
    data, interrupted, written = measured(
        chosen,
        batch_size(batch),
        workers,
        output,
        quiet,
        target_error,
        resume,
        scheduler,
        load=figures,
        overwrite=overwrite,
    )

    from jaxgran.maps.schema import parts, shear_stress_ratio
    from jaxgran.plotting.map_figures import save_figures

    pictures = [] if interrupted else save_figures(data, output.with_suffix(""), format)
    for part in parts(data):
        print_table(_ratio_table(part, "Force ratio", part.force_ratio, part.force_ratio_stderr))
        print_table(_ratio_table(part, "Shear-stress ratio", *shear_stress_ratio(part)))
    if "grains" in data.dims:
        for part in parts(data.isel(grains=-1)):
            print_table(_large_system_table(part))
    print_budget(data)
    finish(data, [*([output] if written else []), *pictures], interrupted, can_resume=True)


def plot_command(
    file: Annotated[Path, typer.Argument(help="Dataset of a map.")],
    output: Annotated[
        Path | None, typer.Option(help="Folder of the figures, made if it is not there. [default: that of the dataset]")
    ] = None,
    format: Annotated[FileFormat, typer.Option(help="Format of the figures.")] = "png",
    dpi: Annotated[int, typer.Option(help="Dots per inch of a PNG, 50 to 1200.")] = 200,
    caption: Annotated[
        bool, typer.Option("--caption/--no-caption", help="Parameters of the run and notes under the axes.")
    ] = True,
) -> None:
    from jaxgran.maps.output import remove_pictures
    from jaxgran.maps.results import read_dataset
    from jaxgran.plotting.map_figures import require_file, save_figures

    require_file(format, dpi)
    data = read_dataset(file)
    folder = file.parent if output is None else output
    with suppress(OSError):
        folder.mkdir(parents=True, exist_ok=True)
    if not os.path.isdir(folder) or not os.access(folder, os.W_OK):
        raise InputError(f"output must be a folder that can be made and written to, not {short_repr(str(folder))}.")
    pictures = save_figures(data, folder / file.stem, format, dpi, caption)
    remove_pictures(folder / file.name, but=pictures)
    say_written(pictures)


def _like(file: Path) -> dict[str, Any]:
    """The parameters of the map in a file; other differences that could change its numbers go to standard error."""
    configured_jax()
    require_device()
    from jaxgran.maps.results import choices_of, differences, read_dataset

    data = read_dataset(file)
    chosen, different = choices_of(data), differences(data)
    if different:
        say(f"not as in {file}: {'; '.join(different)}.")
    return chosen | {"tolerance": getattr(chosen["solver"], "tolerance", None)}  # also of another solver


def kept_choices(start: Mapping[str, Any], given: Mapping[str, Any]) -> dict[str, Any]:
    """The parameters of a preset or a file that still hold beside those that are given."""
    replaced = {"error": ("seeds", "strain"), "strain": ("error",)}
    left_out = {name for option in replaced.keys() & given.keys() for name in replaced[option]}
    kept = {name: value for name, value in start.items() if name not in left_out}
    if "grains_by_point" in kept and given.keys() & {"grains", "restitution", "packing_fraction", "timestep", "error"}:
        del kept["grains_by_point"]
        kept["grains"] = "auto"  # chosen again, for the points that are given
    return kept


def _ratio_table(data, name: str, ratio, stderr) -> Table:
    """A ratio of a map with standard errors; * marks a bad status."""
    timestep, rule = data.attrs["timestep"], data.attrs["activation"]
    size = f"{data.attrs['grains']} grains, " if "grains" in data.coords else ""
    title = f"{name} at {size}dt = {timestep:g} / shear rate, {rule} activation; a column is a restitution"
    table = Table(title, ["packing fraction", *(f"{alpha:g}" for alpha in data.restitution.values)])
    for nu in data.packing_fraction.values:
        row = {"packing_fraction": nu}
        marks = ["" if status == 0 else " *" for status in data.status.sel(row).values]
        cells = zip(ratio.sel(row).values, stderr.sel(row).values, marks, strict=True)
        table.rows.append([f"{nu:g}", *(with_error(value, error) + mark for value, error, mark in cells)])
    return table


def _large_system_table(data) -> Table:
    """The estimates for a large system, a row for each point."""
    from jaxgran.maps.large_system import BOUNDS, CONVERGED

    title = f"Large systems at dt = {data.attrs['timestep']:g} / shear rate; ± bounds the error of sampling and size"
    columns = ["packing fraction", "restitution", *(name.replace("_", " ") for name in BOUNDS)]
    table = Table(title, columns, keys=2)
    for nu in data.packing_fraction.values:
        for alpha in data.restitution.values:
            point = data.sel(packing_fraction=nu, restitution=alpha)
            cells = []
            for name in BOUNDS:
                value, error = (float(point[f"large_system/{name}{end}"]) for end in ("", "_ci95"))
                no_limit = int(point[f"large_system/{name}_converged"]) == CONVERGED["not_converged"]
                cells.append("not converged" if no_limit else with_error(value, error))
            table.rows.append([f"{nu:g}", f"{alpha:g}", *cells])
    return table
