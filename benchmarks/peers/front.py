"""From times and errors to a picture and a table: the time that an error of 3 % takes."""

import math

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

OBSERVABLES = ("pressure", "shear_stress")
TARGET = 0.03
FLOOR = 2e-3  # smallest error that is drawn
COST = "cpu_seconds_per_strain"
STYLES = {  # marker, shade
    "jaxgran": ("o", "0.0"),
    "jaxgran, tolerance 1e-2": ("s", "0.35"),
    "numba loop": ("^", "0.0"),
    "LAMMPS, 20 steps a contact": ("D", "#b35806"),
    "LAMMPS, 10 steps a contact": ("d", "#b35806"),
}
LINES = dict(zip(STYLES, ("-", "--", ":", "-", "--"), strict=True))


def largest_error(row: dict, names: tuple[str, ...]) -> float:
    """The largest of some errors of a row, without sign."""
    return max(abs(row["errors"][name][0]) for name in names)


def time_to_target(rows: list[dict], names: tuple[str, ...], cost: str = COST) -> tuple[float, str]:
    """Seconds for a unit of strain at which the front of a curve falls to ``TARGET``.

    The rows stand in the order of their settings, coarse before fine. Errors change sign along a curve, so a row that
    meets the target by chance, while a finer one misses it beyond its standard error, is left out. The front is made of
    the rows that are more accurate than all that are cheaper, and is interpolated in logarithms.
    The sign is "=" for an interpolated time, "<" where the cheapest row is better already, ">" where none is as good:
    the time is that of the cheapest or the most accurate row then, and NaN where there is no row.
    """
    front: list[dict] = []
    rows = [row for row in rows if "errors" in row]
    last_miss = max((k for k, row in enumerate(rows) if _misses(row, names)), default=-1)
    rows = [row for k, row in enumerate(rows) if k >= last_miss or largest_error(row, names) > TARGET]
    for row in sorted(rows, key=lambda row: row[cost]):
        if not front or largest_error(row, names) < largest_error(front[-1], names):
            front.append(row)
    if not front:
        return math.nan, ">"
    if largest_error(front[0], names) <= TARGET:
        return front[0][cost], "<"
    for dear, cheap in zip(front[1:], front, strict=False):
        if largest_error(dear, names) <= TARGET:
            worse, better = (math.log(largest_error(row, names)) for row in (cheap, dear))
            share = (worse - math.log(TARGET)) / (worse - better)
            return cheap[cost] ** (1 - share) * dear[cost] ** share, "="
    return front[-1][cost], ">"


def _misses(row: dict, names: tuple[str, ...]) -> bool:
    """Whether an error exceeds the target by more than its standard error."""
    return any(abs(error) - noise > TARGET for error, noise in (row["errors"][name] for name in names))


