"""A quantity in the plane of 1 − α and ν: shades, labelled contours, and how far they can be wrong.

Between the points of a map a quantity is interpolated linearly in 1 − α and ν. Over an interval h
that is wrong by |f″| h² t (1 − t)/2 at a share t of it. The second derivative follows from how well
a point is interpolated from its two neighbours along an axis; the errors of both axes are added,
and the noise of the points is part of them. A cell is hatched if one of its corners has no value.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
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

from jaxgran.plotting.encoding import EXCESS_LEVELS
from jaxgran.plotting.selection import suspect
from jaxgran.plotting.style import ALPHA_LABEL, NU_LABEL, RING, SMALL_SIZE, padded

BINARY_EXCESS = EXCESS_LEVELS[0]
"""Excess of the force ratio up to which collisions count as binary in figures."""

Legend = dict[str, Artist]  # entries by their labels

_SUBDIVISIONS = 12  # steps of the interpolation between neighbouring points
_LINEAR_BELOW = 0.01  # excess below which its contour variable is linear, above it logarithmic
_LEAST_HALF_WIDTH = 1e-3  # of a band, in units of its field
_LEAST_ROOM = 0.045  # inches from a label to the next contour, or half of those to the frame
_LETTER = 0.078  # inches, width of a letter of a label
_RING_RADIUS = 0.09  # inches, from its middle to where a label may begin
_DOT: dict[str, Any] = {
    "linestyle": "none",
    "marker": "o",
    "color": "0.25",
    "markersize": 2,
    "markeredgewidth": 0,
    "label": "measured",
}
_CROSS: dict[str, Any] = {
    "linestyle": "none",
    "marker": "x",
    "color": "0.25",
    "markersize": 5,
    "label": "no value",
}
_HATCH: dict[str, Any] = {
    "facecolor": "none",
    "edgecolor": "0.75",
    "hatch": "/////",
    "linewidth": 0,
}
_BINARY: dict[str, Any] = {
    "color": "#00803c",
    "linewidth": 1.8,
    "label": f"force ratio {1 + BINARY_EXCESS:g}",
}
_INTERPOLATION = {"color": "#cde3ef", "label": "± interpolation"}
STANDARD_ERROR = {"color": "#f7d5a0", "label": "± standard error"}


# ----------------------------------------------------------------------------------------------
# interpolation


def contour_variable(excess: np.ndarray) -> np.ndarray:
    """Return asinh(excess/0.01): monotone, nearly logarithmic above 0.01, and defined below
    zero.
    """
    return np.arcsinh(excess / _LINEAR_BELOW)


def refined_axes(data: xr.Dataset) -> tuple[np.ndarray, np.ndarray]:
    """Return 1 − α and ν at the points of an interpolated field."""
    x, y = (_refinement(len(axis)) @ axis for axis in _axes(data))
    return x, y


def interpolated(field: np.ndarray) -> np.ma.MaskedArray:
    """Return a field interpolated linearly to a finer grid, masked where a missing point would
    contribute.
    """
    rows, columns = (_refinement(count) for count in field.shape)
    missing = ~np.isfinite(field)
    values = rows @ np.where(missing, 0.0, field) @ columns.T
    return np.ma.masked_array(values, mask=rows @ missing @ columns.T > 0.0)


def interpolation_error(data: xr.Dataset, field: np.ndarray) -> np.ndarray:
    """Return the estimated error of an interpolated field; zero at the points of the map.

    Along an axis of two points, and beside missing ones, no error can be estimated, and none is
    added.
    """
    x, y = _axes(data)
    rows, columns = (_refinement(count) for count in field.shape)
    return _error_along(y, field) @ columns.T + rows @ _error_along(x, field.T).T


def _axes(data: xr.Dataset) -> tuple[np.ndarray, np.ndarray]:
    return 1.0 - data.restitution.values, data.packing_fraction.values


def _refinement(count: int) -> np.ndarray:
    """Return the matrix (fine, count) of linear interpolation onto a subdivided axis."""
    position = np.linspace(0.0, count - 1.0, (count - 1) * _SUBDIVISIONS + 1)
    return np.maximum(0.0, 1.0 - np.abs(position[:, None] - np.arange(count)))


def _error_along(axis: np.ndarray, field: np.ndarray) -> np.ndarray:
    """Return the error (fine, others) of linear interpolation along the first axis."""
    steps = np.diff(axis)
    if len(steps) < 2:
        return np.zeros((_SUBDIVISIONS * len(steps) + 1, field.shape[1]))
    share = ((axis[1:-1] - axis[:-2]) / (axis[2:] - axis[:-2]))[:, None]
    left_out = (1.0 - share) * field[:-2] + share * field[2:] - field[1:-1]
    curvature = np.abs(left_out) / (steps[:-1] * steps[1:])[:, None]  # half the second derivative
    by_point = np.nan_to_num(curvature)[[0, *range(len(steps) - 1), -1]]
    by_interval = np.maximum(by_point[:-1], by_point[1:]) * steps[:, None] ** 2
    position = np.linspace(0.0, len(steps), _SUBDIVISIONS * len(steps) + 1)
    interval = np.minimum(position.astype(int), len(steps) - 1)
    along = (position - interval)[:, None]
    return by_interval[interval] * along * (1.0 - along)


# ----------------------------------------------------------------------------------------------
# contours


def draw_plane(
    axes: Axes,
    data: xr.Dataset,
    fields: Sequence[np.ndarray],
    levels: Mapping[str, float],
    shades: Any,
) -> Legend:
    """Draw shades and contours of a field (packing_fraction, restitution), and the points of a map.

    A contour has two bands: of the points where the field differs from its level by at most the
    standard error, and by at most the error of interpolation. It is dashed where its label is that
    of a decrease.

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
    (x, y), field, values = _axes(data), fields[0], list(levels.values())
    x_points, y_points = np.meshgrid(x, y)
    fine, (smooth, low, high) = refined_axes(data), map(interpolated, fields)
    axes.set(xlim=padded(x), ylim=padded(y))
    axes.contourf(*fine, smooth, [-1e9, *values, 1e9], colors=shades, zorder=1)
    legend: Legend = {}
    measured, bad = np.isfinite(field), suspect(data)
    for style, chosen in ((_DOT, measured), (_CROSS, ~measured), (RING, bad)):
        if chosen.any():
            legend[style["label"]] = Line2D([], [], **style)
            axes.plot(x_points[chosen], y_points[chosen], **style, zorder=4, clip_on=False)
    if np.ma.is_masked(smooth):
        area = Rectangle((x.min(), y.min()), np.ptp(x), np.ptp(y), **_HATCH, zorder=0.5)
        axes.add_patch(area)
    if smooth.count() and any(smooth.min() < value < smooth.max() for value in values):
        error = interpolation_error(data, field)
        legend |= _draw_band(axes, fine, smooth - error, smooth + error, values, _INTERPOLATION)
        legend |= _draw_band(axes, fine, low, high, values, STANDARD_ERROR)
        dashes = ["--" if label[0] in "−÷" else "-" for label in levels]
        style = {"colors": "black", "linewidths": 0.9, "linestyles": dashes, "zorder": 3}
        drawn = axes.contour(*fine, smooth, values, **style)
        _label(axes, drawn, list(levels), np.stack([x_points[bad], y_points[bad]], axis=-1))
    return legend


