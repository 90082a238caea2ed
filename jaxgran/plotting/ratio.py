"""The figures of a ratio map: curves of its ratios, contours of the excess over one, and the effect
of dt.

Curves and contours follow Figures 1 and 2 of Lois, Lemaître and Carlson, *Momentum transport in
granular flows*. They show the largest number of grains and the shortest time step of a map that has
several. The force ratio is ⟨F⟩/⟨F_bc⟩, and the excess is ⟨F⟩/⟨F_bc⟩ − 1. The shear-stress ratio is
that of the contact stress to the binary stress, component xy. :func:`save_figures` also writes the
figures of :mod:`jaxgran.plotting.size`, :mod:`jaxgran.plotting.theory` and
:mod:`jaxgran.plotting.friction`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from jaxgran.maps.schema import (
    RATIO,
    MapData,
    finest,
    require_map,
    shear_stress_ratio,
    what_lacks,
)
from jaxgran.model.checks import InputError
from jaxgran.plotting.contours import (
    EXCESS_LEVELS,
    EXCESS_VALUES,
    add_plane_legend,
    contour_variable,
    draw_levels,
    draw_plane,
    excess_field,
)
from jaxgran.plotting.drawing import (
    ALPHA_LABEL,
    ALPHA_TITLE,
    LABEL_SIZE,
    NU_LABEL,
    ONE_COLUMN,
    RATIO_LABEL,
    TICK_SIZE,
    TWO_COLUMNS,
    add_curve_legend,
    curve_key,
    curve_styles,
    draw_points,
    empty_figure,
    finish,
    label_log_axis,
    missing_note,
    ordered,
    padded,
    require_plane,
    status_note,
    suspect,
)
from jaxgran.plotting.interpolation import (
    interpolated,
    interpolation_error,
    left_out_note,
    refined_axes,
)

MOST_TOGETHER = (
    8  # curves in one panel of the figures against the time step and the number of grains
)
_LOG_SPAN = 2.5  # largest over smallest force ratio at and above which the axis is logarithmic
_SHEAR_LABEL = r"shear-stress ratio $\Sigma^{xy}/\Sigma^{xy}_{\mathrm{bc}}$"
_BAND = "#e08214"
_BETWEEN: dict[str, Any] = {"facecolor": "#2b8cbe", "alpha": 0.25, "linewidth": 0.0}
_LEAST_CONTOURED = (
    0.02  # excess above which the error of interpolation is quoted, below the lowest level
)


def ratio_curves(data: MapData) -> Figure:
    """Return force ratio and shear-stress ratio against the packing fraction, one curve per
    restitution (Figure 1).

    Args:
      data: a map with `force_ratio`, `force_ratio_stderr` and, where present, `status`,
        `stress_ratio` and `stress_ratio_stderr`. The largest of several numbers of grains and the
        shortest of several time steps are drawn.

    Returns:
      Two panels with one scale, or one where the map has no `stress_ratio`. Error bars are one
      standard error; a point whose status is not `ok` is an open symbol in a ring.

    Raises:
      InputError: (a ValueError) the data are not a map.
    """
    data = require_map(data, *RATIO)
    data = _with_shear_stress_ratio(finest(ordered(data, "stress_ratio")))
    labels = {"force_ratio": RATIO_LABEL}
    if "shear_stress_ratio" in data:
        labels = {"force_ratio": f"(a) {RATIO_LABEL}", "shear_stress_ratio": f"(b) {_SHEAR_LABEL}"}
    figure = empty_figure(TWO_COLUMNS, height=3.0)
    grid = figure.subplots(1, len(labels), sharey=True, squeeze=False)[0]
    handles: list[Line2D] = []
    for axes, (name, label) in zip(grid, labels.items(), strict=True):
        axes.axhline(1.0, color="0.6", linewidth=0.8, zorder=0)
        styles = zip(data.restitution.values, curve_styles(data.sizes["restitution"]), strict=True)
        handles = [
            _draw_curve(
                axes, data.sel(restitution=value), "packing_fraction", style, f"{value:.4g}", name
            )
            for value, style in styles
        ]
        axes.set_xlim(padded(data.packing_fraction.values))
        axes.xaxis.set_major_locator(
            MaxNLocator(8, steps=(1, 2, 5, 10))
        )  # two digits, as more would touch
        axes.set_xlabel(NU_LABEL, fontsize=LABEL_SIZE)
        axes.set_ylabel(label, fontsize=LABEL_SIZE)
        axes.tick_params(labelleft=True)
    _set_ratio_scale(grid[0], np.concatenate([data[name].values for name in labels]))
    add_curve_legend(figure, data, handles, ALPHA_TITLE)
    measured = np.isfinite(data.force_ratio.values)
    finish(figure, data, measured, [status_note(data), missing_note(measured)])
    return figure


def ratio_contours(data: MapData) -> Figure:
    """Return the contours of the excess force ratio in the plane of 1 − α and ν (Figure 2).

    The contoured variable is asinh(excess/0.01). It is logarithmic for an excess well above 0.01,
    and linear below, where noise may make the excess negative. It is interpolated bilinearly
    between the grid points. A cell with a missing corner is hatched. A level has two bands: of the
    points whose excess differs from it by at most the interpolated standard error, and of those
    where it differs by at most the error of interpolation, as estimated from points that are left
    out.

    Args:
      data: as in :func:`ratio_curves`.

    Returns:
      The levels of `EXCESS_LEVELS` that the map reaches, labelled; the others are named under the
      axes.

    Raises:
      InputError: (a ValueError) fewer than two restitutions or two packing fractions.
    """
    data = require_map(data, *RATIO)
    require_plane(data)
    data = finest(ordered(data))
    x, y = refined_axes(data)
    excess, stderr = data.force_ratio.values - 1.0, data.force_ratio_stderr.values
    measured, field = np.isfinite(excess), excess_field(data)

    figure = empty_figure(ONE_COLUMN, height=3.6)
    axes = figure.add_subplot()
    _shade(axes, x, y, field)
    lines = draw_levels(axes, x, y, field, EXCESS_VALUES, colors="black", linewidths=1.1, zorder=3)
    values = [EXCESS_VALUES[level] for level in lines]
    widths = interpolation_error(data, contour_variable(excess))
    between = _draw_interpolation(axes, x, y, field, widths, values)
    banded = _draw_bands(axes, x, y, excess, stderr, values)
    draw_plane(axes, data, field, measured)
    axes.set_xlabel(ALPHA_LABEL, fontsize=LABEL_SIZE)
    axes.set_ylabel(NU_LABEL, fontsize=LABEL_SIZE)
    bands: list[Artist] = [Patch(facecolor=_BAND, alpha=0.45, label="± standard error")] * banded
    bands += [Patch(**_BETWEEN, label="± interpolation")] * between
    add_plane_legend(figure, data, measured, bands)
    absent = [level for level in EXCESS_LEVELS if level not in lines]
    found = left_out_note(data, [contour_variable(excess)], "the excess", excess > _LEAST_CONTOURED)
    notes = [_contour_note(absent), found, status_note(data), missing_note(measured, " (hatched)")]
    finish(figure, data, measured, notes)
    return figure


def ratio_against_timestep(data: MapData) -> Figure:
    """Return the force ratio against the time step, a curve for each restitution and packing
    fraction.

    Up to eight curves share one panel. With more, each packing fraction has a panel with its own
    force-ratio axis.

    Args:
      data: as in :func:`ratio_curves`, with a dimension `timestep` in units of 1/γ̇.

    Returns:
      Error bars are one standard error; a point whose status is not `ok` is an open symbol in a
      ring.

    Raises:
      InputError: (a ValueError) fewer than two time steps.
    """
    data = require_map(data, *RATIO)
    if data.sizes.get("timestep", 1) < 2:
        raise InputError(
            "this figure needs at least two time steps, and this map has "
            f"{data.sizes.get('timestep', 1)}."
        )
    data = finest(ordered(data), "grains")
    panels, title = point_panels(data)
    columns = math.ceil(math.sqrt(len(panels)))
    rows = math.ceil(len(panels) / columns)
    figure = empty_figure(TWO_COLUMNS, height=3.0 if len(panels) == 1 else 0.8 + 1.5 * rows)
    grid = list(figure.subplots(rows, columns, sharex=True, squeeze=False).flat)
    handles: list[Line2D] = []
    for axes, (name, curves) in zip(grid, panels, strict=False):
        axes.axhline(1.0, color="0.6", linewidth=0.8, zorder=0)
        styles = zip(curves, curve_styles(len(curves)), strict=True)
        handles = [
            _draw_curve(axes, curve, "timestep", style, label) for (label, curve), style in styles
        ]
        _set_ratio_scale(axes, np.concatenate([curve.force_ratio.values for _, curve in curves]))
        axes.set_title(name, fontsize=TICK_SIZE)
    for axes in grid[len(panels) :]:
        axes.remove()
    for axes in grid[max(0, len(panels) - columns) : len(panels)]:
        axes.tick_params(labelbottom=True)
        axes.set_xlabel(r"time step $\dot{\gamma}\,\mathrm{d}t$", fontsize=LABEL_SIZE)
    _set_timestep_scale(grid[0], data.timestep.values, most=9 if columns == 1 else 3)
    figure.supylabel(RATIO_LABEL, fontsize=LABEL_SIZE)
    add_curve_legend(figure, data, handles, title)
    measured = np.isfinite(data.force_ratio.values)
    finish(figure, data, measured, [status_note(data), missing_note(measured)])
    return figure


# ---------------------------------------------------------------------------------------------
# curves


def _with_shear_stress_ratio(data: xr.Dataset) -> xr.Dataset:
    """Return the map with component xy of the stress ratio as `shear_stress_ratio`, if it has the
    tensor.
    """
    names = ("stress_ratio", "stress_ratio_stderr")
    if what_lacks(data, *names) or not {"axis_a", "axis_b"} <= set(data.stress_ratio.dims):
        return data
    value, stderr = shear_stress_ratio(data)
    return data.assign(shear_stress_ratio=value, shear_stress_ratio_stderr=stderr)


def _draw_curve(
    axes: Axes, curve: xr.Dataset, along: str, style: dict, label: str, name: str = "force_ratio"
) -> Line2D:
    """Draw a ratio along a coordinate with its error bars and suspect points; return its legend
    entry.
    """
    ratio, stderr = curve[name].values, curve[f"{name}_stderr"].values
    draw_points(axes, curve[along].values, ratio, suspect(curve), style, yerr=stderr)
    return curve_key(style, label)


def _set_ratio_scale(axes: Axes, ratio: np.ndarray) -> None:
    """Make the force-ratio axis logarithmic, with plain numbers, if the values have a large enough
    range.
    """
    values = ratio[np.isfinite(ratio) & (ratio > 0.0)]
    span = values.max() / values.min() if values.size else 1.0
    if span < _LOG_SPAN:
        return
    axes.set_yscale("log")
    label_log_axis(axes.yaxis)


# ----------------------------------------------------------------------------------------- time
# steps


def point_panels(data: xr.Dataset) -> tuple[list[tuple[str, list[tuple[str, xr.Dataset]]]], str]:
    """Return the panels and the title of the legend; a panel is a name and its curves with their
    labels.
    """
    alphas, nus = data.restitution.values, data.packing_fraction.values
    if len(alphas) * len(nus) <= MOST_TOGETHER:
        curves = [
            (f"{alpha:.4g}, {nu:.4g}", data.sel(packing_fraction=nu, restitution=alpha))
            for nu in nus
            for alpha in alphas
        ]
        return [("", curves)], "α, ν"
    panels = [
        (
            f"ν = {nu:.4g}",
            [
                (f"{alpha:.4g}", data.sel(packing_fraction=nu, restitution=alpha))
                for alpha in alphas
            ],
        )
        for nu in nus
    ]
    return panels, ALPHA_TITLE


def _set_timestep_scale(axes: Axes, timesteps: np.ndarray, most: int) -> None:
    """Make the time-step axis logarithmic, with at most so many numbers."""
    axes.set_xscale("log")
    low, high = timesteps.min(), timesteps.max()
    margin = (high / low) ** 0.06
    axes.set_xlim(low / margin, high * margin)
    label_log_axis(axes.xaxis, most)


# -------------------------------------------------------------------------------------------
# contours


def _shade(axes: Axes, x: np.ndarray, y: np.ndarray, field: np.ma.MaskedArray) -> None:
    """Fill the intervals between the levels with faint greys, darker for a larger excess."""
    greys = [str(value) for value in np.linspace(1.0, 0.8, len(EXCESS_LEVELS) + 1)]
    axes.contourf(x, y, field, [-1e9, *EXCESS_VALUES.values(), 1e9], colors=greys, zorder=1)


def _draw_bands(
    axes: Axes,
    x: np.ndarray,
    y: np.ndarray,
    excess: np.ndarray,
    stderr: np.ndarray,
    values: Iterable[float],
) -> bool:
    """Shade where the contour variable agrees with a value within one standard error; return
    whether any was drawn.
    """
    low, middle, high = (
        interpolated(contour_variable(excess + k * stderr)) for k in (-1.0, 0.0, 1.0)
    )
    below, above = np.ma.maximum(middle - low, 1e-9), np.ma.maximum(high - middle, 1e-9)
    drawn = False
    for value in values:
        difference = value - middle
        in_errors = np.ma.where(difference > 0.0, difference / above, difference / below)
        if np.ma.min(abs(in_errors), fill_value=np.inf) < 1.0:
            axes.contourf(x, y, in_errors, [-1.0, 1.0], colors=[_BAND], alpha=0.45, zorder=2)
            drawn = True
    return drawn


def _draw_interpolation(
    axes: Axes,
    x: np.ndarray,
    y: np.ndarray,
    field: np.ma.MaskedArray,
    widths: np.ndarray,
    values: Iterable[float],
) -> bool:
    """Shade where the contour variable agrees with a value within the error of interpolation;
    return if anywhere.
    """
    distances = [abs(field - value) for value in values]
    if not distances or not widths.any():
        return False
    inside = widths - np.ma.min(np.ma.stack(distances), axis=0)
    axes.contourf(
        x,
        y,
        inside,
        [0.0, 1e9],
        colors=[_BETWEEN["facecolor"]],
        alpha=_BETWEEN["alpha"],
        zorder=1.5,
    )
    return bool(inside.max() > 0.0)


def _contour_note(absent: Sequence[float]) -> str:
    """Return the caption line of the contours, with the levels that the map does not reach."""
    note = r"Contours of $\langle F\rangle/\langle F_{\mathrm{bc}}\rangle-1$"
    return note + (
        f"; not reached: {', '.join(f'{level:.2f}' for level in absent)}" if absent else ""
    )
