"""What a measurement depends on beside α and ν: force ratio against the time step, averages against
the number of grains.
"""

from __future__ import annotations

import math

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullLocator, StrMethodFormatter

from jaxgran.maps.schema import RATIO, MapData, require_map
from jaxgran.model.checks import InputError
from jaxgran.plotting.ratio import set_ratio_scale
from jaxgran.plotting.selection import describe, selection, suspect
from jaxgran.plotting.style import (
    ALPHA_TITLE,
    RATIO_LABEL,
    TWO_COLUMNS,
    add_curve_legend,
    curve_styles,
    draw_points,
    draw_reference,
    empty_figure,
    label_log_axis,
    styled,
)

MOST_CURVES = 6  # of a panel
_MOST_PANELS = 6  # packing fractions of the figure against the time step
_QUANTITIES = {
    "pressure": "pressure",
    "granular_temperature": "granular temperature",
    "force_ratio": RATIO_LABEL,
}


@styled
def ratio_against_timestep(data: MapData) -> Figure:
    """Return the force ratio against the time step, a curve for each restitution and packing
    fraction.

    Up to six curves share one panel. Otherwise each packing fraction has a panel: at most six
    panels with six restitutions, evenly chosen.

    Args:
      data: as in :func:`ratio_curves`, with a dimension `timestep` in units of 1/γ̇.

    Returns:
      Error bars are one standard error; a point whose status is not `ok` is an open symbol in a
      ring.

    Raises:
      InputError: (a ValueError) fewer than two time steps.
    """
    _require_several(data, "timestep", "time steps")
    data = selection(data, along="timestep")
    together = data.sizes["restitution"] * data.sizes["packing_fraction"] <= MOST_CURVES
    data, chosen = _thinned(data, MOST_CURVES, _MOST_PANELS)
    panels = (
        [data]
        if together
        else [data.isel(packing_fraction=[k]) for k in range(data.sizes["packing_fraction"])]
    )
    columns = math.ceil(math.sqrt(len(panels)))
    rows = math.ceil(len(panels) / columns)
    figure = empty_figure(TWO_COLUMNS, height=2.7 if together else 0.5 + 1.5 * rows)
    grid = list(figure.subplots(rows, columns, sharex=True, squeeze=False).flat)
    for axes, panel in zip(grid, panels, strict=False):
        _draw_curves(axes, panel, "timestep", "force_ratio")
        set_ratio_scale(axes, panel.force_ratio.values)
        axes.set_title("" if together else rf"$\nu={panel.packing_fraction.item():.4g}$")
    for axes in grid[len(panels) :]:
        axes.remove()
    for axes in grid[max(0, len(panels) - columns) : len(panels)]:
        axes.tick_params(labelbottom=True)
        axes.set_xlabel(r"time step $\dot{\gamma}\,\mathrm{d}t$")
    label_log_axis(grid[0].xaxis, most=9 if columns == 1 else 3)
    figure.supylabel(RATIO_LABEL)
    labels, title = _names(panels[0], together)
    add_curve_legend(figure, labels, title, suspect(data).any())
    describe(figure, data, "Force ratio against the time step, with standard errors", chosen)
    return figure