def _draw_band(
    axes: Axes,
    fine: tuple[np.ndarray, np.ndarray],
    low: np.ma.MaskedArray,
    high: np.ma.MaskedArray,
    levels: Sequence[float],
    style: dict[str, Any],
) -> Legend:
    """Shade where a level lies between bounds of a field; return the legend entry, if any does."""
    middle, half = (low + high) / 2, np.ma.maximum((high - low) / 2, 0.0)
    if not half.count() or half.max() <= _LEAST_HALF_WIDTH:
        return {}
    for level in levels:  # a narrow band has the width of its contour, rather than holes
        apart = (level - middle) / np.ma.maximum(half, _LEAST_HALF_WIDTH)
        if abs(apart).min() < 1.0:
            axes.contourf(*fine, apart, [-1.0, 1.0], colors=[style["color"]], zorder=2)
    return {style["label"]: Patch(**style)}


def draw_binary_limit(axes: Axes, data: xr.Dataset) -> Legend:
    """Draw where the excess of the force ratio is ``BINARY_EXCESS``, on top of another field."""
    level = contour_variable(np.array(BINARY_EXCESS))
    smooth = interpolated(contour_variable(data.force_ratio.values - 1.0))
    if not smooth.count() or not smooth.min() < level < smooth.max():
        return {}
    style = {"colors": _BINARY["color"], "linewidths": _BINARY["linewidth"], "zorder": 2.5}
    axes.contour(*refined_axes(data), smooth, [level], **style)
    return {_BINARY["label"]: Line2D([], [], **_BINARY)}


