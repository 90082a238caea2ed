"""The effect of the number of grains: averages of a map against N, relative to those at its largest
N.
"""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FixedLocator, NullLocator, StrMethodFormatter

from jaxgran.maps.schema import RATIO, MapData, finest, require_map
from jaxgran.model.checks import InputError
from jaxgran.plotting.drawing import (
    LABEL_SIZE,
    RATIO_LABEL,
    TICK_SIZE,
    TWO_COLUMNS,
    add_curve_legend,
    curve_key,
    curve_styles,
    draw_points,
    empty_figure,
    finish,
    missing_note,
    ordered,
    status_note,
    suspect,
)
from jaxgran.plotting.ratio import MOST_TOGETHER, point_panels

_MOST_NUMBERS = 3  # at the axis of N
_MOST_ROWS = 6  # packing fractions with panels of their own
_QUANTITIES = {
    "pressure": r"pressure $p$",
    "shear_stress": r"shear stress $\tau$",
    "granular_temperature": "granular temperature $T$",
    "force_ratio": RATIO_LABEL,
}


def averages_against_grains(data: MapData) -> Figure:
    """Return pressure, shear stress, granular temperature and force ratio against the number of
    grains.

    Each average is divided by its value at the largest number of grains N. Every restitution and
    packing fraction has a curve. Up to eight curves share the panels. With more, each packing
    fraction has a row of panels: at most six of these, and eight restitutions, evenly chosen.

    Args:
      data: a map with a dimension `grains`, with `force_ratio` and any of `pressure`,
        `shear_stress` and `granular_temperature`, their `_stderr`, and `status`. The shortest of
        several time steps is drawn.

    Returns:
      Error bars are one standard error of the quotient, from those of both values; the last
      quotient is one, without an error. A point whose status is not `ok` is an open symbol in a
      ring.

    Raises:
      InputError: (a ValueError) fewer than two numbers of grains.
    """
    data = require_map(data, *RATIO)
    sizes = data.sizes.get("grains", 1)
    if sizes < 2:
        raise InputError(
            f"this figure needs at least two numbers of grains, and this map has {sizes}."
        )
    data, left_out = _thinned(finest(ordered(data, *_QUANTITIES), "timestep"))
    names = [name for name in _QUANTITIES if name in data and f"{name}_stderr" in data]
    panels, title = point_panels(data)
    figure = empty_figure(TWO_COLUMNS, height=3.0 if len(panels) == 1 else 0.8 + 1.5 * len(panels))
    grid = figure.subplots(len(panels), len(names), sharex=True, squeeze=False)
    handles: list[Line2D] = []
    for row, (words, curves) in zip(grid, panels, strict=True):
        styles = curve_styles(len(curves))
        handles = [
            curve_key(style, label) for (label, _), style in zip(curves, styles, strict=True)
        ]
        for axes, name in zip(row, names, strict=True):
            axes.axhline(1.0, color="0.6", linewidth=0.8, zorder=0)
            for (_, curve), style in zip(curves, styles, strict=True):
                _draw_curve(axes, curve, name, style)
        row[0].set_ylabel(words, fontsize=LABEL_SIZE)
    for axes, name in zip(grid[0], names, strict=True):
        axes.set_title(_QUANTITIES[name], fontsize=TICK_SIZE)
    for axes in grid[-1]:
        axes.set_xlabel("number of grains $N$", fontsize=LABEL_SIZE)
    _set_size_scale(grid[0, 0], data.grains.values)
    figure.supylabel(f"value / value at $N={data.grains.values[-1]}$", fontsize=LABEL_SIZE)
    add_curve_legend(figure, data, handles, title)
    measured = np.isfinite(data.force_ratio.values)
    finish(figure, data, measured, [left_out, status_note(data), missing_note(measured)])
    return figure


def _thinned(data: xr.Dataset) -> tuple[xr.Dataset, str]:
    """Return a map whose curves fit the figure, and a line that tells of what there were more."""
    words = []
    for name, most in (("restitution", MOST_TOGETHER), ("packing_fraction", _MOST_ROWS)):
        count = data.sizes[name]
        if (
            data.sizes["restitution"] * data.sizes["packing_fraction"] > MOST_TOGETHER
            and count > most
        ):
            data = data.isel({name: np.linspace(0, count - 1, most).round().astype(int)})
            words.append(f"{most} of {count} {name.replace('_', ' ')}s")
    return data, ", ".join(words)


def _draw_curve(axes: Axes, curve: xr.Dataset, name: str, style: dict) -> None:
    """Draw one average over its value at the largest number of grains, with error bars and suspect
    points.
    """
    value, stderr = curve[name].values, curve[f"{name}_stderr"].values
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio, relative = value / value[-1], stderr / abs(value)
    error = abs(ratio) * np.hypot(relative, relative[-1])
    error[-1] = 0.0  # of a value over itself
    draw_points(axes, curve.grains.values, ratio, suspect(curve), style, yerr=error)


def _set_size_scale(axes: Axes, grains: np.ndarray) -> None:
    """Make the axis of the number of grains logarithmic, with the sizes of the map as its
    numbers.
    """
    axes.set_xscale("log")
    margin = (grains[-1] / grains[0]) ** 0.08
    axes.set_xlim(grains[0] / margin, grains[-1] * margin)
    axes.xaxis.set_major_locator(FixedLocator(grains.tolist(), nbins=_MOST_NUMBERS))
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.xaxis.set_minor_locator(NullLocator())
