"""The figure of the reference table: where kinetic theory predicts the pressure, at the width of
one column.
"""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from jaxgran.model.choices import HALF_INTERVAL
from jaxgran.plotting.style import ONE_COLUMN
from jaxgran.reference.surface import coordinates
from jaxgran.reference.table import FACTORS, Table, excess_from_surface

NATURAL = 0.75  # packing fraction above which most natural flows are, in the words of the paper
LEVELS = (-0.5, -0.25, -0.1, -0.05, 0.05, 0.1, 0.25, 0.5)
NEGLIGIBLE = 0.02  # a factor this close to one is not shaded
LABELLED = {-0.5: 0.05, -0.25: 0.03, -0.1: 0.04, -0.05: 0.026}  # 1 − α of the label of a level
BANDED = 0.1  # the level whose interval is drawn
BINARY = 0.05  # excess of the force ratio on the line of binary collisions
REGIONS = {  # of the assumption that is furthest off: colour, and what is said of it
    "local_temperature": ("#cfe3ef", "temperature of long waves"),
    "anisotropy": ("#e8e8e8", "isotropy"),
    "chaos": ("#fbe3c0", "molecular chaos"),
    "pairs": ("#e4d3ea", "pairs of equilibrium"),
    "binary": ("#f3c6c0", "binary collisions"),
}
LINES = ("-", (0, (5, 1.5)), (0, (1, 1)))
GREEN = "#00602b"
POINTS = 240  # along each axis


def draw(table: Table) -> Figure:
    """The plane of 1 − α and ν."""
    x = np.geomspace(*(1 - np.array(table.range("restitution"))), POINTS)
    y = np.linspace(*table.range("packing_fraction"), POINTS)
    where = coordinates(*np.meshgrid(1 - x, y))
    figure = Figure(figsize=(ONE_COLUMN, 1.2 * ONE_COLUMN), layout="constrained")
    axes = figure.add_subplot()
    axes.set_xscale("log")
    axes.set_xlim(x.min(), x.max())
    axes.set_ylim(y.min(), y.max())
    drawn = _draw_regions(axes, table, x, y, where)
    _draw_errors(axes, table, x, y, where)
    handles = [Patch(facecolor=REGIONS[name][0], label=REGIONS[name][1]) for name in drawn]
    handles.append(Line2D([], [], color="black", linewidth=0.9, label="error of the pressure"))
    handles.append(
        Patch(facecolor="black", alpha=0.25, label=f"95 % interval of ±{100 * BANDED:.0f} %")
    )
    for style, (timestep, surface) in zip(LINES, sorted(table.ratios.items()), strict=False):
        excess = excess_from_surface(surface(where)[0])
        axes.contour(x, y, excess, [BINARY], colors=GREEN, linestyles=[style], linewidths=1.6)
        label = rf"force ratio 1.05, $\mathrm{{d}}t=10^{{{round(np.log10(timestep))}}}$"
        handles.append(Line2D([], [], color=GREEN, linestyle=style, linewidth=1.6, label=label))
    axes.axhline(NATURAL, color="0.35", linewidth=0.8, linestyle=(0, (1, 2)))
    axes.set_xticks([0.02, 0.05, 0.1, 0.2, 0.5, 0.9], ["0.02", "0.05", "0.1", "0.2", "0.5", "0.9"])
    axes.minorticks_off()
    axes.tick_params(direction="in", top=True, right=True, labelsize=7)
    axes.set_xlabel(r"$1-\alpha$", fontsize=8)
    axes.set_ylabel(r"packing fraction $\nu$", fontsize=8)
    figure.legend(
        handles=handles,
        loc="outside lower center",
        ncols=2,
        fontsize=7,
        frameon=False,
        columnspacing=0.8,
        handlelength=1.8,
        title="shaded: the assumption that is furthest off",
        title_fontsize=7,
    )
    return figure


def _draw_regions(
    axes: Axes, table: Table, x: np.ndarray, y: np.ndarray, where: np.ndarray
) -> list[str]:
    """Shade by the factor that is furthest from one; return those that are."""
    logs = np.abs([table.surfaces[f"pressure_{name}"](where)[0] for name in FACTORS])
    furthest = np.argmax(logs, axis=0)
    found = []
    for k, name in enumerate(FACTORS):
        here = (furthest == k) & (logs[k] > NEGLIGIBLE)
        if np.mean(here) > 1e-3:
            found.append(name)
            axes.contourf(x, y, here.astype(float), [0.5, 1.5], colors=[REGIONS[name][0]], zorder=0)
    return found


def _draw_errors(axes: Axes, table: Table, x: np.ndarray, y: np.ndarray, where: np.ndarray) -> None:
    """Contours of the error of the pressure, and where one of them may lie."""
    over, stderr = table.surfaces["pressure"](where)
    half = np.hypot(HALF_INTERVAL * stderr, np.exp(table.bounds["pressure"](where)[0]))
    error = np.expm1(-over)
    for level in (-BANDED, BANDED):
        in_interval = np.abs(np.log1p(level) + over) - half
        axes.contourf(x, y, in_interval, [-9, 0], colors=["black"], alpha=0.12, zorder=1)
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
        fontsize=7,
        manual=places,
    )
