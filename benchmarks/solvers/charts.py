"""The charts of contact solvers: work against residual, profiles, scaling, and cold against warm."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.profiles import STYLES, draw_shares
from benchmarks.solvers.groups import CONSTRUCTED, FLOW_GROUPS, cost, grouped, median
from benchmarks.solvers.measure import LIMIT, TARGETS, Row
from benchmarks.solvers.warm import WarmRow

_PANELS = (*FLOW_GROUPS, *CONSTRUCTED)
_UNIT = {"seconds": (1e3, "time (ms)"), "iterations": (1, "products with W, or sweeps")}
# Where an iteration is a product or a sweep. Those of the others solve linear systems, and are not compared by number.
FIRST_ORDER = frozenset(name for name in STYLES if STYLES[name][2] == "-") | {
    "barzilai-borwein, float32",
    "Pinocchio PGS",
}


def draw_work(rows: Sequence[Row], of: str) -> Figure:
    """Median cost to a residual, a panel for each group; above the grey line the median solve fails."""
    present = {name for name in STYLES for row in rows if row.solver == name}
    names = [name for name in STYLES if name in present and _counts(rows, name, of)]
    figure = Figure(figsize=(15, 8.6), layout="constrained")
    panels = figure.subplots(2, 4, sharex=True).ravel()
    members, (unit, label) = grouped(rows), _UNIT[of]
    for axes, group in zip(panels, _PANELS, strict=True):
        curves = {
            name: [unit * median([cost(row, of) for row in members[group, name, target]]) for target in TARGETS]
            for name in names
            if (group, name, TARGETS[0]) in members
        }
        axes.set_visible(bool(curves))  # a quick run has not all groups
        if not curves:
            continue
        _draw_curves(axes, curves)
        number = len(members[group, next(iter(curves)), TARGETS[0]])
        axes.set_title(f"{group} ({number} of them)", fontsize="medium")
        axes.set_ylabel(label if axes in panels[::4] else "")
        axes.set_xlabel("residual" if axes in panels[4:] else "")
    handles = [panels[0].plot([], [], **_line(name), label=name)[0] for name in names]
    figure.legend(handles=handles, loc="outside upper center", ncols=6)
    figure.supxlabel("medians; above the grey line: the median problem is not solved", fontsize="medium")
    return figure


def _counts(rows: Sequence[Row], name: str, of: str) -> bool:
    comparable = of == "seconds" or name in FIRST_ORDER
    return comparable and any(np.isfinite(getattr(row, of)) for row in rows if row.solver == name)


def _line(name: str) -> dict:
    colour, marker, line = STYLES[name]
    return {"color": colour, "marker": marker, "linestyle": line, "markerfacecolor": "none", "ms": 6, "lw": 1.2}


def _draw_curves(axes: Axes, curves: Mapping[str, Sequence[float]]) -> None:
    values = np.array([value for curve in curves.values() for value in curve])
    most = np.max(values[np.isfinite(values)], initial=0.0)
    axes.set(xscale="log", yscale="log")
    axes.axhline(2 * most, color="0.6", lw=0.8)
    for place, (name, curve) in enumerate(curves.items()):
        failed = 2 * most * 1.35 ** (1 + place)
        line = _line(name)
        axes.plot(TARGETS, np.where(np.isfinite(curve), curve, np.nan), **line)
        missed = [target for target, value in zip(TARGETS, curve, strict=True) if not np.isfinite(value)]
        axes.plot(missed, [failed] * len(missed), **(line | {"linestyle": "none"}))
    axes.set_xlim(2 * TARGETS[0], TARGETS[-1] / 2)
    axes.grid(alpha=0.3)


def draw_profiles(rows: Sequence[Row], targets: Sequence[float] = (1e-4, 1e-8)) -> Figure:
    """Performance profiles in time and in iterations, of all problems that have a solution."""
    figure = Figure(figsize=(12.5, 9.4), layout="constrained")
    panels = figure.subplots(2, len(targets), sharey=True)
    for line, (of, label) in zip(
        panels, (("seconds", "time"), ("iterations", "products with W or sweeps")), strict=True
    ):
        for axes, target in zip(line, targets, strict=True):
            held = [row for row in rows if row.target == target]
            names = [name for name in STYLES if _counts(held, name, of)]
            costs = {name: np.array([cost(row, of) for row in held if row.solver == name]) for name in names}
            draw_shares(axes, costs, {name: STYLES[name] for name in names})
            axes.set_xlabel(f"{label} over that of the best")
            axes.set_title(f"residual {target:.0e}", fontsize="medium")
        line[0].set_ylabel(f"share of {len({row.problem for row in held})} problems")
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=5)
    return figure


def draw_scaling(rows: Sequence[Row], target: float = 1e-4) -> Figure:
    """Time against the number of contacts: of flows and packings, and of chains, mass ratios and hexagons."""
    shown = (("flows and static packings", ("flow", "sheared", "static packing")),)
    shown += (("chains and mass ratios", ("chain", "mass ratio 10000")),)
    figure = Figure(figsize=(13, 6.2), layout="constrained")
    names = [name for name in STYLES if any(row.solver == name for row in rows)]
    panels = figure.subplots(1, 2, sharey=True)
    for axes, (title, families) in zip(panels, shown, strict=True):
        axes.axhline(1e3 * LIMIT, color="0.6", lw=0.8)
        for place, name in enumerate(names):
            held = [row for row in rows if (row.solver, row.target) == (name, target) and row.family in families]
            x, y, failed = _by_size(held)
            line = _line(name)
            axes.plot(x, 1e3 * y, **line)
            height = 1e3 * LIMIT * 1.35 ** (1 + place)
            axes.plot(failed, np.full(len(failed), height), **(line | {"linestyle": "none"}))
        axes.set(xscale="log", yscale="log", xlabel="contacts")
        axes.set_title(title, fontsize="medium")
        axes.grid(alpha=0.3)
    panels[0].set_ylabel(f"time to a residual of {target:.0e} (ms)")
    handles = [panels[0].plot([], [], **_line(name), label=name)[0] for name in names]
    figure.legend(handles=handles, loc="outside upper center", ncols=6)
    figure.supxlabel("medians in bins of contacts; above the grey line: bins whose median fails", fontsize="medium")
    return figure


def _by_size(rows: Sequence[Row]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Geometric mean of contacts and median time of each bin, half a decade wide, and the bins that fail."""
    sizes = np.array([row.contacts for row in rows], float)
    bins = np.floor(2 * np.log10(np.maximum(sizes, 1))).astype(int)
    x, y, failed = [], [], []
    for number in np.unique(bins):
        held = [row for row, one in zip(rows, bins, strict=True) if one == number]
        middle = float(np.exp(np.mean(np.log(sizes[bins == number]))))
        time = median([cost(row) for row in held])
        if np.isfinite(time):
            x.append(middle)
            y.append(time)
        else:
            failed.append(middle)
    return np.array(x), np.array(y), np.array(failed)


