"""The commands ``map`` and ``plot``: a plane of restitutions and packing fractions, and its figures."""

import os
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, get_args

from jaxgran.cli.arguments import FILE, QUIET, command, for_error, of_map
from jaxgran.cli.measure import finish, print_budget, run_map
from jaxgran.cli.tables import Table, print_table
from jaxgran.cli.terminal import configured_jax, require_device, say, say_written
from jaxgran.maps.parameters import Option
from jaxgran.maps.presets import PRESETS
from jaxgran.model.checks import refused
from jaxgran.model.choices import FileFormat
from jaxgran.model.display import with_error

MAP_EXAMPLES = {
    "Restitutions 0.2 to 0.8 and packing fractions 0.5 to 0.79, half a minute on two cores": "jaxgran map",
    "Another plane, at an automatic time step": "jaxgran map --restitution 0.1,0.5,0.9 "
    "--packing-fraction 0.5:0.8:4 --timestep auto --output ratio.nc",
    "Until relative errors are below 10 %, and again after an interruption": "jaxgran map --error 0.1 --resume",
}
PLOT_EXAMPLES = {
    "The figures of a map, in its folder": "jaxgran plot jaxgran_map.nc",
    "In another folder": "jaxgran plot ratio.nc --output figures",
    "Without captions, for a manuscript": "jaxgran plot ratio.nc --output figures --format pdf --no-caption",
}


MAP_OPTIONS = {
    "preset": Option("Starting point of all other options.", tuple(PRESETS), default="quick"),
    "from_map": Option("Repeat the map of this file; other options replace its parameters.", Path, example="FILE.nc"),
    **of_map("map"),
    "format": Option("Format of the figures.", get_args(FileFormat), default="png"),
    "quiet": QUIET,
}
PLOT_OPTIONS = {
    "output": Option(
        "Folder of the figures, made if missing.", Path, default="that of the dataset", short="o", example="FOLDER"
    ),
    "format": Option("Format of the figures.", get_args(FileFormat), default="png"),
    "dpi": Option("Dots per inch of a PNG, 50 to 1200.", int, default="200"),
    "caption": Option("Parameters of the run and notes under the axes.", bool, default="--caption", off=True),
}


def run_map_command(
    preset: str = "quick", from_map: Path | None = None, format: FileFormat = "png", quiet: bool = False, **given: Any
) -> None:
    start = PRESETS[preset] if from_map is None else _parameters_of(from_map)
    chosen = combined(start, given)
    output = chosen.setdefault("output", Path("jaxgran_map.nc" if preset == "quick" else f"jaxgran_map_{preset}.nc"))
    data, interrupted, written = run_map(chosen, quiet, "jaxgran.plotting.map_figures")

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


def run_plot_command(
    file: Path, output: Path | None = None, format: FileFormat = "png", dpi: int = 200, caption: bool = True
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
        raise refused("output", str(folder), "must be a folder that can be made and written to")
    pictures = save_figures(data, folder / file.stem, format, dpi, caption)
    remove_pictures(folder / file.name, but=pictures)
    say_written(pictures)


map_command = command(MAP_OPTIONS, run_map_command)
plot_command = command(PLOT_OPTIONS, run_plot_command, argument=FILE)


def _parameters_of(file: Path) -> dict[str, Any]:
    """The parameters of the map in a file; other differences that could change its numbers go to standard error."""
    configured_jax()
    require_device()
    from jaxgran.maps.results import choices_of, differences, read_dataset

    data = read_dataset(file)
    chosen, different = choices_of(data), differences(data)
    if different:
        say(f"differs from {file}: {'; '.join(different)}.")
    return chosen | {"tolerance": getattr(chosen["solver"], "tolerance", None)}  # also of another solver


def combined(start: Mapping[str, Any], given: Mapping[str, Any]) -> dict[str, Any]:
    """The parameters of a preset or a file, replaced by those that are given and by what these choose."""
    replaced = {"error": ("seeds", "strain"), "strain": ("error",)}
    left_out = {name for option in replaced.keys() & given.keys() for name in replaced[option]}
    kept = {name: value for name, value in start.items() if name not in left_out}
    if "grains_by_point" in kept and given.keys() & {"grains", "restitution", "packing_fraction", "timestep", "error"}:
        del kept["grains_by_point"]
        kept["grains"] = "auto"  # chosen again, for the points that are given
    return kept | for_error(given) | dict(given)


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
