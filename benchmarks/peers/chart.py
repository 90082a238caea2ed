"""Chart of speed against accuracy: a column for each flow, the pressure above and the force ratio
below, a line for each program.
"""

from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from benchmarks.peers.front import COST, failure_of, rows_of
from jaxgran.plotting.style import (
    INTERVAL_COLOUR,
    LABEL_SIZE,
    SMALL_SIZE,
    TWO_COLUMNS,
    empty_figure,
    label_log_axis,
    styled,
)

LEAST, MOST = 1e-3, 2.5  # errors at the ends of the axis
TIMES = 1.5, 25_000  # µs, at the ends of the axis
OBSERVABLES = {"pressure": "pressure", "force_ratio": "force ratio"}


class Look(NamedTuple):
    """How a program is drawn."""

    label: str
    colour: str
    marker: str
    line: str = "-"


LOOKS = {
    "jaxgran": Look("jaxgran", "black", "o"),
    "JAX engine": Look("JAX engine", "tab:green", "^"),
    "JAX engine, 16 flows": Look("JAX engine, batch of 16", "tab:green", "X", ""),
    "projected Jacobi": Look("projected Jacobi", "tab:purple", "v"),
    "numba loop": Look("Gauss–Seidel loop", "0.55", "s", "--"),
    "LAMMPS": Look("soft discs, LAMMPS", "#b35806", "D"),
    "event-driven": Look("event-driven, hard discs", "tab:blue", "*", ""),
    "TC model": Look("event-driven, TC model", "tab:blue", "P"),
}
FIRST = {
    "jaxgran": (r"\mathrm{d}t", (-4, 0)),
    "LAMMPS": ("k", (-4, 0)),
    "TC model": ("t_c", (4, 2)),
}
"""The symbol of a setting, and where the coarsest is written beside its point, in points."""


@styled
def draw(result: dict) -> Figure:
    """|error| of pressure and force ratio against processor time.

    Args:
      result: that of ``speed_vs_accuracy``.
    """
    flows = result["flows"]
    figure = empty_figure(TWO_COLUMNS, 4.6)
    panels = figure.subplots(len(OBSERVABLES), len(flows), sharey=True, sharex=True, squeeze=False)
    handles = {}
    for column, (flow, letter) in enumerate(zip(flows, "abc", strict=False)):
        alpha, nu = flow["restitution"], flow["packing_fraction"]
        panels[0, column].set_title(rf"({letter}) $\alpha={alpha:g}$, $\nu={nu:g}$")
        for axes, name in zip(panels[:, column], OBSERVABLES, strict=True):
            axes.set(xscale="log", yscale="log", ylim=(LEAST, MOST), xlim=TIMES)
            value, noise = flow["reference"][name]
            shade = {"color": INTERVAL_COLOUR, "alpha": 0.6, "zorder": 0, "lw": 0}
            axes.axhspan(LEAST, max(LEAST, 2 * noise / value), **shade)
            for curve, look in LOOKS.items():
                if (drawn := _draw_curve(axes, flow, curve, look, name)) is not None:
                    handles[curve] = drawn
            label_log_axis(axes.xaxis)
        failed = [
            f"{LOOKS[curve].label}: {failure_of(curve)}"
            for curve in LOOKS
            if not rows_of(flow, curve) and any(row["curve"] == curve for row in flow["rows"])
        ]
        place = {"transform": panels[0, column].transAxes, "fontsize": SMALL_SIZE}
        panels[0, column].text(0.97, 0.96, "\n".join(failed), ha="right", va="top", **place)
    for curve, (symbol, away) in FIRST.items():
        if rows := rows_of(flows[-1], curve):
            at = 1e6 * rows[0][COST] / flows[-1]["discs"], abs(rows[0]["errors"]["pressure"][0])
            look = {"color": LOOKS[curve].colour, "fontsize": SMALL_SIZE, "va": "center"}
            look |= {"textcoords": "offset points", "ha": "right" if away[0] < 0 else "left"}
            setting = f"${symbol}=10^{{{np.log10(rows[0]['setting']):.0f}}}$"
            panels[0, -1].annotate(setting, at, away, **look)
    for axes, words in zip(panels[:, 0], OBSERVABLES.values(), strict=True):
        axes.set_ylabel(f"|error of the {words}|")
        axes.yaxis.set_major_locator(FixedLocator([0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1]))
        axes.yaxis.set_minor_locator(NullLocator())
        axes.yaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{100 * x:g} %"))
    words = "processor time per grain and unit of strain (µs); lower left is better"
    figure.supxlabel(words, fontsize=LABEL_SIZE)
    shown = {LOOKS[curve].label: handles[curve] for curve in LOOKS if curve in handles}
    place = {"loc": "outside upper center", "ncols": 4, "fontsize": SMALL_SIZE}
    figure.legend(list(shown.values()), list(shown), **place)
    return figure


def _draw_curve(axes: Axes, flow: dict, curve: str, look: Look, name: str):
    """One program; settings whose error is within twice its standard error are hollow. Returns a
    handle for the legend, None where the program does not know the observable.
    """
    rows = [row for row in rows_of(flow, curve) if name in row["errors"]]
    if not rows:
        return None
    costs = np.array([1e6 * row[COST] / flow["discs"] for row in rows])
    signed, noise = np.transpose([row["errors"][name] for row in rows])
    errors = np.maximum(abs(signed), 1.05 * LEAST)
    style = {"color": look.colour, "marker": look.marker, "ms": 6 if look.marker == "*" else 3.5}
    axes.plot(costs, errors, look.line or "none", color=look.colour, lw=1.1)
    resolved = abs(signed) > 2 * noise
    down = np.minimum(noise, errors - LEAST)
    for which, face in ((resolved, look.colour), (~resolved, "white")):
        bars, at = [down[which], noise[which]], (costs[which], errors[which])
        axes.errorbar(*at, bars, ls="none", mfc=face, elinewidth=0.6, **style)
    (handle,) = axes.plot([], [], ls=look.line or "none", lw=1.1, **style)
    return handle
