"""The command ``merge``: maps of other parts, seeds or points as one map."""

import os
from pathlib import Path

from jaxgran.cli.map import MAP_OPTIONS, draw_beside, require_new_figures
from jaxgran.cli.options import OVERWRITE, command
from jaxgran.cli.outcome import command_line, finish
from jaxgran.cli.summary import print_map
from jaxgran.cli.terminal import configured_jax, require_device
from jaxgran.maps.options import Option
from jaxgran.maps.settings import OPTIONS
from jaxgran.model.choices import FileFormat

MERGE_EXAMPLES = {
    "The parts of an array job": "jaxgran merge parts/part-*.nc --output map.nc",
    "Two maps of the same settings, the second from --first-seed 2 on": "jaxgran merge map.nc "
    "more.nc --output both.nc",
}
MERGE_OPTIONS = {
    "output": OPTIONS["output"],
    "overwrite": OVERWRITE,
    "format": MAP_OPTIONS["format"],
}


def run_merge_command(
    files: list[Path], output: Path, overwrite: bool = False, format: FileFormat = "png"
) -> None:
    configured_jax()
    require_device()
    from jaxgran.io.paths import require_absent, require_place
    from jaxgran.maps.merge import merge_maps
    from jaxgran.maps.results import write_dataset

    require_place(output, "output", ".nc")
    existed = os.path.exists(output)
    if not overwrite:
        require_absent(output, "output")
        require_new_figures(output, format)
    data = merge_maps(files)
    data.attrs["command"] = command_line()
    write_dataset(data, output)
    pictures = draw_beside(data, output, format, overwrite, existed, written=True)
    print_map(data)
    finish(data, [output, *pictures], interrupted=False)


merge_command = command(
    MERGE_OPTIONS,
    run_merge_command,
    required=("output",),
    argument=Option("Datasets of maps.", Path),
    several=True,
)
