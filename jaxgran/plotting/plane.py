"""A quantity in the plane of 1 − α and ν: shades, labelled contours, and bands of their errors.

Between the points of a map a quantity is interpolated linearly in 1 − α and ν. A cell is hatched if
one of its corners has no value.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.contour import QuadContourSet
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle
from matplotlib.patheffects import withStroke

from jaxgran.plotting.selection import suspect
from jaxgran.plotting.style import ALPHA_LABEL, INTERVAL_COLOUR, NU_LABEL, RING, SMALL_SIZE, padded

EXCESS_LEVELS = (0.05, 0.10, 0.25, 0.50, 1.00)
"""Contour values of the excess of the force ratio over one, as in Figure 2."""

BINARY_EXCESS = EXCESS_LEVELS[0]
"""Excess of the force ratio up to which collisions count as binary in figures."""

Legend = dict[str, Artist]  # entries by their labels

_SUBDIVISIONS = 12  # steps of the interpolation between neighbouring points
_LINEAR_BELOW = 0.01  # excess below which its contour variable is linear, above it logarithmic
_LEAST_HALF_WIDTH = 1e-3  # of a band, in units of its field
_LEAST_ROOM = 0.045  # inches from a label to the next contour and to the frame
_LETTER = 0.078  # inches, width of a letter of a label
_RING_RADIUS = 0.09  # inches, with some room
_POINT: dict[str, Any] = {"linestyle": "none", "color": "0.25"}
_DOT = _POINT | {"marker": "o", "markersize": 2, "markeredgewidth": 0, "label": "measured"}
_CROSS = _POINT | {"marker": "x", "markersize": 5, "label": "no value"}
_HATCH: dict[str, Any] = {
    "facecolor": "none",
    "edgecolor": "0.75",
    "hatch": "/////",
    "linewidth": 0,
}
_BINARY: dict[str, Any] = {"color": "#00803c", "linewidth": 1.8}
STANDARD_ERROR: dict[str, Any] = {"color": INTERVAL_COLOUR, "label": "± standard error"}


def contour_variable(excess: Any) -> np.ndarray:
    """Return asinh(excess/0.01): nearly logarithmic above 0.01, and defined below zero."""
    return np.arcsinh(np.divide(excess, _LINEAR_BELOW))


def refined(values: np.ndarray) -> np.ma.MaskedArray:
    """Return values of the points of a map, or of an axis, interpolated linearly to a finer grid;
    masked where a value is missing.
    """
    for axis, count in enumerate(values.shape):
        fine = np.arange((count - 1) * _SUBDIVISIONS + 1) / _SUBDIVISIONS
        values = np.apply_along_axis(partial(np.interp, fine, np.arange(count)), axis, values)
    return np.ma.masked_invalid(values)


def draw_plane(
    axes: Axes,
    data: xr.Dataset,
    fields: Sequence[np.ndarray],
    levels: Mapping[str, float],
    shades: Any,
) -> Legend:
    """Draw shades and contours of a field (packing_fraction, restitution), and the points of a map.

    The band of a contour has the points where the field differs from its level by at most the
    standard error. A contour is dashed where its label is that of a decrease.

    Args:
      axes: an empty panel.
      data: the map, with the axes and the status of the points.
      fields: values at the points, NaN where there is none, and those less and plus a standard
        error.
      levels: increasing values of contours by their labels.
      shades: a colour for each interval between levels, and for those below and above.

    Returns:
      The legend entries of what is drawn.
    """
    x, y = 1.0 - data.restitution.values, data.packing_fraction.values
    points, values = np.stack(np.meshgrid(x, y)), list(levels.values())
    fine, (smooth, low, high) = (refined(x), refined(y)), map(refined, fields)
    axes.set(xlim=padded(x), ylim=padded(y), xlabel=ALPHA_LABEL, ylabel=NU_LABEL)
    axes.contourf(*fine, smooth, [-1e9, *values, 1e9], colors=shades, zorder=1)
    legend: Legend = {}
    measured, bad = np.isfinite(fields[0]), suspect(data)
    for style, chosen in ((_DOT, measured), (_CROSS, ~measured), (RING, bad)):
        if chosen.any():
            legend[style["label"]] = Line2D([], [], **style)
            axes.plot(*points[:, chosen], **style, zorder=4, clip_on=False)
    if np.ma.is_masked(smooth):
        area = Rectangle((x.min(), y.min()), np.ptp(x), np.ptp(y), **_HATCH, zorder=0.5)
        axes.add_patch(area)
    if smooth.count() and any(smooth.min() < value < smooth.max() for value in values):
        legend |= _draw_bands(axes, fine, low, high, values)
        dashes = ["--" if label[0] in "−÷" else "-" for label in levels]
        style = {"colors": "black", "linewidths": 0.9, "linestyles": dashes, "zorder": 3}
        _label(axes, axes.contour(*fine, smooth, values, **style), list(levels), points[:, bad].T)
    return legend


def _draw_bands(
    axes: Axes,
    fine: tuple[np.ndarray, np.ndarray],
    low: np.ma.MaskedArray,
    high: np.ma.MaskedArray,
    levels: Sequence[float],
) -> Legend:
    """Shade where a level lies between bounds of a field; return the legend entry, if any does."""
    middle, half = (low + high) / 2, np.ma.maximum((high - low) / 2, 0.0)
    if not half.count() or half.max() <= _LEAST_HALF_WIDTH:
        return {}
    for level in levels:  # a narrow band has the width of its contour, rather than holes
        apart = (level - middle) / np.ma.maximum(half, _LEAST_HALF_WIDTH)
        if abs(apart).min() < 1.0:
            axes.contourf(*fine, apart, [-1.0, 1.0], colors=[INTERVAL_COLOUR], zorder=2)
    return {STANDARD_ERROR["label"]: Patch(**STANDARD_ERROR)}


def draw_binary_limit(axes: Axes, data: xr.Dataset) -> Legend:
    """Draw where the excess of the force ratio is ``BINARY_EXCESS``, on top of another field."""
    x, y = 1.0 - data.restitution.values, data.packing_fraction.values
    smooth = refined(contour_variable(data.force_ratio.values - 1.0))
    level, label = contour_variable(BINARY_EXCESS), f"force ratio {1 + BINARY_EXCESS:g}"
    if not smooth.count() or not smooth.min() < level < smooth.max():
        return {}
    style = {f"{name}s": value for name, value in _BINARY.items()}
    axes.contour(refined(x), refined(y), smooth, [level], **style, zorder=2.5)
    return {label: Line2D([], [], **_BINARY, label=label)}


def add_plane_legend(figure: Figure, legend: Legend) -> None:
    """Explain above the panels what is drawn in them."""
    rows = math.ceil(len(legend) / figure.get_figwidth())
    if rows:
        figure.legend(
            handles=list(legend.values()),
            loc="outside upper center",
            ncols=math.ceil(len(legend) / rows),
            handlelength=1.4,
            columnspacing=1.5,
        )


def _label(axes: Axes, drawn: QuadContourSet, texts: list[str], rings: np.ndarray) -> None:
    """Label each contour where it is farthest from the others and the frame, and not at a ring.

    Contours with the least room come first; one without room has no label.
    """
    to_inches = axes.transData - axes.figure.dpi_scale_trans
    low, high = (axes.transAxes - axes.figure.dpi_scale_trans).transform([(0, 0), (1, 1)])
    rings, labels = to_inches.transform(rings.reshape(-1, 2)), np.empty((0, 2))
    vertices = (np.reshape(path.vertices, (-1, 2)) for path in drawn.get_paths())
    curves = [to_inches.transform(points[:: 1 + len(points) // 200]) for points in vertices]
    halves = [_LETTER * len(text) / 2 for text in texts]
    rooms = []
    for k, (curve, half) in enumerate(zip(curves, halves, strict=True)):
        others = np.concatenate([labels, *curves[:k], *curves[k + 1 :]])
        to_frame = np.minimum(curve - low, high - curve).min(axis=1)
        fits = (to_frame > half + _LEAST_ROOM) & (_distance(curve, rings) > half + _RING_RADIUS)
        rooms.append(np.where(fits, np.minimum(_distance(curve, others), to_frame / 2), 0.0))
    for k in sorted(range(len(curves)), key=lambda k: rooms[k].max(initial=0)):
        free = _distance(curves[k], labels) > halves[k] + max(halves)
        room = np.where(free, rooms[k], 0.0)
        if room.max(initial=0) > _LEAST_ROOM:
            labels = np.vstack([labels, curves[k][room.argmax()]])
    places = list(map(tuple, to_inches.inverted().transform(labels)))
    names = dict(zip(drawn.levels, texts, strict=True))
    style = {"fontsize": SMALL_SIZE, "inline_spacing": 2, "zorder": 6}
    for label in axes.clabel(drawn, fmt=names, manual=places, **style):
        label.set_path_effects([withStroke(linewidth=2, foreground="white")])


def _distance(points: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return the distance of each point to the nearest of others."""
    return np.linalg.norm(points[:, None] - others, axis=-1).min(axis=1, initial=np.inf)
