"""Chart of speed against accuracy: one panel a flow, one line a program."""

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

LEAST, MOST = 1e-3, 1.5  # errors at the ends of the axis
TIMES = 1.5, 25_000  # µs, at the ends of the axis


class Look(NamedTuple):
    """How a program is drawn: its name at the line, the symbol of its setting, and where the name
    stands in each panel, in shares of it.
    """

    label: str
    colour: str
    marker: str
    line: str
    setting: str
    places: tuple[tuple[float, float] | None, ...]


LOOKS = {
    "LAMMPS": Look(
        "soft discs, LAMMPS", "#b35806", "D", "-", "k", ((0.42, 0.76), (0.47, 0.82), (0.47, 0.82))
    ),
    "numba loop": Look(
        "Gauss–Seidel loop", "0.55", "s", "--", "", (None, (0.04, 0.5), (0.04, 0.22))
    ),
    "jaxgran": Look("jaxgran", "black", "o", "-", "dt", ((0.04, 0.4), (0.04, 0.57), (0.04, 0.29))),
    "event-driven": Look(
        "event-driven", "tab:blue", "*", "", "", ((0.125, 0.265), (0.335, 0.06), (0.04, 0.04))
    ),
}


@styled
def draw(result: dict) -> Figure:
    """|error of the pressure| against processor time.

    Args:
      result: that of ``compare``.
    """
    flows = result["flows"]
    figure = empty_figure(TWO_COLUMNS, 2.8)
    panels = np.atleast_1d(figure.subplots(1, len(flows), sharey=True, sharex=True))
    for axes, flow, letter in zip(panels, flows, "abc", strict=False):
        axes.set(xscale="log", yscale="log", ylim=(LEAST, MOST), xlim=TIMES)
        value, noise = flow["reference"]["pressure"]
        shade = {"color": INTERVAL_COLOUR, "alpha": 0.6, "zorder": 0, "lw": 0}
        axes.axhspan(LEAST, 2 * noise / value, **shade)
        for curve, look in LOOKS.items():
            _draw_curve(axes, flow, curve, look, look.places["abc".index(letter)])
        alpha, nu = flow["restitution"], flow["packing_fraction"]
        axes.set_title(rf"({letter}) $\alpha={alpha:g}$, $\nu={nu:g}$")
        label_log_axis(axes.xaxis)
    panels[0].set_ylabel("|error of the pressure|")
    panels[0].yaxis.set_major_locator(FixedLocator([0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1]))
    panels[0].yaxis.set_minor_locator(NullLocator())
    panels[0].yaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{100 * x:g} %"))
    figure.supxlabel(
        "processor time per grain and unit of strain (µs); lower left is better",
        fontsize=LABEL_SIZE,
    )
    return figure


def _draw_curve(
    axes: Axes, flow: dict, curve: str, look: Look, place: tuple[float, float] | None
) -> None:
    """One program with its name, and its settings at the ends where they are far apart; settings
    whose error is within twice its standard error are hollow.
    """
    style = {"color": look.colour, "fontsize": SMALL_SIZE}
    rows = rows_of(flow, curve)
    if place and any(row["curve"] == curve for row in flow["rows"]):
        label = look.label if rows else f"$\\times$ {look.label}\n    {failure_of(curve)}"
        axes.text(*place, label, transform=axes.transAxes, **style)
    if not rows:
        return
    costs = np.array([1e6 * row[COST] / flow["discs"] for row in rows])
    signed, noise = np.transpose([row["errors"]["pressure"] for row in rows])
    errors = np.maximum(abs(signed), 1.05 * LEAST)
    axes.plot(costs, errors, look.line or "none", color=look.colour, lw=1.2)
    resolved = abs(signed) > 2 * noise
    down = np.minimum(noise, errors - LEAST)
    for which, face in ((resolved, look.colour), (~resolved, "white")):
        axes.errorbar(
            costs[which],
            errors[which],
            [down[which], noise[which]],
            ls="none",
            marker=look.marker,
            color=look.colour,
            mfc=face,
            ms=7 if look.marker == "*" else 4,
            elinewidth=0.6,
        )
    if look.setting and errors[0] / errors[-1] > 10:
        for k, apart, side in ((0, (-6, -2), "right"), (-1, (6, -2), "left")):
            power = round(np.log10(rows[k]["setting"]))
            name = rf"${look.setting}=10^{{{power}}}$".replace("dt", r"\mathrm{d}t")
            place = costs[k], errors[k]
            axes.annotate(name, place, apart, textcoords="offset points", ha=side, **style)
