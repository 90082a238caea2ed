"""The command ``explore``: a map as an interactive page for a browser."""

from pathlib import Path

from jaxgran.cli.options import OVERWRITE, command
from jaxgran.cli.terminal import say_written
from jaxgran.maps.options import Option

EXPLORE_EXAMPLES = {
    "A page beside the map": "jaxgran explore jaxgran_map.nc",
    "The reference map, from which jaxgran where answers": "jaxgran explore",
    "With another name": "jaxgran explore ratio.nc --output page.html",
}


EXPLORE_FILE = Option("Dataset of a map.", Path, default="the reference map")
EXPLORE_OPTIONS = {
    "output": Option(
        "HTML file of the page.",
        Path,
        default="the name of the dataset, or reference_map, with .html",
        short="o",
        example="FILE.html",
    ),
    "overwrite": OVERWRITE,
}


def run_explore_command(
    file: Path | None, output: Path | None = None, overwrite: bool = False
) -> None:
    from jaxgran.io.paths import require_absent, require_place
    from jaxgran.maps.results import open_map
    from jaxgran.page.explore import explore

    path = (file or Path("reference_map.nc")).with_suffix(".html") if output is None else output
    require_place(path, "output", ".html")
    if not overwrite:
        require_absent(path, "output")
    page = explore(None if file is None else open_map(file))
    page.save(path)
    say_written([path])


explore_command = command(EXPLORE_OPTIONS, run_explore_command, argument=EXPLORE_FILE)
