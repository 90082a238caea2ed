"""The figures of ``size_study``: values against N, and waves of velocity and density."""

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxgran.plotting.drawing import LABEL_SIZE, SMALL_SIZE, TWO_COLUMNS, styled

LOOSE = 0.7  # packing fraction up to which a flow is drawn among the loose ones
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


def flow_name(alpha: float, nu: float) -> str:
    """A flow in the legend."""
    return f"α {alpha:g}, ν {nu:g}"


@styled
def draw_sizes(rows: list[dict]) -> Figure:
    """Values against N, relative to the largest one; a column for each kind of flow, with standard errors."""
    groups = [(name, [row for row in rows if inside(row)]) for name, inside in GROUPS]
    groups = [(name, chosen) for name, chosen in groups if chosen]
    figure = Figure(figsize=(TWO_COLUMNS, 8.0), layout="constrained")
    panels = figure.subplots(len(PANELS), len(groups), sharex=True, squeeze=False)
    for column, (title, chosen) in zip(panels.T, groups, strict=True):
        flows = sorted({(row["restitution"], row["packing_fraction"]) for row in chosen})
        for axes, (name, _) in zip(column, PANELS, strict=True):
            for k, flow in enumerate(flows):
                here = [row for row in chosen if (row["restitution"], row["packing_fraction"]) == flow]
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
        axes.errorbar(grains[shown], value, bars, label=label, capsize=2, markersize=4, **STYLES[k % len(STYLES)])
    else:
        largest = value[-1]
        axes.errorbar(grains, value / largest, error / largest, label=label, capsize=2, markersize=4, **STYLES[k % 6])


def draw_waves(states: Mapping[tuple[float, float], tuple[int, dict]], edges: np.ndarray) -> Figure:
    """Granular temperature and structure factor of waves against wave number, in the largest cells."""
    chosen = [flow for flow in states if flow[1] <= LOOSE]
    figure = Figure(figsize=(11, 4.6), layout="constrained")
    panels = figure.subplots(1, 3, sharex=True)
    middle = np.sqrt(edges[1:] * edges[:-1])
    for k, flow in enumerate(sorted(chosen)):
        grains, row = states[flow]
        waves = row["waves"].mean(axis=(0, 1))
        seen = waves > 0
        temperature = row["tally_kinetic_moment"].sum(axis=(0, 1)).trace() / 2 / row["tally_duration"].sum() / grains
        parts = [row[name].mean(axis=(0, 1))[seen] / waves[seen] for name in ("transverse", "along", "density")]
        parts = [parts[0] / temperature, parts[1] / temperature, parts[2]]
        style = {**STYLES[k % 6], "markersize": 3, "label": f"{flow_name(*flow)}, N {grains}"}
        if k >= 6:
            style["markerfacecolor"] = "white"
        for axes, part in zip(panels, parts, strict=True):
            axes.plot(middle[seen], part, **style)
    titles = ("velocity across the wave vector", "velocity along the wave vector", "density")
    labels = ("energy of a wave over equipartition", "energy of a wave over equipartition", "structure factor")
    for axes, title, label in zip(panels, titles, labels, strict=True):
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.axhline(1, color="0.6", linewidth=0.8)
        axes.set_title(title, fontsize=LABEL_SIZE)
        axes.set_xlabel("wave number (1/σ)")
        axes.set_ylabel(label)
        axes.grid(color="0.9")
    handles, names = panels[0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=4, fontsize="small", frameon=False)
    return figure
