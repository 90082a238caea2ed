"""Which error dominates where: the whole error of a map in its plane, and the largest of its parts at each point."""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from jaxgran.maps.schema import RATIO, MapData, finest, relative_ci95, require_map, what_lacks
from jaxgran.plotting.drawing import (
    ALPHA_LABEL,
    LABEL_SIZE,
    NU_LABEL,
    PANEL_TITLE,
    RATIO_LABEL,
    SMALL_SIZE,
    TICK_SIZE,
    TWO_COLUMNS,
    empty_figure,
    finish,
    ordered,
)

_PANELS = {
    "force_ratio": RATIO_LABEL,
    "pressure": r"pressure $p$",
    "granular_temperature": r"granular temperature $T$",
}
_NEEDED = (*_PANELS, *(f"{name}_ci95" for name in _PANELS))

_PARTS = {  # part: its name and mark
    "sampling": ("sampling", "o"),
    "timestep": ("time step", "s"),
    "size": ("number of grains", "^"),
    "tolerance": ("tolerance", "D"),
}
_NOTE = "numbers: whole error in per cent, half the width of an interval of 95 %"
_LEAST, _LARGEST = 12.0, 150.0  # area of a mark, in pt², at an error of 1 % and of 30 %


def has_errors(data: xr.Dataset) -> bool:
    """Whether a map has the error budget of what is drawn."""
    return not what_lacks(data, *RATIO, *_NEEDED)


def dominating_errors(data: MapData) -> Figure:
    """Return the whole error of each point of a map, and which of its parts is the largest.

    Args:
      data: a map with `force_ratio`, `pressure` and `granular_temperature`, with `_stderr` and `_ci95`; of several
        sizes or time steps, the largest and the shortest are drawn.

    Returns:
      A mark for each point: its shape is the largest part, its area grows with the whole error, in per cent.

    Raises:
      InputError: (a ValueError) the data are not a map, or have no error budget.
    """
    data = require_map(data, *RATIO, *_NEEDED)
    data = finest(ordered(data, *_NEEDED))
    x, y = np.meshgrid(1 - data.restitution.values, data.packing_fraction.values)
    figure = empty_figure(TWO_COLUMNS, height=4.4)
    panels = figure.subplots(1, len(_PANELS), sharex=True, sharey=True)
    for axes, (name, title) in zip(panels, _PANELS.items(), strict=True):
        parts = relative_ci95(data, name)
        whole = parts["total"]
        known = np.isfinite(whole)
        stacked = np.stack([np.nan_to_num(parts[part]) for part in _PARTS])
        largest = np.argmax(stacked, axis=0)
        area = _LEAST + (_LARGEST - _LEAST) * np.clip(whole / 0.3, 0, 1)
        for k, (_, mark) in enumerate(_PARTS.values()):
            here = known & (largest == k)
            axes.scatter(x[here], y[here], area[here], "white", marker=mark, edgecolors="black", linewidths=1)
        if whole.size <= 60:
            for *place, error in zip(x[known], y[known], whole[known], strict=True):
                text = f"{100 * error:.2g}"
                axes.annotate(
                    text, place, (0, -9), textcoords="offset points", ha="center", va="top", fontsize=SMALL_SIZE
                )
        if known.any():
            median, worst = np.median(whole[known]), whole[known].max()
            title += f"\n{100 * median:.2g} % (median), {100 * worst:.2g} % (largest)"
        axes.set_title(title, **PANEL_TITLE)
        axes.set_xlabel(ALPHA_LABEL, fontsize=LABEL_SIZE)
        axes.margins(0.12, 0.14)
    panels[0].set_ylabel(NU_LABEL, fontsize=LABEL_SIZE)
    handles = [
        Line2D([], [], marker=mark, linestyle="none", markerfacecolor="white", color="black", label=words)
        for words, mark in _PARTS.values()
    ]
    figure.legend(
        handles=handles,
        title="largest part of the error",
        title_fontsize=TICK_SIZE,
        fontsize=TICK_SIZE,
        ncols=4,
        loc="outside upper center",
        frameon=False,
    )
    finish(figure, data, np.isfinite(data.force_ratio.values), [_NOTE])
    return figure
