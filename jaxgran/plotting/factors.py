"""Which assumption of kinetic theory fails: the factors between its contact pressure and the
measured one.
"""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from jaxgran.maps.schema import MapData
from jaxgran.model.display import counted
from jaxgran.plotting.selection import describe, plane, suspect
from jaxgran.plotting.style import (
    NU_LABEL,
    RING,
    SMALL_SIZE,
    TWO_COLUMNS,
    draw_points,
    draw_reference,
    empty_figure,
    label_log_axis,
    padded,
    styled,
)
from jaxgran.theory.assumptions import ASSUMPTIONS

_COLOURS = "#3a86b4", "#7f7f7f", "#d08700", "#8a5aa8", "#c0392b"
FACTORS = {
    name: (assumption.label, colour, marker)
    for (name, assumption), colour, marker in zip(
        ASSUMPTIONS.items(), _COLOURS, "os^Dv", strict=True
    )
}
"""Factors of the contact pressure over Enskog's at the measured granular temperature: their names,
colours and markers.
"""

PREFIX = "theory/enskog_factor_pressure_"
"""Beginning of the names of their variables."""

CURVES = {"temperature": ("temperature", "#2a8c4a", "P")} | FACTORS
"""The same after the factor of the temperature, over the contact pressure of the whole theory."""

_PRODUCT = ("measured/theory", "black", "")
NEEDED = (
    *(f"{PREFIX}{name}{end}" for name in FACTORS for end in ("", "_stderr")),
    *("granular_temperature", "stresses/kinetic_stress", "theory/granular_temperature"),
    *("theory/pressure", "theory/enskog_pressure", "theory/enskog_pressure_stderr"),
)
"""Variables of a map that :func:`enskog_factors` needs beside the ratio."""

_MOST_PANELS = 3
_LABEL_HEIGHT = 0.07  # in heights of the panel


def with_temperature(data: xr.Dataset) -> xr.Dataset:
    """Return a map with the factor of the temperature: Enskog's contact pressure at the measured
    temperature over that of the whole theory, whose balance of energy predicts another one.
    """
    kinetic = abs(sum(data["stresses/kinetic_stress"][..., a, a] for a in (0, 1))) / 2.0
    density = kinetic / data.granular_temperature  # grains over area
    contact = data["theory/pressure"] - density * data["theory/granular_temperature"]
    enskog = {end: data[f"theory/enskog_pressure{end}"] / contact for end in ("", "_stderr")}
    return data.assign({f"{PREFIX}temperature{end}": value for end, value in enskog.items()})


@styled
def enskog_factors(data: MapData) -> Figure:
    """Return the factors by which the contact pressure differs from that of kinetic theory, and
    their product, against the packing fraction.

    Each factor is the pressure with one more assumption replaced by what was measured, over the
    pressure before. The first replaces the temperature that the theory predicts; for the others see
    ``jaxgran.sampling.enskog_factors``. Their product, the measured contact pressure over the
    theory's, is the thick line. Each of at most three restitutions has a panel.

    Args:
      data: a map with `theory/enskog_factor_pressure_...` and `force_ratio`, with `_stderr`, the
        temperatures and pressures of flow and theory, and `status`. The largest of several numbers
        of grains and the shortest of several time steps are drawn.
    """
    data = with_temperature(plane(data, *NEEDED))
    count = data.sizes["restitution"]
    chosen = np.unique(np.round((count - 1) * np.linspace(0.9, 0.1, _MOST_PANELS)).astype(int))
    shown = data.isel(restitution=chosen[::-1])
    figure = empty_figure(TWO_COLUMNS, height=3.0)
    grid = figure.subplots(1, len(chosen), sharex=True, sharey=True, squeeze=False)[0]
    for k, axes in enumerate(grid):
        _draw_factors(axes, shown.isel(restitution=k))
        axes.set(title=rf"$\alpha={shown.restitution.values[k]:.4g}$", xlabel=NU_LABEL)
    grid[0].set(yscale="log", ylabel="factor of the contact pressure")
    grid[0].set_xlim(padded(data.packing_fraction.values))
    label_log_axis(grid[0].yaxis)
    _label_ends(grid[-1], shown.isel(restitution=-1))
    if suspect(shown).any():
        figure.legend(handles=[Line2D([], [], **RING)], loc="outside upper left")
    logs = np.log([shown[f"{PREFIX}{name}"].where(shown[f"{PREFIX}{name}"] > 0) for name in CURVES])
    whole, enskog, every = (
        (abs(np.expm1(log)) <= 0.1).sum()
        for log in (logs.sum(axis=0), logs[1:].sum(axis=0), abs(logs[1:]).max(axis=0))
    )
    describe(
        figure,
        data,
        f"At this $N$ the theory's contact pressure is right within 10 % at {whole} of "
        f"{counted(np.isfinite(logs).all(axis=0).sum(), 'measured point')}, Enskog's at the "
        f"measured temperature at {enskog}, each of its assumptions at {every}"
        f"{': errors cancel' if enskog > every else ''}",
        f"Shown and counted: {len(chosen)} of {count} restitutions" if len(chosen) < count else "",
        "Each factor replaces one more assumption by what is measured; thick: their product; bars "
        "are standard errors",
    )
    return figure


def _draw_factors(axes: Axes, data: xr.Dataset) -> None:
    """Draw factors and product at one restitution."""
    draw_reference(axes)
    nu, bad = data.packing_fraction.values, suspect(data)
    for name, (_, colour, marker) in CURVES.items():
        style = {"color": colour, "marker": marker, "markersize": 3}
        value, error = (data[f"{PREFIX}{name}{end}"].values for end in ("", "_stderr"))
        draw_points(axes, nu, value, bad, style, yerr=error)
    axes.plot(nu, _product(data), color=_PRODUCT[1], linewidth=2.2, zorder=3)


def _product(data: xr.Dataset) -> np.ndarray:
    return np.prod([data[f"{PREFIX}{name}"].values for name in CURVES], axis=0)


def _label_ends(axes: Axes, data: xr.Dataset) -> None:
    """Name the curves at their right ends, moved apart so that no name lies on another."""
    values = {name: data[f"{PREFIX}{name}"].values for name in CURVES} | {"product": _product(data)}
    known = {name: value[np.isfinite(value) & (value > 0)] for name, value in values.items()}
    ends = {name: value[-1] for name, value in known.items() if value.size}
    names = sorted(ends, key=ends.__getitem__)
    to_axes = axes.transData + axes.transAxes.inverted()
    heights = np.array([to_axes.transform((0, ends[name]))[1] for name in names])
    steps = _LABEL_HEIGHT * np.arange(len(names))
    lowest = np.maximum.accumulate(heights - steps) + steps
    highest = np.minimum.accumulate((heights - steps)[::-1])[::-1] + steps
    for name, end, height in zip(names, heights, (lowest + highest) / 2, strict=True):
        text, colour, _ = (CURVES | {"product": _PRODUCT})[name]
        axes.annotate(
            text,
            (1.0, end),
            (1.06, height),
            xycoords="axes fraction",
            color=colour,
            fontsize=SMALL_SIZE,
            va="center",
            arrowprops={"arrowstyle": "-", "color": colour, "linewidth": 0.6},
        )
