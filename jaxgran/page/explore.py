"""A map as an interactive page: the plane, curves through a point, its numbers, and its grains."""

from pathlib import Path

from jaxgran.maps.schema import MapData
from jaxgran.page.document import Page, data_of, document
from jaxgran.page.map_data import map_data
from jaxgran.page.reference_map import reference_dataset

_OF_THE_MAP = (
    "title",
    "axes",
    "about",
    "again",
)  # data of a page that the parameters of its map decide
_SCRIPTS = ("page.js", "grains.js", "charts.js", "table.js", "map.js")


def explore(data: MapData | None = None, output: str | Path | None = None) -> Page:
    """A page to look into a map with a browser. It is one file, and needs neither a network nor a
    running program.

    Beside the numbers of the selected point stands what the reference map says of kinetic theory
    there.

    A notebook shows the page if this call is the last line of a cell.

    Args:
      data: dataset of a map, as ``ratio_map`` returns it and ``open_map`` reads it. Every number at
        its points is shown, also one that you have added. None for the reference map, from which
        ``validity`` answers.
      output: file to write the page to, or None.

    Raises:
      InputError: (a ValueError) the data are no map, or Plotly is not installed.
    """
    found = map_data(reference_dataset() if data is None else data)
    page = document("map", _SCRIPTS, found["title"], found)
    if output is not None:
        page.save(output)
    return page


def shows_same_map(path: Path, page: Page) -> bool:
    """Whether a file is a page of a map with the parameters of that of another page, perhaps with
    other numbers.
    """
    text = path.read_text(encoding="utf-8", errors="replace")
    there, here = (
        [data.get(name) for name in _OF_THE_MAP]
        for data in (data_of(x) or {} for x in (text, page.text))
    )
    return there == here
