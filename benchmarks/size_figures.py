"""The figures of ``size_study``: values against N, and waves of velocity and density."""

import numpy as np
from matplotlib.figure import Figure

from jaxgran.plotting.style import (
    SMALL_SIZE,
    TWO_COLUMNS,
    add_curve_legend,
    curve_styles,
    draw_points,
    draw_reference,
    empty_figure,
    label_log_axis,
    styled,
)

SIZE_FLOWS = ((0.1, 0.3), (0.2, 0.6), (0.5, 0.6), (0.8, 0.6), (0.2, 0.75), (0.8, 0.82))
WAVE_FLOWS = ((0.1, 0.3), (0.2, 0.6), (0.8, 0.2), (0.8, 0.6), (0.95, 0.1), (0.95, 0.6))
PANELS = {
    "pressure": "(a) pressure",
    "granular_temperature": "(b) granular temperature",
    "local_granular_temperature": "(c) local temperature",
}
WAVES = {
    "transverse": "energy of velocity across $k$\nover that of equipartition",
    "density": "structure factor $S(k)$",
}


def flow_of(row: dict) -> tuple[float, float]:
    """Restitution and packing fraction of a row."""
    return row["restitution"], row["packing_fraction"]


def flow_name(alpha: float, nu: float) -> str:
    """A flow in the legend."""
    return rf"$\alpha={alpha:g}$, $\nu={nu:g}$"


@styled
def draw_sizes(rows: list[dict]) -> Figure:
    """Averages over those at the largest N of a flow, each with its own standard error; symbols of
    different flows are moved apart a little.
    """
    flows = [flow for flow in SIZE_FLOWS if flow in map(flow_of, rows)] or [flow_of(rows[0])]
    figure = empty_figure(TWO_COLUMNS, 2.9)
    grid = figure.subplots(1, len(PANELS), sharex=True, sharey=True)
    for axes, (name, title) in zip(grid, PANELS.items(), strict=True):
        draw_reference(axes)
        for k, (flow, style) in enumerate(zip(flows, curve_styles(len(flows)), strict=True)):
            chosen = [row for row in rows if flow_of(row) == flow]
            grains = np.array([row["grains"] for row in chosen]) * 1.04 ** (k - len(flows) / 2)
            value, error = np.array([row[name] for row in chosen]).T / chosen[-1][name][0]
            draw_points(axes, grains, value, np.zeros(len(value), bool), style, yerr=error)
        axes.set(xscale="log", xlabel="number of grains $N$", title=title)
    grid[0].set_ylabel("average over that at the largest $N$")
    add_curve_legend(figure, [flow_name(*flow) for flow in flows], "", bad=False)
    return figure


@styled
def draw_waves(rows: list[dict]) -> Figure:
    """Energy of the velocity across a wave vector and structure factor against wave number, in the
    largest cells.
    """
    largest = [row for row in rows if "spectrum" in row]
    chosen = [row for row in largest if flow_of(row) in WAVE_FLOWS] or largest
    figure = Figure(figsize=(TWO_COLUMNS, 2.9), layout="constrained")
    panels = figure.subplots(1, 2, sharex=True)
    for axes, (name, label) in zip(panels, WAVES.items(), strict=True):
        for row, style in zip(chosen, curve_styles(len(chosen)), strict=True):
            look = style | {"markersize": 3, "linewidth": 1, "label": flow_name(*flow_of(row))}
            axes.plot(row["spectrum"]["wave_number"], row["spectrum"][name], **look)
        axes.set(xscale="log", yscale="log", xlabel=r"wave number $k$ ($1/\sigma$)", ylabel=label)
        axes.axhline(1, color="0.6", linewidth=0.8)
    label_log_axis(panels[1].yaxis)
    place = {"loc": "outside lower center", "ncols": 3, "fontsize": SMALL_SIZE}
    figure.legend(*panels[0].get_legend_handles_labels(), frameon=False, **place)
    return figure