def table(flows: list[dict]) -> str:
    """Markdown: seconds of a core for a unit of strain at 3 %, and their ratio to those of jaxgran."""
    lines = [
        f"| α, ν | | s to {100 * TARGET:g} % in pressure | in shear stress | in both | over jaxgran's | by the clock |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    choices = (("pressure",), ("shear_stress",), OBSERVABLES)
    for flow in flows:
        for curve in dict.fromkeys(row["curve"] for row in flow["rows"]):
            cells = [_time(*time_to_target(_rows(flow, curve), names)) for names in choices]
            ratios = [ratio(flow, curve, cost) for cost in (COST, "wall_seconds_per_strain")]
            head = f"{flow['restitution']:g}, {flow['packing_fraction']:g}"
            lines.append(f"| {head} | {curve} | " + " | ".join(cells + ratios) + " |")
    return "\n".join(lines)


def _rows(flow: dict, curve: str) -> list[dict]:
    return [row for row in flow["rows"] if row["curve"] == curve]


def _time(seconds: float, sign: str) -> str:
    """A time; "not reached" where the target is not met, "< " before that of the cheapest setting if it meets it."""
    return "not reached" if sign == ">" else f"{'< ' if sign == '<' else ''}{seconds:.2g}"


def ratio(flow: dict, curve: str, cost: str) -> str:
    """Time of a curve over that of jaxgran, "~" where both have been run no cheaper.

    Where the dearest setting of a curve misses the target beyond its standard error, the target costs more than that.
    """
    (ours, our_sign), (theirs, sign) = (
        time_to_target(_rows(flow, name), OBSERVABLES, cost) for name in ("jaxgran", curve)
    )
    last = [row for row in _rows(flow, curve) if "errors" in row][-1:]
    if our_sign != ">" and last and _misses(last[0], OBSERVABLES):
        return f"> {last[0][cost] / ours:.2g}"
    if ">" in (our_sign, sign):
        return "–"
    bounds = {("=", "="): "", ("<", "="): "< ", ("=", "<"): "> ", ("<", "<"): "~ "}
    return f"{bounds[sign, our_sign]}{theirs / ours:.2g}" if curve != "jaxgran" else "1"


def draw(flows: list[dict]) -> Figure:
    """Size of the errors against the time of a unit of strain, one panel a flow."""
    figure = Figure(figsize=(6.7, 3.4), layout="constrained")
    panels = figure.subplots(1, len(flows), sharey=True, squeeze=False)[0]
    curves = [curve for curve in STYLES if any(_drawn(flow, curve) for flow in flows)]
    for flow, axes in zip(flows, panels, strict=True):
        for curve in curves:
            for name, filled, shift in zip(OBSERVABLES, (True, False), (0.97, 1.03), strict=True):
                _draw_curve(axes, _drawn(flow, curve), curve, name, filled, shift)
        axes.axhline(TARGET, color="0.6", linewidth=0.8, zorder=0)
        axes.set(xscale="log", yscale="log", ylim=(FLOOR, 1))
        axes.set_title(rf"$\alpha={flow['restitution']:g}$, $\nu={flow['packing_fraction']:g}$", fontsize=8)
        axes.tick_params(labelsize=7.5)
        axes.xaxis.set_major_locator(LogLocator(subs=(1, 3)))
        axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axes.xaxis.set_minor_formatter(NullFormatter())
    panels[0].set_ylabel("|relative error| of a stress", fontsize=8)
    panels[len(flows) // 2].set_xlabel("CPU time of a unit of strain (s)", fontsize=8)
    handles = [
        Line2D([], [], marker=STYLES[c][0], color=STYLES[c][1], linestyle=LINES[c], label=c, linewidth=1)
        for c in curves
    ]
    handles += [
        Line2D([], [], marker="o", color="0.4", linestyle="none", label="pressure"),
        Line2D([], [], marker="o", color="0.4", linestyle="none", markerfacecolor="white", label="shear stress"),
        Line2D([], [], color="0.6", linewidth=0.8, label=f"{100 * TARGET:g} %"),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=3, fontsize=7, frameon=False)
    return figure


def _drawn(flow: dict, curve: str) -> list[dict]:
    return [row for row in _rows(flow, curve) if "errors" in row]


def _draw_curve(axes: Axes, rows: list[dict], curve: str, name: str, filled: bool, shift: float) -> None:
    marker, colour = STYLES[curve]
    places, sizes = [shift * row[COST] for row in rows], [max(abs(row["errors"][name][0]), FLOOR) for row in rows]
    noise = [row["errors"][name][1] for row in rows]
    lower = [min(one, size - FLOOR) for one, size in zip(noise, sizes, strict=True)]
    axes.errorbar(places, sizes, [lower, noise], color=colour, elinewidth=0.5, linestyle="none", alpha=0.6)
    face = colour if filled else "white"
    line = LINES[curve] if filled else "none"
    axes.plot(places, sizes, marker, color=colour, linestyle=line, linewidth=0.8, markerfacecolor=face, markersize=3.5)
