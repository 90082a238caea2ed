"""Chart of speed against accuracy: one panel a flow, one line a program."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullLocator, PercentFormatter

from benchmarks.peers.front import COST, rows_of
from jaxgran.plotting.style import SMALL_SIZE, TWO_COLUMNS, empty_figure, label_log_axis, styled

LEAST, MOST = 1.5e-3, 1.2  # errors at the ends of the axis
SOFT = "#b35806"


class Look(NamedTuple):
    """How a program is drawn: its name at the line, and which of its settings are named there."""

    label: str
    colour: str
    marker: str
    line: str
    setting: str


LOOKS = {
    "LAMMPS": Look("soft discs\n(LAMMPS)", SOFT, "D", "-", "k"),
    "numba loop": Look("Gauss–Seidel\nloop", "0.55", "s", "--", ""),
    "jaxgran": Look("jaxgran", "black", "o", "-", "dt"),
    "event-driven": Look("event-driven", "tab:blue", "*", "", ""),
}


@styled
def draw(result: dict) -> Figure:
    """|error of the pressure| against processor time.

    Args:
      result: that of ``compare``.
    """
    flows = result["flows"]
    figure = empty_figure(TWO_COLUMNS, 2.9)
    panels = np.atleast_1d(figure.subplots(1, len(flows), sharey=True))
    for axes, flow, letter in zip(panels, flows, "abc", strict=False):
        axes.set(xscale="log", yscale="log", ylim=(LEAST, MOST))
        for curve, look in LOOKS.items():
            _draw_curve(axes, flow, curve, look)
        value, noise = flow["reference"]["pressure"]
        axes.axhspan(LEAST, 2 * noise / value, color="0.9", zorder=0, lw=0)
        alpha, nu = flow["restitution"], flow["packing_fraction"]
        axes.set_title(rf"({letter}) $\alpha={alpha:g}$, $\nu={nu:g}$")
        left, right = axes.get_xlim()
        axes.set_xlim(left, 1.8 * right)
        label_log_axis(axes.xaxis)
    panels[0].set_ylabel("|error of the pressure|")
    panels[0].yaxis.set_major_locator(FixedLocator([0.003, 0.01, 0.03, 0.1, 0.3, 1]))
    panels[0].yaxis.set_minor_locator(NullLocator())
    panels[0].yaxis.set_major_formatter(PercentFormatter(1, decimals=None, symbol=" %"))
    figure.supxlabel("processor time of a grain in a unit of strain (µs)", fontsize=8)
    return figure


def _draw_curve(axes: Axes, flow: dict, curve: str, look: Look) -> None:
    """One program; settings whose error is within twice its standard error are hollow."""
    rows = rows_of(flow, curve)
    if not rows:
        if any(row["curve"] == curve for row in flow["rows"]):
            axes.plot(0.06, 0.06, "X", color=look.colour, ms=6, transform=axes.transAxes)
            _name(axes, f"{look.label} collapses", (0.1, 0.06), look.colour, axes.transAxes)
        return
    costs = np.array([1e6 * row[COST] / flow["discs"] for row in rows])
    signed, noise = np.transpose([row["errors"]["pressure"] for row in rows])
    errors = np.clip(abs(signed), LEAST * 1.05, MOST)
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
    _label(axes, rows, costs, errors, look)


def _label(axes: Axes, rows: list[dict], costs: np.ndarray, errors: np.ndarray, look: Look) -> None:
    """Name a line, and the settings at its ends."""
    middle = len(costs) // 2
    _name(axes, look.label, (1.15 * costs[middle], 1.15 * errors[middle]), look.colour)
    if look.setting:
        for k in (0, -1):
            power = rf"${look.setting}=10^{{{round(np.log10(rows[k]['setting']))}}}$"
            axes.annotate(
                power,
                (costs[k], errors[k]),
                (3, 5),
                textcoords="offset points",
                fontsize=SMALL_SIZE,
            )


def _name(
    axes: Axes, text: str, place: Sequence[float], colour: str, transform: object = None
) -> None:
    axes.text(
        *place, text, color=colour, fontsize=SMALL_SIZE, transform=transform or axes.transData
    )
