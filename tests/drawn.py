"""What a figure shows: its texts, and its contours as numbers."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.colors import same_color
from matplotlib.contour import QuadContourSet
from matplotlib.figure import Figure

from jaxgran.plotting import map_figures


def legend_texts(figure: Figure) -> list[str]:
    return [text.get_text() for legend in figure.legends for text in legend.get_texts()]


def caption(figure: Figure) -> str:
    return figure.get_supxlabel()


def write_without_drawing(patch: pytest.MonkeyPatch) -> None:
    """Pictures are files of a few bytes, for tests of which files are written."""
    patch.setattr(map_figures, "write", lambda _, path, *__: Path(path).write_bytes(b"a picture"))


class ContourLine(NamedTuple):
    """A contour as drawn: its vertices (points, 2), its style and its labels."""

    vertices: np.ndarray
    dashed: bool
    width: float
    labels: list[str]


def contour_lines(axes: Axes, colour: str) -> dict[float, ContourLine]:
    """Return the contours of a colour, by their level; a short one may be all under its label."""
    lines = {}
    for drawn in axes.collections:
        if not isinstance(drawn, QuadContourSet) or drawn.filled or not same_color(colour_of(drawn), colour):
            continue
        labels = list(zip(drawn.labelCValues, (text.get_text() for text in drawn.labelTexts), strict=True))
        widths, dashes = np.atleast_1d(drawn.get_linewidth()), drawn.get_linestyle()
        for number, (level, path) in enumerate(zip(drawn.levels, drawn.get_paths(), strict=True)):
            own = [text for of, text in labels if of == number]
            if len(path) or own:
                dashed = dashes[number][1] is not None
                lines[float(level)] = ContourLine(np.asarray(path.vertices), dashed, widths[number], own)
    return lines


def colour_of(drawn: QuadContourSet) -> np.ndarray:
    """Return the colour of the first of several contours, without its transparency."""
    return np.atleast_2d(drawn.get_edgecolor())[0, :3]