def label_axes(grid: np.ndarray) -> None:
    """Name the axes of panels (rows, columns) at the left and at the bottom."""
    for axes in grid[-1]:
        axes.set_xlabel(ALPHA_LABEL)
    for axes in grid[:, 0]:
        axes.set_ylabel(NU_LABEL)


def add_plane_legend(figure: Figure, legend: Legend) -> None:
    """Explain above the panels what is drawn in them."""
    if not legend:
        return
    rows = math.ceil(len(legend) / figure.get_figwidth())
    figure.legend(
        handles=list(legend.values()),
        loc="outside upper center",
        ncols=math.ceil(len(legend) / rows),
        handlelength=1.4,
        columnspacing=1.5,
    )


# ----------------------------------------------------------------------------------------------
# labels


def _label(axes: Axes, drawn: QuadContourSet, texts: list[str], avoided: np.ndarray) -> None:
    """Label each contour that has room for it."""
    places = _places(axes, drawn, [_LETTER * len(text) for text in texts], avoided)
    names = dict(zip(drawn.levels, texts, strict=True))
    for label in axes.clabel(
        drawn, fmt=names, fontsize=SMALL_SIZE, inline_spacing=2, manual=places, zorder=6
    ):
        label.set_path_effects([withStroke(linewidth=2, foreground="white")])


def _places(
    axes: Axes, drawn: QuadContourSet, lengths: list[float], avoided: np.ndarray
) -> Iterable[tuple[float, float]]:
    """Return where each contour has its label: as far from the others and the frame as it can.

    Contours with the least room come first. A contour has none where it is everywhere too close to
    others, to the frame, to another label or to a point that is to be avoided.
    """
    to_inches = axes.transData + axes.figure.dpi_scale_trans.inverted()
    (low, high), rings = axes.transAxes.transform([(0, 0), (1, 1)]), np.zeros((0, 2))
    low, high = axes.figure.dpi_scale_trans.inverted().transform([low, high])
    if len(avoided):
        rings = to_inches.transform(avoided)
    curves = [
        to_inches.transform(np.asarray(path.vertices)[:: 1 + len(path) // 200].reshape(-1, 2))
        for path in drawn.get_paths()
    ]
    clearances = []
    for k, curve in enumerate(curves):
        others = np.concatenate([np.full((1, 2), np.inf), *curves[:k], *curves[k + 1 :]])
        to_frame = np.minimum(curve - low, high - curve).min(axis=1)
        clear = np.minimum(_distance(curve, others), to_frame / 2)
        clear[_distance(curve, rings) < _RING_RADIUS + lengths[k] / 2] = 0.0
        clear[to_frame < 0.05 + lengths[k] / 2] = 0.0
        clearances.append(clear)
    placed, occupied, sizes = [], np.empty((0, 2)), np.empty(0)
    for k in sorted(range(len(curves)), key=lambda k: clearances[k].max(initial=0)):
        apart = np.linalg.norm(curves[k][:, None] - occupied, axis=-1) - (sizes + lengths[k]) / 2
        clear = np.where(apart.min(axis=1, initial=np.inf) > 0, clearances[k], 0)
        if clear.max(initial=0) > _LEAST_ROOM:
            best = curves[k][clear.argmax()]
            occupied, sizes = np.vstack([occupied, best]), np.append(sizes, lengths[k])
            placed.append(tuple(to_inches.inverted().transform(best)))
    return placed


def _distance(points: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return the distance of each point to the nearest of others."""
    return np.linalg.norm(points[:, None] - others, axis=-1).min(axis=1, initial=np.inf)
