"""Contours in the plane of 1 − α and ν: levels, labels that do not overlap, and the excess on top.

A quantity is interpolated between the grid points of a map. A cell is hatched if one of its corners has no value.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple, TypeVar

import numpy as np
import xarray as xr
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.contour import QuadContourSet
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from matplotlib.path import Path as MplPath
from matplotlib.patheffects import withStroke
from matplotlib.text import Text

from jaxgran.plotting.drawing import SMALL_SIZE, mark_bad, padded, ring_key, suspect
from jaxgran.plotting.encoding import EXCESS_LEVELS
from jaxgran.plotting.interpolation import interpolated, refined_axes

_EXCESS_COLOUR = "#00803c"
_EXCESS_STYLE: dict[str, Any] = {"alpha": 0.75, "zorder": 2.5}
_LINEAR_BELOW = 0.01  # excess below which its contour variable is linear, above which it is logarithmic
_LABEL_SPACE = 1.44  # points between a label and its contour
_LABEL_DISTANCE = 28.0  # points between the middles of two labels, slightly more than the length of a label
_DOT: dict[str, Any] = {"linestyle": "none", "marker": "o", "color": "0.25", "markersize": 2, "markeredgewidth": 0}
_CROSS: dict[str, Any] = {"linestyle": "none", "marker": "x", "color": "0.25", "markersize": 5}

_Key = TypeVar("_Key", str, float)


class Line(NamedTuple):
    """The contour of one value, which is drawn together with those of others and counted among them."""

    drawn: QuadContourSet
    number: int
    value: float

    @property
    def path(self) -> MplPath:
        return self.drawn.get_paths()[self.number]


# ----------------------------------------------------------------------------------------------- plane


def contour_variable(excess: np.ndarray) -> np.ndarray:
    """Return asinh(excess/0.01): monotone, nearly logarithmic above 0.01, and defined below zero."""
    return np.arcsinh(excess / _LINEAR_BELOW)


def excess_field(data: xr.Dataset) -> np.ma.MaskedArray:
    """Return the contour variable of the excess of the force ratio, interpolated."""
    return interpolated(contour_variable(data.force_ratio.values - 1.0))


EXCESS_VALUES = {level: float(contour_variable(np.array(level))) for level in EXCESS_LEVELS}
"""The contour variable at the levels of the excess."""


def draw_levels(
    axes: Axes, x: np.ndarray, y: np.ndarray, field: np.ma.MaskedArray, levels: Mapping[_Key, float], **styles: Any
) -> dict[_Key, Line]:
    """Draw the contours of a field at increasing values, in one style or one for each; return those that there are."""
    low, high = (field.min(), field.max()) if field.count() else (0.0, 0.0)
    crossed = [low < value < high for value in levels.values()]
    if not any(crossed):
        return {}
    drawn = axes.contour(x, y, field, list(levels.values()), **styles)
    lines = {key: Line(drawn, number, value) for number, (key, value) in enumerate(levels.items()) if crossed[number]}
    return {key: line for key, line in lines.items() if len(line.path)}


def draw_plane(axes: Axes, data: xr.Dataset, field: np.ma.MaskedArray, measured: np.ndarray) -> None:
    """Hatch the area without interpolated values, and draw measured points as dots and missing ones as crosses.

    Points whose status is not `ok` get a ring.
    """
    x, y = 1.0 - data.restitution.values, data.packing_fraction.values
    if np.ma.is_masked(field):
        area = Rectangle((x.min(), y.min()), np.ptp(x), np.ptp(y))
        area.set(facecolor="none", edgecolor="0.75", hatch="/////", linewidth=0.0, zorder=0.5)
        axes.add_patch(area)
    axes.set_xlim(padded(x))
    axes.set_ylim(padded(y))
    x, y = np.meshgrid(x, y)
    axes.plot(x[measured], y[measured], **_DOT, zorder=4)
    axes.plot(x[~measured], y[~measured], **_CROSS, zorder=4)
    bad = suspect(data)
    mark_bad(axes, x[bad], y[bad], clip_on=False)


def add_plane_legend(figure: Figure, data: xr.Dataset, measured: np.ndarray, entries: Iterable[Artist] = ()) -> None:
    """Explain above the axes the symbols that occur in a plane. Further entries stand between the dot and the ring."""
    dot, cross = Line2D([], [], **_DOT, label="measured"), Line2D([], [], **_CROSS, label="no value")
    handles = [dot] * bool(measured.any()) + list(entries)
    handles += [ring_key()] * bool(suspect(data).any()) + [cross] * (not measured.all())
    figure.legend(
        handles=handles,
        loc="outside upper center",
        ncols=len(handles) if len(handles) <= figure.get_figwidth() else math.ceil(len(handles) / 2),
        fontsize=SMALL_SIZE,
        frameon=False,
        handlelength=1.2,
        columnspacing=1.5,
    )


# ---------------------------------------------------------------------------------------------- labels


def label_contours(
    axes: Axes,
    lines: Mapping[str, Line],
    obstacles: Iterable[Line] = (),
    room: float = 0.0,
) -> None:
    """Write a label on each contour, where it is farthest from other lines, labels, ends of lines and the frame.

    The layout must be fixed, so that distances on the page are known. A contour with less clearance than `room` points
    at its best place gets no label.
    """
    to_page, pixels = axes.transData, axes.figure.dpi / 72.0  # pixels of a typographic point
    paths = [to_page.transform_path(line.path) for line in lines.values()]
    blocked = [_thinned(to_page.transform_path(line.path)) for line in obstacles]
    labelled: list[np.ndarray] = []
    for k, (text, line) in enumerate(lines.items()):
        others = [_thinned(path) for path in paths[:k] + paths[k + 1 :]] + [path for path in blocked if len(path)]
        frame = np.array(axes.bbox.extents)
        place, clearance = _label_place(paths[k], others, labelled, _LABEL_DISTANCE * pixels, frame)
        if clearance < room * pixels:
            continue
        labelled.append(place)
        x, y = to_page.inverted().transform(place)
        label = line.drawn.clabel(
            [line.value],
            fontsize=SMALL_SIZE + 0.5,
            fmt={line.value: text},
            inline_spacing=_LABEL_SPACE * pixels,
            manual=[(float(x), float(y))],
            zorder=6,
        )[-1]
        label.set_path_effects([withStroke(linewidth=2, foreground="white")])
        _move_inside(label, axes)


def _move_inside(label: Text, axes: Axes) -> None:
    """Move a label that reaches over the frame into it."""
    box, frame = (np.reshape(one.extents, (2, 2)) for one in (label.get_window_extent(), axes.bbox))
    over = np.maximum(0.0, frame[0] - box[0]) - np.maximum(0.0, box[1] - frame[1])
    if over.any():
        place = axes.transData.transform(label.get_position()) + over
        x, y = axes.transData.inverted().transform(place)
        label.set_position((float(x), float(y)))


def _thinned(path: MplPath) -> np.ndarray:
    """Return at most 400 vertices of a path, at equal intervals."""
    return np.asarray(path.vertices)[:: 1 + len(path) // 400]


def _label_place(
    path: MplPath, others: Sequence[np.ndarray], labelled: Sequence[np.ndarray], distance: float, frame: np.ndarray
) -> tuple[np.ndarray, float]:
    """Return the vertex of a path with the largest clearance, and that clearance, both in pixels.

    A label lies along its curve, so the ends of the curve and the frame must be twice as far away as other curves.
    Places closer than `distance` to another label are used only if there is no other place.
    """
    places = _thinned(path)
    starts = np.flatnonzero(path.codes == MplPath.MOVETO)
    ends = np.asarray(path.vertices)[np.concatenate([starts, starts - 1])]
    to_frame = np.minimum(places - frame[:2], frame[2:] - places).min(axis=1)
    clearances = [to_frame / 2, _distance(places, ends) / 2, *(_distance(places, other) for other in others)]
    clearance = np.minimum.reduce(clearances)
    for label in labelled:
        clearance[np.linalg.norm(places - label, axis=1) < distance] *= 1e-3
    best = np.argmax(clearance)
    return places[best], float(clearance[best])


def _distance(places: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return the distance from each place to the nearest of the others."""
    x, y = (np.subtract.outer(places[:, axis], others[:, axis]) for axis in (0, 1))
    return np.sqrt((x * x + y * y).min(axis=1))


# ---------------------------------------------------------------------------------------------- excess


def draw_excess(axes: Axes, data: xr.Dataset) -> dict[float, Line]:
    """Draw the contours of the excess of the force ratio on top of another field, wider for a larger excess."""
    x, y = refined_axes(data)
    widths = [_excess_width(level) for level in EXCESS_LEVELS]
    style = {"colors": _EXCESS_COLOUR, "linewidths": widths, **_EXCESS_STYLE}
    return draw_levels(axes, x, y, excess_field(data), EXCESS_VALUES, **style)


def excess_style(level: float) -> dict[str, Any]:
    """Return the style of a line that stands for the contour of an excess."""
    return {"color": _EXCESS_COLOUR, "linewidth": _excess_width(level), **_EXCESS_STYLE}


def excess_keys(levels: Iterable[float]) -> list[Artist]:
    """Return the legend entries of the contours of the excess."""
    return [
        Line2D([], [], label=f"{'excess ' * (k == 0)}{level:.2f}", **excess_style(level))
        for k, level in enumerate(levels)
    ]


def _excess_width(level: float) -> float:
    """Return the width of the contour of an excess, in points."""
    return 0.8 + 0.5 * EXCESS_LEVELS.index(level)
