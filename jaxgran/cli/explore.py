"""The command ``explore``: a map as a page for a browser."""

from pathlib import Path
from typing import Annotated

import typer

from jaxgran.cli.terminal import say_written
from jaxgran.model.checks import InputError, short_repr

EXPLORE_EXAMPLES = {
    "A page beside the map": "jaxgran explore jaxgran_map.nc",
    "With another name": "jaxgran explore ratio.nc --output page.html",
}


def explore_command(
    file: Annotated[Path, typer.Argument(help="Dataset of a map.")],
    output: Annotated[
        Path | None, typer.Option(help="HTML file of the page. [default: the name of the dataset with .html]")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the output, whatever it holds.")] = False,
) -> None:
    from jaxgran.io.atomic import require_place
    from jaxgran.maps.results import read_dataset
    from jaxgran.page.document import require_plotly
    from jaxgran.page.explore import explore, shows_same_map

    path = file.with_suffix(".html") if output is None else output
    require_place(path, "output", ".html")
    require_plotly()
    page = explore(read_dataset(file, needed=()))
    if path.exists() and not overwrite and not shows_same_map(path, page):
        raise InputError(
            f"output must be another file, or --overwrite be given: {short_repr(str(path))} is no page of this map."
        )
    page.save(path)
    say_written([path])
