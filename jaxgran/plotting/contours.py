"""Contours in the plane of 1 − α and ν, and those of the excess on top.

A quantity is interpolated between the grid points of a map. A cell is hatched if one of its corners
has no value.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any, TypeVar

import numpy as np
import xarray as xr
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.contour import QuadContourSet
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from matplotlib.patheffects import withStroke

from jaxgran.plotting.drawing import SMALL_SIZE, mark_bad, padded, ring_key, suspect
from jaxgran.plotting.encoding import EXCESS_LEVELS
from jaxgran.plotting.interpolation import interpolated, refined_axes

_EXCESS_COLOUR = "#00803c"
_EXCESS_STYLE: dict[str, Any] = {"alpha": 0.75, "zorder": 2.5}
_LEAST_ROOM = 0.045  # inches from a label to the next contour, or half of those to the frame
_LETTER = 0.078  # inches, width of a letter of a label
_LINEAR_BELOW = (
    0.01  # excess below which its contour variable is linear, above which it is logarithmic
)
_DOT: dict[str, Any] = {
    "linestyle": "none",
    "marker": "o",
    "color": "0.25",
    "markersize": 2,
    "markeredgewidth": 0,
}
_CROSS: dict[str, Any] = {"linestyle": "none", "marker": "x", "color": "0.25", "markersize": 5}

_Key = TypeVar("_Key", str, float)


# -----------------------------------------------------------------------------------------------
# plane


def contour_variable(excess: np.ndarray) -> np.ndarray:
    """Return asinh(excess/0.01): monotone, nearly logarithmic above 0.01, and defined below
    zero.
    """
    return np.arcsinh(excess / _LINEAR_BELOW)


def excess_field(data: xr.Dataset) -> np.ma.MaskedArray:
    """Return the contour variable of the excess of the force ratio, interpolated."""
    return interpolated(contour_variable(data.force_ratio.values - 1.0))


EXCESS_VALUES = {level: float(contour_variable(np.array(level))) for level in EXCESS_LEVELS}
"""The contour variable at the levels of the excess."""


def draw_levels(
    axes: Axes,
    x: np.ndarray,
    y: np.ndarray,
    field: np.ma.MaskedArray,
    levels: Mapping[_Key, float],
    labelled: bool = True,
    **styles: Any,
) -> list[_Key]:
    """Draw the contours of a field at increasing values, with their keys as labels; return the keys
    of those drawn.

    A contour has no label if it is everywhere too close to others, to the frame or to another
    label.
    """
    low, high = (field.min(), field.max()) if field.count() else (0.0, 0.0)
    crossed = [key for key, value in levels.items() if low < value < high]
    if not crossed:
        return []
    drawn = axes.contour(x, y, field, list(levels.values()), **styles)
    if labelled:
        texts = {
            value: key if isinstance(key, str) else f"{key:.2f}" for key, value in levels.items()
        }
        places = _label_places(axes, drawn, x, y, [_LETTER * len(text) for text in texts.values()])
        for label in axes.clabel(
            drawn, fmt=texts, fontsize=SMALL_SIZE + 0.5, inline_spacing=2, manual=places, zorder=6
        ):
            label.set_path_effects([withStroke(linewidth=2, foreground="white")])
    return crossed


def _label_places(
    axes: Axes, drawn: QuadContourSet, x: np.ndarray, y: np.ndarray, lengths: list[float]
) -> list[tuple[float, float]]:
    """Return where each contour with room for a label has it: as far from the others and the frame
    as it can.

    Lengths are in inches, before the panel has its final size. Contours with the least room have
    their labels first. Middles of labels are as far apart as the mean of their lengths, so that
    they do not touch in whatever directions.
    """
    corner, scale = np.array([x.min(), y.min()]), np.array([np.ptp(x), np.ptp(y)])
    scale = scale / (np.array(axes.bbox.size) / axes.figure.dpi)
    end = np.array([np.ptp(x), np.ptp(y)]) / scale
    curves = [
        (np.asarray(path.vertices) - corner)[:: 1 + len(path) // 200] / scale
        for path in drawn.get_paths()
    ]
    clearances = []
    for k, curve in enumerate(curves):
        others = np.concatenate([np.full((1, 2), np.inf), *curves[:k], *curves[k + 1 :]])
        apart = np.linalg.norm(curve[:, None] - others, axis=-1).min(axis=1, initial=np.inf)
        clearances.append(np.minimum(apart, np.minimum(curve, end - curve).min(axis=1) / 2))
    places, placed = np.empty((0, 2)), np.empty(0)
    for k in sorted(range(len(curves)), key=lambda k: clearances[k].max(initial=0)):
        between = np.linalg.norm(curves[k][:, None] - places, axis=-1) - (placed + lengths[k]) / 2
        clearance = np.where(between.min(axis=1, initial=np.inf) > 0, clearances[k], 0)
        if clearance.max(initial=0) > _LEAST_ROOM:
            places, placed = (
                np.vstack([places, curves[k][clearance.argmax()]]),
                np.append(placed, lengths[k]),
            )
    return [tuple(place) for place in corner + scale * places]


def draw_plane(
    axes: Axes, data: xr.Dataset, field: np.ma.MaskedArray, measured: np.ndarray
) -> None:
    """Hatch the area without interpolated values, and draw measured points as dots and missing ones
    as crosses.

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


def add_plane_legend(
    figure: Figure, data: xr.Dataset, measured: np.ndarray, entries: Iterable[Artist] = ()
) -> None:
    """Explain above the axes the symbols that occur in a plane. Further entries stand between the
    dot and the ring.
    """
    dot, cross = (
        Line2D([], [], **_DOT, label="measured"),
        Line2D([], [], **_CROSS, label="no value"),
    )
    handles = [dot] * bool(measured.any()) + list(entries)
    handles += [ring_key()] * bool(suspect(data).any()) + [cross] * (not measured.all())
    figure.legend(
        handles=handles,
        loc="outside upper center",
        ncols=len(handles)
        if len(handles) <= figure.get_figwidth()
        else math.ceil(len(handles) / 2),
        fontsize=SMALL_SIZE,
        frameon=False,
        handlelength=1.2,
        columnspacing=1.5,
    )


# ----------------------------------------------------------------------------------------------
# excess


def draw_excess(axes: Axes, data: xr.Dataset) -> list[float]:
    """Draw the contours of the excess of the force ratio on top of another field, wider for a
    larger excess.
    """
    x, y = refined_axes(data)
    widths = [_excess_width(level) for level in EXCESS_LEVELS]
    style = {"colors": _EXCESS_COLOUR, "linewidths": widths, **_EXCESS_STYLE}
    return draw_levels(axes, x, y, excess_field(data), EXCESS_VALUES, labelled=False, **style)


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