def draw_warm(rows: Sequence[WarmRow]) -> Figure:
    """Time and iterations of a warm start over those of a cold one: median and quartiles over the problems."""
    figure = Figure(figsize=(11, 4.6), layout="constrained")
    starts = [start for start in dict.fromkeys(row.start for row in rows) if start != "cold"]
    names = list(dict.fromkeys(row.solver for row in rows))
    panels = figure.subplots(1, 2, sharey=True)
    for axes, (of, label) in zip(panels, (("seconds", "time"), ("iterations", "iterations")), strict=True):
        cold = {(row.solver, row.problem): getattr(row, of) for row in rows if row.start == "cold"}
        for place, name in enumerate(names):
            shares = [
                [getattr(row, of) / cold[name, row.problem] for row in rows if (row.solver, row.start) == (name, start)]
                for start in starts
            ]
            low, middle, high = np.array([np.nanquantile(one, (0.25, 0.5, 0.75)) for one in shares]).T
            x = np.arange(len(starts)) + 0.15 * (place - (len(names) - 1) / 2)
            line = _line(name) | {"linestyle": "none"}
            axes.errorbar(x, middle, [middle - low, high - middle], label=name, **line)
        axes.axhline(1, color="0.6", lw=0.8)
        axes.set_xticks(range(len(starts)), starts)
        axes.set(ylabel=f"{label}, warm over cold", ylim=(0, None))
        axes.grid(alpha=0.3, axis="y")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=4)
    return figure
