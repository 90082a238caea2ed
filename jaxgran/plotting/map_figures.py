"""All figures of a map, written as files beside its dataset."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, get_args

import xarray as xr
from matplotlib.figure import Figure

from jaxgran.maps.replica import PLANE
from jaxgran.maps.schema import RATIO, MapData, what_lacks
from jaxgran.model.checks import InputError, refused, require_flag, require_whole
from jaxgran.model.choices import FileFormat
from jaxgran.plotting.against import averages_against_grains, ratio_against_timestep
from jaxgran.plotting.factors import NEEDED, enskog_factors
from jaxgran.plotting.ratio import ratio_contours, ratio_curves
from jaxgran.plotting.selection import points
from jaxgran.plotting.style import FILE_DPI, write
from jaxgran.plotting.theory import CLUSTERS, THEORY, cluster_shares, theory_errors

_LONGEST_NAME = 200  # bytes of a stem; file systems accept 255, with the rest of the name


class MapFigure(NamedTuple):
    """A figure of a map, the axes that need two values for it, and further variables."""

    draw: Callable[[MapData], Figure]
    several: tuple[str, ...] = ()
    needed: tuple[str, ...] = ()

    def is_possible(self, data: xr.Dataset) -> bool:
        """Whether a map has the data for it."""
        several = all(data.sizes[name] >= 2 for name in self.several)
        return several and not what_lacks(data, *RATIO, *self.needed)


FIGURES = {
    "curves": MapFigure(ratio_curves),
    "contours": MapFigure(ratio_contours, PLANE),
    "timestep": MapFigure(ratio_against_timestep, ("timestep",)),
    "size": MapFigure(averages_against_grains, ("grains",)),
    "theory": MapFigure(theory_errors, PLANE, THEORY),
    "factors": MapFigure(enskog_factors, ("packing_fraction",), NEEDED),
    "clusters": MapFigure(cluster_shares, needed=CLUSTERS),
}
"""All figures of a map by the ending of their files, in the order in which they are drawn."""


def figure_path(stem: Path, name: str, format: str) -> Path:
    """The file of an entry of ``FIGURES``."""
    return stem.with_name(f"{stem.name}_{name}.{format}")


def save_figures(
    data: MapData,
    stem: Path | str,
    format: FileFormat = "png",
    dpi: int = FILE_DPI,
    caption: bool = True,
    overwrite: bool = True,
) -> list[Path]:
    """Write every figure for which a map has the data, and return the paths written.

    Each file is written whole or not at all. The same map gives the same bytes.

    =======================  ==========================  ===========================================
    file                     function                    written if the map has
    =======================  ==========================  ===========================================
    `{stem}_curves.png`      `ratio_curves`              always
    `{stem}_contours.png`    `ratio_contours`            two restitutions and two packing fractions
    `{stem}_timestep.png`    `ratio_against_timestep`    two time steps
    `{stem}_size.png`        `averages_against_grains`   two numbers of grains
    `{stem}_theory.png`      `theory_errors`             as for the contours, and predictions
    `{stem}_factors.png`     `enskog_factors`            two packing fractions, and factors of the
                                                         error of the theory
    `{stem}_clusters.png`    `cluster_shares`            shares of clusters
    =======================  ==========================  ===========================================

    Args:
      data: as in :func:`ratio_curves` or :func:`ratio_against_timestep`.
      stem: folder, which must exist, and beginning of the names.
      format: "png", "pdf" or "svg", which is also the ending of the names.
      dpi: dots per inch of a PNG, 50 to 1200; the other formats have none.
      caption: whether the parameters of the run and the notes stand under the axes.
      overwrite: whether files that are there are replaced; otherwise they are kept.

    Raises:
      InputError: (a ValueError) the data are not a map, a choice is not one of these, or no files
        can be written there.
    """
    data = points(data, *RATIO)
    require_file(format, dpi)
    require_flag("overwrite", overwrite)
    stem = _writable(stem)
    possible = {
        figure_path(stem, name, format): figure.draw
        for name, figure in FIGURES.items()
        if figure.is_possible(data)
    }
    for path in possible:
        if path.is_dir():
            raise InputError(f"the figures must be files, and {str(path)!r} is a folder.")
    drawn = [path for path in possible if overwrite or not path.exists()]
    for path in drawn:
        write(possible[path](data), path, dpi, caption)
    return drawn


def _writable(stem: Path | str) -> Path:
    """Return folder and beginning of the names of figures; InputError if it cannot be written."""
    if not isinstance(stem, (str, os.PathLike)):
        raise refused("stem", stem, "must be folder and beginning of the file names")
    stem = Path(stem)
    if len(os.fsencode(stem.name)) > _LONGEST_NAME:
        raise refused("stem", stem.name, f"must have a name of at most {_LONGEST_NAME} bytes")
    if not os.path.isdir(stem.parent) or not os.access(stem.parent, os.W_OK):
        raise refused("stem", str(stem.parent), "must be in a folder that can be written to")
    return stem


def pictures_beside(path: Path) -> set[Path]:
    """The figures of a map that are beside its dataset, in whatever format."""
    stem = path.with_suffix("")
    names = {figure_path(stem, name, end) for name in FIGURES for end in get_args(FileFormat)}
    return set(filter(Path.is_file, names))


def require_file(format: Any, dpi: Any) -> None:
    """Raise an InputError unless figures can have this format and resolution."""
    if format not in get_args(FileFormat):
        raise refused("format", format, "must be png, pdf or svg")
    require_whole("dpi", dpi, 50, 1200, "as no print shows more")