@styled
def averages_against_grains(data: MapData) -> Figure:
    """Return pressure, granular temperature and force ratio against the number of grains.

    Each average is divided by its value at the largest number of grains N. Every restitution and
    packing fraction has a curve; of more than six, at most six are chosen evenly.

    Args:
      data: a map with a dimension `grains`, with `force_ratio` and any of `pressure` and
        `granular_temperature`, their `_stderr`, and `status`. The shortest of several time steps is
        drawn.

    Returns:
      Error bars are the standard error of each value, also of the one at the largest N, in units of
      that one. A point whose status is not `ok` is an open symbol in a ring. Symbols of different
      curves are moved apart a little.

    Raises:
      InputError: (a ValueError) fewer than two numbers of grains.
    """
    flat = _require_several(data, "grains", "numbers of grains")
    names = [name for name in _QUANTITIES if name in flat and f"{name}_stderr" in flat]
    alphas = min(flat.sizes["restitution"], max(3, MOST_CURVES // flat.sizes["packing_fraction"]))
    data, chosen = _thinned(selection(data, *names, along="grains"), alphas, MOST_CURVES // alphas)
    figure = empty_figure(TWO_COLUMNS, height=2.6)
    grid = figure.subplots(1, len(names), sharex=True, sharey=True, squeeze=False)[0]
    for axes, letter, name in zip(grid, "abc", names, strict=False):
        _draw_curves(axes, data, "grains", name, relative=True)
        axes.set(xlabel="number of grains $N$", title=f"({letter}) {_QUANTITIES[name]}")
    largest = data.grains.values[-1]
    grid[0].set_ylabel(f"value over that at $N={largest}$")
    grid[0].xaxis.set_major_locator(FixedLocator(data.grains.values.tolist(), nbins=4))
    grid[0].xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    grid[0].xaxis.set_minor_locator(NullLocator())
    labels, title = _names(data, together=True)
    add_curve_legend(figure, labels, title, suspect(data).any())
    message = (
        "How averages depend on the number of grains. Bars are standard errors of each value, also "
        "of that at the largest $N$"
    )
    describe(figure, data, message, chosen)
    return figure


def _require_several(data: MapData, name: str, words: str) -> xr.Dataset:
    """Return a map, flattened; raise an InputError unless it has several values of a dimension."""
    flat = require_map(data, *RATIO)
    count = flat.sizes.get(name, 1)
    if count < 2:
        raise InputError(f"this figure needs at least two {words}, and this map has {count}.")
    return flat


def _thinned(data: xr.Dataset, alphas: int, nus: int) -> tuple[xr.Dataset, str]:
    """Return a map of at most so many restitutions and packing fractions, evenly chosen, and a
    sentence that tells of what there were more.
    """
    most = {"restitution": alphas, "packing_fraction": nus}
    left = {name: count for name, count in most.items() if data.sizes[name] > count}
    chosen = {
        name: np.linspace(0, data.sizes[name] - 1, count).round().astype(int)
        for name, count in left.items()
    }
    words = [
        f"{count} of {data.sizes[name]} {name.replace('_', ' ')}s" for name, count in left.items()
    ]
    return data.isel(chosen), f"Shown: {', '.join(words)}" if words else ""


def _flows(data: xr.Dataset) -> list[xr.Dataset]:
    """Return the curves of a panel, by packing fraction and restitution."""
    nus, alphas = range(data.sizes["packing_fraction"]), range(data.sizes["restitution"])
    return [data.isel(packing_fraction=k, restitution=j) for k in nus for j in alphas]


def _names(panel: xr.Dataset, together: bool) -> tuple[list[str], str]:
    """Return the names of the curves of a panel and the title of their legend."""
    points = [(flow.restitution.item(), flow.packing_fraction.item()) for flow in _flows(panel)]
    if together:
        return [f"{alpha:.4g}, {nu:.4g}" for alpha, nu in points], r"$\alpha$, $\nu$"
    return [f"{alpha:.4g}" for alpha, _ in points], ALPHA_TITLE


def _draw_curves(
    axes: Axes, panel: xr.Dataset, along: str, name: str, relative: bool = False
) -> None:
    """Draw a quantity of all flows along a dimension, or its quotient with the last value."""
    draw_reference(axes)
    axes.set_xscale("log")
    flows, x = _flows(panel), panel[along].values
    for k, (flow, style) in enumerate(zip(flows, curve_styles(len(flows)), strict=True)):
        value, error = flow[name].values, flow[f"{name}_stderr"].values
        unit = abs(value[-1]) if relative else 1.0
        apart = 1.03 ** (k - (len(flows) - 1) / 2) if relative else 1.0
        draw_points(axes, x * apart, value / unit, suspect(flow), style, yerr=error / unit)
    margin = (x.max() / x.min()) ** 0.08
    axes.set_xlim(x.min() / margin, x.max() * margin)
