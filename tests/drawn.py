"""What a figure shows: its contours as numbers."""

from pathlib import Path

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.colors import same_color
from matplotlib.contour import QuadContourSet
from matplotlib.figure import Figure

from jaxgran.plotting import map_figures


def caption(figure: Figure) -> str:
    return figure.get_supxlabel()


def write_without_drawing(patch: pytest.MonkeyPatch) -> None:
    """Pictures are files of a few bytes, for tests of which files are written."""
    patch.setattr(map_figures, "write", lambda _, path, *__: Path(path).write_bytes(b"a picture"))


def contour_lines(axes: Axes, colour: str) -> dict[float, np.ndarray]:
    """Return the vertices (points, 2) of the contours of a colour, by their level."""
    lines = {}
    for drawn in axes.collections:
        if (
            isinstance(drawn, QuadContourSet)
            and not drawn.filled
            and same_color(colour_of(drawn), colour)
        ):
            paths = zip(drawn.levels, drawn.get_paths(), strict=True)
            lines |= {float(level): np.asarray(path.vertices) for level, path in paths if len(path)}
    return lines


def colour_of(drawn: QuadContourSet) -> np.ndarray:
    """Return the colour of the first of several contours, without its transparency."""
    return np.atleast_2d(drawn.get_edgecolor())[0, :3]
