"""The commands ``map`` and ``plot``: a plane of restitutions and packing fractions, and its
figures.
"""

import os
from contextlib import suppress
from pathlib import Path
from typing import Any, get_args

from jaxgran.cli.options import FILE, QUIET, command, of_map
from jaxgran.cli.outcome import finish, run_map, told_how_to_resume
from jaxgran.cli.output import JSON, print_json
from jaxgran.cli.summary import print_map, summary_of
from jaxgran.cli.terminal import say, say_cache, say_written
from jaxgran.maps.options import Option
from jaxgran.model.checks import InputError, refused, short_repr
from jaxgran.model.choices import FileFormat

MAP_EXAMPLES = {
    "Restitutions 0.2 to 0.8 and packing fractions 0.5 to 0.79, half a minute on two "
    "cores": "jaxgran map",
    "Another plane, at the automatic time step": "jaxgran map --restitution 0.1,0.5,0.9 "
    "--packing-fraction 0.5:0.8:4 --timestep auto --output ratio.nc",
    "Until relative errors are below 10 %, and again after an interruption": "jaxgran map --error "
    "0.1 --resume",
}
PLOT_EXAMPLES = {
    "The figures of a map, in its folder": "jaxgran plot jaxgran_map.nc",
    "In another folder": "jaxgran plot ratio.nc --output figures",
    "Without captions, for a manuscript": "jaxgran plot ratio.nc --output figures --format pdf "
    "--no-caption",
}


MAP_OPTIONS = {
    **of_map("map"),
    "format": Option("Format of the figures.", get_args(FileFormat), default="png"),
    "json": JSON,
    "quiet": QUIET,
}
PLOT_OPTIONS = {
    "output": Option(
        "Folder of the figures.", Path, default="that of the dataset", short="o", example="FOLDER"
    ),
    "format": Option("Format of the figures.", get_args(FileFormat), default="png"),
    "dpi": Option("Dots per inch of a PNG, 50 to 1200.", int, default="200"),
    "caption": Option(
        "Write parameters and notes under the axes.", bool, default="--caption", off=True
    ),
}


def run_map_command(
    format: FileFormat = "png", json: bool = False, quiet: bool = False, **given: Any
) -> None:
    preset = given.get("preset", "quick")
    output = given.setdefault(
        "output", Path("jaxgran_map.nc" if preset == "quick" else f"jaxgran_map_{preset}.nc")
    )
    overwrite, existed = given.get("overwrite", False), os.path.exists(output)
    if "part" not in given and not overwrite:
        require_new_figures(output, format)
    data, interrupted, written = run_map(given, quiet)
    whole, pictures = "part" not in data.attrs, []  # the rest of a part is in other files
    with told_how_to_resume(output, finished=not interrupted):
        if not interrupted:
            to_draw = data if whole else None
            pictures = draw_beside(to_draw, output, format, overwrite, existed, written)
        if json:
            print_json(summary_of(data))
        elif whole:
            print_map(data)
    finish(data, [*([output] if written else []), *pictures], interrupted, quiet, output)


def require_new_figures(output: Path, format: FileFormat) -> None:
    """Raise an InputError if the figures of a map that is not there yet would replace files."""
    names = []
    if not os.path.exists(output):
        with suppress(OSError, ValueError):  # a folder that cannot be read is refused later
            names = [
                name for name in os.listdir(output.parent) if name.startswith(f"{output.stem}_")
            ]
    if names:
        from jaxgran.plotting.map_figures import FIGURES, figure_path

        figures = (figure_path(output.with_suffix(""), name, format) for name in FIGURES)
        for figure in sorted(path for path in figures if path.name in names):
            raise InputError(
                f"the figure {short_repr(str(figure))} already exists; name "
                "another output, or pass `overwrite=True` to replace it.",
                field="output",
            )


def draw_beside(
    data, output: Path, format: FileFormat, overwrite: bool, existed: bool, written: bool
) -> list[Path]:
    """Draw the figures of a map beside its file, none of a part. Of a map that was there before,
    remove the others with ``overwrite``, or else name them.

    Figures that are there are kept if the file was not ``written``, and none of them is older than
    it. The files drawn.
    """
    from jaxgran.plotting.map_figures import pictures_beside, save_figures

    stem, made = output.with_suffix(""), os.stat(output).st_mtime_ns if existed else 0
    drawn = (file for file in pictures_beside(output) if file.suffix == f".{format}")
    old = any(file.stat().st_mtime_ns < made for file in drawn)
    renew = overwrite or written or old
    pictures = [] if data is None else save_figures(data, stem, format, overwrite=renew)
    if renew and existed:
        for file in sorted(pictures_beside(output) - {*pictures}):
            if overwrite:
                file.unlink()
            else:
                say(f"{file} shows the map as it was before: draw it again by jaxgran plot.")
    return pictures


def run_plot_command(
    file: Path,
    output: Path | None = None,
    format: FileFormat = "png",
    dpi: int = 200,
    caption: bool = True,
) -> None:
    say_cache()  # before Matplotlib looks for its own
    from jaxgran.maps.results import open_map
    from jaxgran.plotting.map_figures import require_file, save_figures

    require_file(format, dpi)
    data = open_map(file)
    folder = file.parent if output is None else output
    with suppress(OSError):
        folder.mkdir(parents=True, exist_ok=True)
    if not os.path.isdir(folder) or not os.access(folder, os.W_OK):
        raise refused("output", str(folder), "must be a folder that can be made and written to")
    say_written(save_figures(data, folder / file.stem, format, dpi, caption))


map_command = command(MAP_OPTIONS, run_map_command)
plot_command = command(PLOT_OPTIONS, run_plot_command, argument=FILE)
