"""The figure of the reference table: where kinetic theory predicts the pressure, at the width of
one column.
"""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from jaxgran.plotting.style import (
    ALPHA_LABEL,
    INTERVAL_COLOUR,
    NU_LABEL,
    ONE_COLUMN,
    SMALL_SIZE,
    empty_figure,
    styled,
)
from jaxgran.reference.surface import coordinates
from jaxgran.reference.table import RATIO, Table, excess_from_surface

LEVELS = (-0.5, -0.25, -0.1, -0.05, 0.05, 0.1, 0.25, 0.5)
LABELLED = {-0.5: 0.05, -0.25: 0.03, -0.1: 0.04, -0.05: 0.026}  # 1 − α of the label of a level
RIGHT = 0.1  # relative error of a pressure that counts as predicted
BINARY = 0.05  # excess of the force ratio on the line of binary collisions
GREEN = "#00602b"
TICKS = (0.02, 0.05, 0.1, 0.2, 0.5, 0.9)
POINTS = 240  # along each axis


@styled
def draw(table: Table) -> Figure:
    """The plane of 1 − α and ν."""
    x = np.geomspace(*(1 - np.array(table.range("restitution"))), POINTS)
    y = np.linspace(*table.range("packing_fraction"), POINTS)
    where = coordinates(*np.meshgrid(1 - x, y))
    figure = empty_figure(ONE_COLUMN, 1.15 * ONE_COLUMN)
    axes = figure.add_subplot(xscale="log", xlabel=ALPHA_LABEL, ylabel=NU_LABEL)
    axes.set(xlim=(x.min(), x.max()), ylim=(y.min(), y.max()))
    _draw_errors(axes, table, x, y, where)
    ratios = {float(table.head["timestep"]): table.surfaces[RATIO]} | {
        float(name.split("_at_")[1]): surface
        for name, surface in table.surfaces.items()
        if name.startswith(f"{RATIO}_at_")
    }
    timesteps = sorted(ratios)
    coarse, middle, fine = (
        np.maximum(excess_from_surface(ratios[dt](where)[0]), 1e-9) for dt in timesteps[::-1]
    )
    axes.contour(x, y, middle, [BINARY], colors=GREEN, linewidths=2, zorder=4)
    fan = np.maximum(np.log(BINARY / coarse), np.log(fine / BINARY))
    axes.contourf(x, y, fan, [-99, 0], colors=[GREEN], alpha=0.25, zorder=3)
    axes.set_xticks(TICKS, [f"{tick:g}" for tick in TICKS])
    axes.minorticks_off()
    axes.set_title(r"nearly elastic $\longleftarrow\qquad\longrightarrow$ dissipative")
    first, between, last = (rf"10^{{{round(np.log10(dt))}}}" for dt in timesteps)
    handles = [
        Patch(facecolor="0.88", label="theory within 10 %"),
        Line2D([], [], color="black", linewidth=0.9, label="error of the pressure"),
        Patch(facecolor=INTERVAL_COLOUR, label="its 95 % interval"),
        Line2D([], [], color=GREEN, linewidth=2, label=rf"force ratio 1.05, d$t={between}$"),
        Patch(facecolor=GREEN, alpha=0.25, label=rf"the same, ${first}$ to ${last}$"),
    ]
    figure.legend(
        handles=handles, loc="outside lower center", ncols=2, columnspacing=0.8, handlelength=1.5
    )
    return figure


def _draw_errors(axes: Axes, table: Table, x: np.ndarray, y: np.ndarray, where: np.ndarray) -> None:
    """Contours of the error of the pressure, and where each of them may lie."""
    over, half = table.log_estimate("pressure", where)
    error = np.expm1(-over)
    axes.contourf(x, y, abs(error), [0, RIGHT], colors=["0.88"], zorder=0)
    apart = np.min([np.abs(np.log1p(level) + over) for level in LEVELS], axis=0)
    axes.contourf(x, y, apart - half, [-9, 0], colors=[INTERVAL_COLOUR], zorder=1)
    lines = axes.contour(
        x, y, error, LEVELS, colors="black", linestyles="-", linewidths=0.9, zorder=2
    )
    places = []
    for level, at in LABELLED.items():
        column = error[:, np.argmin(np.abs(x - at))]
        crossed = np.flatnonzero((column[:-1] - level) * (column[1:] - level) < 0)
        places += [(at, y[crossed[-1]])] if crossed.size else []
    axes.clabel(
        lines,
        fmt=lambda level: f"{100 * level:+.0f} %".replace("-", "−"),
        fontsize=SMALL_SIZE,
        manual=places,
    )
