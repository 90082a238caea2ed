"""What a measurement depends on beside α and ν: force ratio against the time step, averages against
the number of grains.
"""

from __future__ import annotations

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
_MOST_ALPHAS = 3  # restitutions, where six curves are chosen among many
_QUANTITIES = {
    "pressure": "pressure",
    "granular_temperature": "granular temperature",
    "force_ratio": RATIO_LABEL,
}


@styled
def ratio_against_timestep(data: MapData) -> Figure:
    """Return the force ratio against the time step, a curve for each restitution and packing
    fraction; of more than six, at most six are chosen evenly.

    Args:
      data: as in :func:`ratio_curves`, with a dimension `timestep` in units of 1/γ̇.

    Returns:
      Error bars are one standard error; a point whose status is not `ok` is an open symbol in a
      ring.

    Raises:
      InputError: (a ValueError) fewer than two time steps.
    """
    data, chosen = _several_of(data, "timestep", "time steps")
    figure = empty_figure(TWO_COLUMNS, height=2.6)
    axes = figure.add_subplot(xlabel=r"time step $\dot{\gamma}\,\mathrm{d}t$", ylabel=RATIO_LABEL)
    _draw_curves(axes, data, "timestep", "force_ratio")
    set_ratio_scale(axes, data.force_ratio.values)
    label_log_axis(axes.xaxis)
    _add_legend(figure, data)
    describe(figure, data, "Force ratio against the time step; bars are standard errors", chosen)
    return figure


@styled
def averages_against_grains(data: MapData) -> Figure:
    """Return pressure, granular temperature and force ratio against the number of grains, a curve
    for each restitution and packing fraction; of more than six, at most six are chosen evenly.

    Each average is divided by its value at the largest number of grains N.

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
    data, chosen = _several_of(data, "grains", "numbers of grains")
    panels = [name for name in _QUANTITIES if name in data and f"{name}_stderr" in data]
    figure = empty_figure(TWO_COLUMNS, height=2.6)
    grid = figure.subplots(1, len(panels), sharex=True, sharey=True, squeeze=False)[0]
    for axes, letter, name in zip(grid, "abc", panels, strict=False):
        _draw_curves(axes, data, "grains", name, relative=True)
        axes.set(xlabel="number of grains $N$", title=f"({letter}) {_QUANTITIES[name]}")
    sizes = data.grains.values.tolist()
    grid[0].set_ylabel(f"value over that at $N={sizes[-1]}$")
    grid[0].xaxis.set_major_locator(FixedLocator(sizes, nbins=4))
    grid[0].xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    grid[0].xaxis.set_minor_locator(NullLocator())
    _add_legend(figure, data)
    message = (
        "How averages depend on the number of grains. Bars are standard errors of each value, also "
        "of that at the largest $N$"
    )
    describe(figure, data, message, chosen)
    return figure


def _several_of(data: MapData, along: str, words: str) -> tuple[xr.Dataset, str]:
    """Return a map of at most six flows with several values of a dimension, and a sentence that
    tells of what there were more.
    """
    flat = require_map(data, *RATIO)
    if flat.sizes.get(along, 1) < 2:
        raise InputError(
            f"this figure needs at least two {words}, and this map has {flat.sizes.get(along, 1)}."
        )
    alphas, nus = flat.sizes["restitution"], flat.sizes["packing_fraction"]
    most_alphas = min(alphas, max(_MOST_ALPHAS, MOST_CURVES // nus))
    counts = {
        "restitution": (alphas, most_alphas),
        "packing_fraction": (nus, MOST_CURVES // most_alphas),
    }
    more = {name: (count, most) for name, (count, most) in counts.items() if count > most}
    chosen = {
        name: np.linspace(0, count - 1, most).round().astype(int)
        for name, (count, most) in more.items()
    }
    left = ", ".join(f"{m} of {n} {name.replace('_', ' ')}s" for name, (n, m) in more.items())
    names = [name for name in _QUANTITIES if name in flat]
    shown = selection(data, *names, along=along).isel(chosen)
    return shown, f"Shown: {left}" if left else ""


def _flows(data: xr.Dataset) -> list[xr.Dataset]:
    """Return the flows of a map, by packing fraction and restitution."""
    nus, alphas = range(data.sizes["packing_fraction"]), range(data.sizes["restitution"])
    return [data.isel(packing_fraction=k, restitution=j) for k in nus for j in alphas]


def _add_legend(figure: Figure, data: xr.Dataset) -> None:
    """Name the curves by α and ν."""
    names = [
        f"{flow.restitution.item():.4g}, {flow.packing_fraction.item():.4g}"
        for flow in _flows(data)
    ]
    add_curve_legend(figure, names, r"$\alpha$, $\nu$", suspect(data).any())


def _draw_curves(
    axes: Axes, data: xr.Dataset, along: str, name: str, relative: bool = False
) -> None:
    """Draw a quantity of all flows along a dimension, or its quotient with the last value."""
    draw_reference(axes)
    axes.set_xscale("log")
    flows, x = _flows(data), data[along].values
    for k, (flow, style) in enumerate(zip(flows, curve_styles(len(flows)), strict=True)):
        value, error = flow[name].values, flow[f"{name}_stderr"].values
        unit = abs(value[-1]) if relative else 1.0
        apart = 1.03 ** (k - (len(flows) - 1) / 2) if relative else 1.0
        draw_points(axes, x * apart, value / unit, suspect(flow), style, yerr=error / unit)
    margin = (x.max() / x.min()) ** 0.08
    axes.set_xlim(x.min() / margin, x.max() * margin)
