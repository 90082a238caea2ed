"""A map as an interactive page: the plane, curves through a point, its numbers, and its grains."""

from pathlib import Path

from jaxgran.maps.schema import MapData
from jaxgran.page.document import Page, document
from jaxgran.page.map_data import map_data
from jaxgran.page.reference_map import reference_dataset


def explore(data: MapData | None = None, output: str | Path | None = None) -> Page:
    """An interactive page of a map: one HTML file, which works offline.

    The numbers of the selected point are shown beside what the reference map says of kinetic theory
    there. A notebook displays the page if this call is the last line of a cell.

    Args:
      data: dataset of a map, as ``ratio_map`` returns it and ``open_map`` reads it. Every number at
        its points is shown, also one that you have added. None for the reference map, from which
        ``validity`` answers.
      output: file to write the page to, or None.

    Raises:
      InputError: (a ValueError) the data are no map, or Plotly is not installed.
    """
    page = document(map_data(reference_dataset() if data is None else data))
    if output is not None:
        page.save(output)
    return page
