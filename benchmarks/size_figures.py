"""The figures of ``size_study``: values against N, and waves of velocity and density."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxgran.plotting.style import (
    LABEL_SIZE,
    SMALL_SIZE,
    TWO_COLUMNS,
    curve_styles,
    label_log_axis,
    styled,
)

LOOSE = 0.7  # packing fraction up to which a flow is drawn among the loose ones
WAVE_FLOWS = (
    (0.1, 0.3),
    (0.2, 0.6),
    (0.5, 0.6),
    (0.8, 0.2),
    (0.8, 0.6),
    (0.95, 0.6),
)  # of the figure of waves
STYLES = [
    {"color": "black", "marker": "o", "linestyle": "-"},
    {"color": "tab:blue", "marker": "s", "linestyle": "--"},
    {"color": "tab:red", "marker": "^", "linestyle": "-."},
    {"color": "tab:green", "marker": "D", "linestyle": ":"},
    {"color": "tab:purple", "marker": "v", "linestyle": "-"},
    {"color": "tab:brown", "marker": "P", "linestyle": "--"},
]
PANELS = (
    ("pressure", "pressure over that\nof the largest N"),
    ("granular_temperature", "granular temperature over\nthat of the largest N"),
    ("local_granular_temperature", "local granular temperature\nover that of the largest N"),
    ("force_ratio", "excess of the force ratio"),
)
GROUPS = (
    ("loose, α ≤ 0.5", lambda row: row["packing_fraction"] <= LOOSE and row["restitution"] <= 0.5),
    ("loose, α ≥ 0.8", lambda row: row["packing_fraction"] <= LOOSE and row["restitution"] > 0.5),
    ("dense", lambda row: row["packing_fraction"] > LOOSE),
)


def flow_of(row: dict) -> tuple[float, float]:
    """Restitution and packing fraction of a row."""
    return row["restitution"], row["packing_fraction"]


def flow_name(alpha: float, nu: float) -> str:
    """A flow in the legend."""
    return f"α {alpha:g}, ν {nu:g}"


@styled
def draw_sizes(rows: list[dict]) -> Figure:
    """Values against N, relative to the largest one; a column for each kind of flow, with standard
    errors.
    """
    groups = [(name, [row for row in rows if inside(row)]) for name, inside in GROUPS]
    groups = [(name, chosen) for name, chosen in groups if chosen]
    figure = Figure(figsize=(TWO_COLUMNS, 8.0), layout="constrained")
    panels = figure.subplots(len(PANELS), len(groups), sharex=True, squeeze=False)
    for column, (title, chosen) in zip(panels.T, groups, strict=True):
        flows = sorted({flow_of(row) for row in chosen})
        for axes, (name, _) in zip(column, PANELS, strict=True):
            for k, flow in enumerate(flows):
                here = [row for row in chosen if flow_of(row) == flow]
                draw_curve(axes, name, here, k, len(flows), flow_name(*flow))
            axes.set_xscale("log")
            axes.grid(color="0.9")
            if name == "force_ratio":
                axes.set_yscale("log")
            else:
                axes.axhline(1, color="0.6", linewidth=0.8)
        column[0].set_title(f"{title}", fontsize=LABEL_SIZE)
        column[0].legend(fontsize=SMALL_SIZE, frameon=False)
        column[-1].set_xlabel("number of grains N")
    for axes, (_, label) in zip(panels[:, 0], PANELS, strict=True):
        axes.set_ylabel(label)
    return figure


def draw_curve(axes: Axes, name: str, rows: list[dict], k: int, count: int, label: str) -> None:
    """One flow in one panel; markers of different flows are moved apart a little."""
    grains = np.array([row["grains"] for row in rows]) * 1.04 ** (k - (count - 1) / 2)
    value, error = np.array([row[name] for row in rows]).T
    if name == "force_ratio":
        shown = value - 1 > 2e-5
        value, error = (value - 1)[shown], error[shown]
        bars = np.stack([np.minimum(error, 0.9 * value), error])
        axes.errorbar(
            grains[shown],
            value,
            bars,
            label=label,
            capsize=2,
            markersize=4,
            **STYLES[k % len(STYLES)],
        )
    else:
        largest = value[-1]
        axes.errorbar(
            grains,
            value / largest,
            error / largest,
            label=label,
            capsize=2,
            markersize=4,
            **STYLES[k % 6],
        )


@styled
def draw_waves(rows: list[dict]) -> Figure:
    """Energy of the velocity across a wave vector and structure factor against wave number, in the
    largest cells.
    """
    largest = [row for row in rows if "spectrum" in row]
    chosen = [row for row in largest if flow_of(row) in WAVE_FLOWS] or largest
    figure = Figure(figsize=(TWO_COLUMNS, 2.9), layout="constrained")
    panels = figure.subplots(1, 2, sharex=True)
    for row, style in zip(chosen, curve_styles(len(chosen)), strict=True):
        style |= {"markersize": 3, "linewidth": 1, "label": flow_name(*flow_of(row))}
        for axes, name in zip(panels, ("transverse", "density"), strict=True):
            axes.plot(row["spectrum"]["wave_number"], row["spectrum"][name], **style)
    labels = (
        "energy of velocity across $k$\nover that of equipartition",
        "structure factor $S(k)$",
    )
    for axes, label in zip(panels, labels, strict=True):
        axes.set(xscale="log", yscale="log", xlabel=r"wave number $k$ ($1/\sigma$)", ylabel=label)
        axes.axhline(1, color="0.6", linewidth=0.8)
    label_log_axis(panels[1].yaxis)
    handles, names = panels[0].get_legend_handles_labels()
    figure.legend(
        handles, names, loc="outside lower center", ncols=3, fontsize=SMALL_SIZE, frameon=False
    )
    return figure
