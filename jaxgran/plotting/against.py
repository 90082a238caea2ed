"""What a measurement depends on beside α and ν: force ratio against the time step, averages against
the number of grains.
"""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullLocator, StrMethodFormatter

from jaxgran.maps.schema import RATIO, MapData
from jaxgran.model.checks import InputError
from jaxgran.plotting.ratio import set_ratio_scale
from jaxgran.plotting.selection import describe, points, suspect
from jaxgran.plotting.style import (
    RATIO_LABEL,
    TWO_COLUMNS,
    add_curve_legend,
    draw_curves,
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

    Raises:
      InputError: (a ValueError) fewer than two time steps.
    """
    flows, chosen = _flows(points(data, *RATIO).isel(grains=-1), "timestep", "time steps")
    figure = empty_figure(TWO_COLUMNS, height=2.6)
    axes = figure.add_subplot(xlabel=r"time step $\dot{\gamma}\,\mathrm{d}t$", ylabel=RATIO_LABEL)
    _draw_curves(axes, flows, "timestep", "force_ratio")
    set_ratio_scale(axes, flows.force_ratio.values)
    label_log_axis(axes.xaxis)
    _add_legend(figure, flows)
    describe(figure, flows, "Force ratio against the time step; bars are standard errors", chosen)
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
      that one. Symbols of different curves are moved apart a little.

    Raises:
      InputError: (a ValueError) fewer than two numbers of grains.
    """
    flows, chosen = _flows(points(data, *RATIO).isel(timestep=0), "grains", "numbers of grains")
    panels = [name for name in _QUANTITIES if name in flows and f"{name}_stderr" in flows]
    figure = empty_figure(TWO_COLUMNS, height=2.6)
    grid = figure.subplots(1, len(panels), sharex=True, sharey=True, squeeze=False)[0]
    for axes, letter, name in zip(grid, "abc", panels, strict=False):
        _draw_curves(axes, flows, "grains", name, relative=True)
        axes.set(xlabel="number of grains $N$", title=f"({letter}) {_QUANTITIES[name]}")
    sizes = flows.grains.values.tolist()
    grid[0].set_ylabel(f"value over that at $N={sizes[-1]}$")
    grid[0].xaxis.set_major_locator(FixedLocator(sizes, nbins=4))
    grid[0].xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    grid[0].xaxis.set_minor_locator(NullLocator())
    _add_legend(figure, flows)
    message = (
        "How averages depend on the number of grains. Bars are standard errors of each value, also "
        "of that at the largest $N$"
    )
    describe(figure, flows, message, chosen)
    return figure


def _flows(data: xr.Dataset, along: str, words: str) -> tuple[xr.Dataset, str]:
    """Return at most six flows of a map as (flow, ``along``), and a sentence if it has more."""
    if data.sizes[along] < 2:
        raise InputError(
            f"this figure needs at least two {words}, and this map has {data.sizes[along]}."
        )
    counts = {name: data.sizes[name] for name in ("restitution", "packing_fraction")}
    alphas = min(
        counts["restitution"], max(_MOST_ALPHAS, MOST_CURVES // counts["packing_fraction"])
    )
    most = {"restitution": alphas, "packing_fraction": MOST_CURVES // alphas}
    fewer = {name: most[name] for name, count in counts.items() if count > most[name]}
    places = {
        name: np.linspace(0, counts[name] - 1, k).round().astype(int) for name, k in fewer.items()
    }
    shown = [f"{k} of {counts[name]} {name.replace('_', ' ')}s" for name, k in fewer.items()]
    averages = data[[name for name in data if "/" not in str(name)]].isel(places)
    flows = averages.stack(flow=("packing_fraction", "restitution"))
    return flows.transpose("flow", along, ...), f"Shown: {', '.join(shown)}" if shown else ""


def _add_legend(figure: Figure, flows: xr.Dataset) -> None:
    """Name the curves by α and ν."""
    names = [f"{alpha:.4g}, {nu:.4g}" for nu, alpha in flows.flow.values]
    add_curve_legend(figure, names, r"$\alpha$, $\nu$", suspect(flows).any())


def _draw_curves(
    axes: Axes, flows: xr.Dataset, along: str, name: str, relative: bool = False
) -> None:
    """Draw a quantity of all flows along a dimension, or its quotient with the last value."""
    draw_reference(axes)
    axes.set_xscale("log")
    x, values, errors = flows[along].values, flows[name].values, flows[f"{name}_stderr"].values
    unit = abs(values[:, -1:]) if relative else 1.0
    order = np.arange(len(values))[:, None] - (len(values) - 1) / 2
    apart = 1.03**order if relative else 1.0
    draw_curves(axes, x * apart, values / unit, suspect(flows), yerr=errors / unit)
    margin = (x.max() / x.min()) ** 0.08
    axes.set_xlim(x.min() / margin, x.max() * margin)
