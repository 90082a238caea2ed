"""The figures of a ratio map: curves of the force ratio, contours of its excess over one, and its time steps.

All are drawn from the dataset of :func:`jaxgran.ratio_map` without any global plotting state, so they
need no display. Curves and contours follow Figures 1 and 2 of Lois, Lemaître and Carlson, *Momentum transport
in granular flows*, and show the shortest time step of a map that has several; the third figure shows what the
time step does. The force ratio is ⟨F⟩/⟨F_bc⟩ and the excess is ⟨F⟩/⟨F_bc⟩ − 1.
"""

from __future__ import annotations

import math
import os
import textwrap
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.contour import QuadContourSet
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle
from matplotlib.path import Path as MplPath
from matplotlib.patheffects import withStroke
from matplotlib.ticker import FixedLocator, FuncFormatter, LogLocator, NullFormatter, NullLocator, StrMethodFormatter

EXCESS_LEVELS = (0.05, 0.10, 0.25, 0.50, 1.00)
"""Contour values of the excess, those of Figure 2."""

_LINEAR_BELOW = 0.01  # excess under which the contour variable turns from logarithmic to linear
_SUBDIVISIONS = 12  # steps of the bilinear interpolation between neighbouring grid points
_MOST_TOGETHER = 8  # points whose curves share one panel of the time steps
_LOG_SPAN = 2.5  # largest over smallest force ratio from which the axis is logarithmic
_MARKERS = "os^DvP<X>ph*"
_LINE_STYLES = ("-", (0, (5, 1.5)), (0, (4, 1.2, 1, 1.2)), (0, (2, 1)), (0, (1, 1)))
_LABEL, _TICK, _SMALL = 9.0, 8.0, 7.0  # font sizes in points
_RATIO_LABEL = r"force ratio $\langle F\rangle/\langle F_{\mathrm{bc}}\rangle$"
_BAND = "#e08214"
_RING: dict[str, Any] = {
    "linestyle": "none",
    "marker": "o",
    "markersize": 8.5,
    "markerfacecolor": "none",
    "markeredgecolor": "#b2182b",
    "markeredgewidth": 1.2,
}
_DOT: dict[str, Any] = {"linestyle": "none", "marker": "o", "color": "0.25", "markersize": 2, "markeredgewidth": 0}
_CROSS: dict[str, Any] = {"linestyle": "none", "marker": "x", "color": "0.25", "markersize": 5}


def ratio_curves(data: xr.Dataset) -> Figure:
    """Return the force ratio against the packing fraction, one curve per restitution (Figure 1).

    ======== =============================== =====================================================
    data     (packing_fraction, restitution) `force_ratio`, `force_ratio_stderr` (dimensionless)
                                             and, where present, the CF flag variable `status`;
                                             the shortest of several time steps is drawn
    returns  Figure                          error bars are one standard error; a point whose
                                             status is not `ok` is an open symbol in a ring
    ======== =============================== =====================================================
    """
    data = _finest(_ordered(data))
    figure, axes = _new_figure(width=5.0, height=3.5)
    axes.axhline(1.0, color="0.6", linewidth=0.8, zorder=0)
    styles = zip(data.restitution.values, _curve_styles(data.sizes["restitution"]), strict=True)
    handles = [
        _draw_curve(axes, data.sel(restitution=value), "packing_fraction", style, f"{value:.4g}")
        for value, style in styles
    ]
    _set_ratio_scale(axes, data.force_ratio.values)
    axes.set_xlim(_padded(data.packing_fraction.values))
    axes.set_xlabel(r"packing fraction $\nu$", fontsize=_LABEL)
    axes.set_ylabel(_RATIO_LABEL, fontsize=_LABEL)
    _add_curve_legend(figure, handles, "restitution α")
    if _suspect(data).any():
        figure.legend(handles=[_ring_key()], loc="outside upper left", fontsize=_SMALL, frameon=False)
    _finish(figure, data, [_status_note(data), _missing_note(data)])
    return figure


def ratio_contours(data: xr.Dataset) -> Figure:
    """Return the contours of the excess force ratio in the plane of 1 − α and ν (Figure 2).

    The contoured variable is asinh(excess/0.01), logarithmic for an excess well above 0.01 and linear
    below, where noise may make it negative. It is interpolated bilinearly between the grid points; a cell
    with a missing corner is hatched. The band of a level holds the points whose excess differs from it
    by at most the interpolated standard error.

    ======== =============================== =====================================================
    data     (packing_fraction, restitution) as in :func:`ratio_curves`
    returns  Figure                          each level of `EXCESS_LEVELS` that the map reaches is
                                             drawn and labelled; the others are named under the axes
    raises   ValueError                      fewer than two restitutions or two packing fractions
    ======== =============================== =====================================================
    """
    _require_plane(data)
    data = _finest(_ordered(data))
    x, y = _refined(1.0 - data.restitution.values), _refined(data.packing_fraction.values)
    excess, stderr = data.force_ratio.values - 1.0, data.force_ratio_stderr.values
    field = _interpolated(_contour_variable(excess))

    figure, axes = _new_figure(width=4.5, height=4.1)
    _shade(axes, x, y, field)
    _hatch(axes, x, y, field)
    lines = _draw_contours(axes, x, y, field)
    banded = _draw_bands(axes, x, y, excess, stderr, lines)
    _draw_grid_points(axes, data)
    axes.set_xlabel(r"$1-\alpha$", fontsize=_LABEL)
    axes.set_ylabel(r"packing fraction $\nu$", fontsize=_LABEL)
    axes.set_xlim(_padded(x))
    axes.set_ylim(_padded(y))
    _add_contour_legend(figure, data, banded)
    absent = [level for level in EXCESS_LEVELS if level not in lines]
    _finish(figure, data, [_contour_note(absent), _status_note(data), _missing_note(data, " (hatched)")])
    _label_contours(figure, axes, lines)
    return figure


def ratio_against_timestep(data: xr.Dataset) -> Figure:
    """Return the force ratio against the time step, a curve for each restitution and packing fraction.

    Up to eight points share one panel. More have one for each packing fraction, with a force-ratio axis of its own.

    ======== ========================================= =============================================
    data     (timestep, packing_fraction, restitution) as in :func:`ratio_curves`; `timestep` in
                                                       units of 1/γ̇
    returns  Figure                                    error bars are one standard error; a point
                                                       whose status is not `ok` is an open symbol in
                                                       a ring
    raises   ValueError                                fewer than two time steps
    ======== ========================================= =============================================
    """
    if not _has_timesteps(data):
        raise ValueError(
            f"this figure needs at least two time steps, and this map has {data.sizes.get('timestep', 1)}."
        )
    data = _ordered(data)
    panels, title = _timestep_panels(data)
    columns = math.ceil(math.sqrt(len(panels)))
    rows = math.ceil(len(panels) / columns)
    width, height = (5.0, 3.5) if len(panels) == 1 else (1.0 + 1.9 * columns, 1.0 + 1.6 * rows)
    figure = _empty_figure(width, height)
    grid = list(figure.subplots(rows, columns, sharex=True, squeeze=False).flat)
    handles: list[Line2D] = []
    for axes, (name, curves) in zip(grid, panels, strict=False):
        axes.axhline(1.0, color="0.6", linewidth=0.8, zorder=0)
        styles = zip(curves, _curve_styles(len(curves)), strict=True)
        handles = [_draw_curve(axes, curve, "timestep", style, label) for (label, curve), style in styles]
        _set_ratio_scale(axes, np.concatenate([curve.force_ratio.values for _, curve in curves]))
        axes.set_title(name, fontsize=_TICK)
    for axes in grid[len(panels) :]:
        axes.remove()
    for axes in grid[max(0, len(panels) - columns) : len(panels)]:
        axes.tick_params(labelbottom=True)
        axes.set_xlabel(r"time step $\dot{\gamma}\,\mathrm{d}t$", fontsize=_LABEL)
    _set_timestep_scale(grid[0], data.timestep.values)
    figure.supylabel(_RATIO_LABEL, fontsize=_LABEL)
    _add_curve_legend(figure, handles, title)
    if _suspect(data).any():
        figure.legend(handles=[_ring_key()], loc="outside upper left", fontsize=_SMALL, frameon=False)
    _finish(figure, data, [_status_note(data), _missing_note(data)])
    return figure


def save_figures(data: xr.Dataset, stem: Path | str) -> list[Path]:
    """Write `{stem}_curves.png`, `{stem}_contours.png` and `{stem}_timestep.png` and return the paths written.

    Each file appears whole or not at all. A map with a single restitution or packing fraction has no
    contours, and one with a single time step has nothing to draw against it: these are left out.

    ======== ============= =====================================================================
    data     Dataset       as in :func:`ratio_curves` or :func:`ratio_against_timestep`
    stem     path          folder and beginning of the names; the folder must exist
    returns  list of Path  the files written, the curves first
    ======== ============= =====================================================================
    """
    stem = Path(stem)
    written = [_write(ratio_curves(data), stem.with_name(f"{stem.name}_curves.png"))]
    if _is_plane(data):
        written.append(_write(ratio_contours(data), stem.with_name(f"{stem.name}_contours.png")))
    if _has_timesteps(data):
        written.append(_write(ratio_against_timestep(data), stem.with_name(f"{stem.name}_timestep.png")))
    return written


# ---------------------------------------------------------------------------------------------- data


def _ordered(data: xr.Dataset) -> xr.Dataset:
    """Return the variables drawn here, as ([timestep,] packing_fraction, restitution), all ascending."""
    names = [name for name in ("force_ratio", "force_ratio_stderr", "status") if name in data]
    dims = [name for name in ("timestep", "packing_fraction", "restitution") if name in data.dims]
    ordered = data[names].sortby(dims).transpose(*dims)
    return ordered.assign_attrs({"seeds": data.sizes.get("seed")} | data.attrs)


def _finest(data: xr.Dataset) -> xr.Dataset:
    """Return the shortest time step of an ordered map, as its attribute `timestep`."""
    if "timestep" not in data.coords:
        return data
    data = data.isel(timestep=0) if "timestep" in data.dims else data
    return data.assign_attrs(timestep=float(data.timestep))


def _has_timesteps(data: xr.Dataset) -> bool:
    return data.sizes.get("timestep", 1) >= 2


def _is_plane(data: xr.Dataset) -> bool:
    return min(data.sizes["restitution"], data.sizes["packing_fraction"]) >= 2


def _require_plane(data: xr.Dataset) -> None:
    if not _is_plane(data):
        raise ValueError(
            "contours need at least two restitutions and two packing fractions, "
            f"and this map has {data.sizes['restitution']} and {data.sizes['packing_fraction']}."
        )


def _status_names(data: xr.Dataset) -> np.ndarray:
    """Return the name of every point's status, as text of shape (packing_fraction, restitution)."""
    if "status" not in data:
        return np.full(data.force_ratio.shape, "ok", dtype=object)
    attrs = data.status.attrs
    values = np.atleast_1d(attrs["flag_values"]).tolist()
    names = dict(zip(values, attrs["flag_meanings"].split(), strict=True))
    codes = data.status.values
    return np.array([names.get(code, f"status {code}") for code in codes.flat], object).reshape(codes.shape)


def _suspect(data: xr.Dataset) -> np.ndarray:
    """Return where a point has a value, and a status that is not `ok`."""
    return np.isfinite(data.force_ratio.values) & (_status_names(data) != "ok")


def _contour_variable(excess: np.ndarray) -> np.ndarray:
    """Return asinh(excess/0.01): monotone, nearly log(excess) where it matters, defined below zero."""
    return np.arcsinh(excess / _LINEAR_BELOW)


def _refinement(count: int) -> np.ndarray:
    """Return the matrix (fine, count) of linear interpolation onto a subdivided axis."""
    position = np.linspace(0.0, count - 1.0, (count - 1) * _SUBDIVISIONS + 1)
    return np.maximum(0.0, 1.0 - np.abs(position[:, None] - np.arange(count)))


def _refined(axis: np.ndarray) -> np.ndarray:
    return _refinement(len(axis)) @ axis


def _interpolated(field: np.ndarray) -> np.ma.MaskedArray:
    """Return the bilinear refinement of a field, masked where a missing point would contribute."""
    rows, columns = (_refinement(count) for count in field.shape)
    missing = ~np.isfinite(field)
    values = rows @ np.where(missing, 0.0, field) @ columns.T
    return np.ma.masked_array(values, mask=rows @ missing @ columns.T > 0.0)


# --------------------------------------------------------------------------------------------- curves


def _curve_styles(count: int) -> list[dict]:
    """Return a colour, marker and line style for each curve; the colours also differ in grey."""
    ramp = colormaps["viridis"](np.linspace(0.0, 0.82, count))
    return [
        {
            "color": tuple(ramp[k]),
            "marker": _MARKERS[k % len(_MARKERS)],
            "linestyle": _LINE_STYLES[k % len(_LINE_STYLES)],
        }
        for k in range(count)
    ]


def _draw_curve(axes: Axes, curve: xr.Dataset, along: str, style: dict, label: str) -> Line2D:
    """Draw one curve along a coordinate with its error bars and suspect points; return its legend entry."""
    axes.errorbar(
        curve[along].values,
        curve.force_ratio.values,
        yerr=curve.force_ratio_stderr.values,
        **style,
        markersize=4,
        linewidth=1.1,
        elinewidth=0.8,
        capsize=2,
    )
    bad = curve.isel({along: _suspect(curve)})
    axes.plot(
        bad[along].values,
        bad.force_ratio.values,
        linestyle="none",
        marker=style["marker"],
        markersize=4,
        markerfacecolor="white",
        markeredgecolor=style["color"],
        zorder=4,
    )
    _mark_bad(axes, bad[along].values, bad.force_ratio.values)
    return Line2D([], [], **style, markersize=4, linewidth=1.1, label=label)


def _mark_bad(axes: Axes, x: np.ndarray, y: np.ndarray) -> None:
    """Put a ring around points whose status is not `ok`."""
    if len(x):
        axes.plot(x, y, **_RING, zorder=5)


def _ring_key() -> Line2D:
    return Line2D([], [], **_RING, label="status not ok")


def _add_curve_legend(figure: Figure, handles: Sequence[Line2D], title: str) -> None:
    """Name the curves beside the axes."""
    figure.legend(
        handles=handles,
        title=title,
        loc="outside right upper",
        ncols=1 + (len(handles) - 1) // 16,
        fontsize=_SMALL + 0.5,
        title_fontsize=_TICK,
        frameon=False,
        handlelength=3.2,
    )


def _set_ratio_scale(axes: Axes, ratio: np.ndarray) -> None:
    """Make the force-ratio axis logarithmic, with plain numbers, where the values span enough."""
    values = ratio[np.isfinite(ratio) & (ratio > 0.0)]
    span = values.max() / values.min() if values.size else 1.0
    if span < _LOG_SPAN:
        return
    axes.set_yscale("log")
    subs = (1, 1.5, 2, 3, 4, 6, 8) if span < 12 else (1, 2, 5)
    axes.yaxis.set_major_locator(LogLocator(subs=subs))
    axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.yaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_minor_formatter(NullFormatter())


# ----------------------------------------------------------------------------------------- time steps


def _timestep_panels(data: xr.Dataset) -> tuple[list[tuple[str, list[tuple[str, xr.Dataset]]]], str]:
    """Return the panels, each a name and its curves with their labels, and the title of the labels."""
    alphas, nus = data.restitution.values, data.packing_fraction.values
    if len(alphas) * len(nus) <= _MOST_TOGETHER:
        curves = [
            (f"{alpha:.4g}, {nu:.4g}", data.sel(packing_fraction=nu, restitution=alpha))
            for nu in nus
            for alpha in alphas
        ]
        return [("", curves)], "α, ν"
    panels = [
        (f"ν = {nu:.4g}", [(f"{alpha:.4g}", data.sel(packing_fraction=nu, restitution=alpha)) for alpha in alphas])
        for nu in nus
    ]
    return panels, "restitution α"


def _set_timestep_scale(axes: Axes, timesteps: np.ndarray) -> None:
    """Make the time-step axis logarithmic; where it has no two powers of ten, its ends are labelled."""
    axes.set_xscale("log")
    low, high = timesteps.min(), timesteps.max()
    margin = (high / low) ** 0.06
    axes.set_xlim(low / margin, high * margin)
    powers = math.floor(math.log10(high) + 1e-9) - math.ceil(math.log10(low) - 1e-9)
    if powers < 1:
        axes.xaxis.set_major_locator(FixedLocator([low, high]))
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"${_scientific(value)}$"))
    axes.xaxis.set_minor_formatter(NullFormatter())


# ------------------------------------------------------------------------------------------- contours


def _shade(axes: Axes, x: np.ndarray, y: np.ndarray, field: np.ma.MaskedArray) -> None:
    """Fill the intervals between the levels with faint greys, darker for a larger excess."""
    greys = [str(value) for value in np.linspace(1.0, 0.8, len(EXCESS_LEVELS) + 1)]
    bounds = [-1e9, *_contour_variable(np.array(EXCESS_LEVELS)), 1e9]
    axes.contourf(x, y, field, bounds, colors=greys, zorder=1)


def _hatch(axes: Axes, x: np.ndarray, y: np.ndarray, field: np.ma.MaskedArray) -> None:
    """Hatch the part of the map that has no interpolated value."""
    if np.ma.is_masked(field):
        area = Rectangle((x.min(), y.min()), np.ptp(x), np.ptp(y))
        area.set(facecolor="none", edgecolor="0.75", hatch="/////", linewidth=0.0, zorder=0.5)
        axes.add_patch(area)


def _draw_contours(axes: Axes, x: np.ndarray, y: np.ndarray, field: np.ma.MaskedArray) -> dict[float, QuadContourSet]:
    """Draw the levels that the field crosses, and return the lines of each."""
    lines = {}
    for level in EXCESS_LEVELS:
        value = float(_contour_variable(np.array(level)))
        if field.count() and field.min() < value < field.max():
            lines[level] = axes.contour(x, y, field, [value], colors="black", linewidths=1.1, zorder=3)
    return {level: drawn for level, drawn in lines.items() if len(drawn.get_paths()[0])}


def _draw_bands(
    axes: Axes,
    x: np.ndarray,
    y: np.ndarray,
    excess: np.ndarray,
    stderr: np.ndarray,
    levels: Iterable[float],
) -> bool:
    """Shade where the excess agrees with a level within one standard error; return whether any was drawn."""
    low, middle, high = (_interpolated(_contour_variable(excess + k * stderr)) for k in (-1.0, 0.0, 1.0))
    below, above = np.ma.maximum(middle - low, 1e-9), np.ma.maximum(high - middle, 1e-9)
    drawn = False
    for level in _contour_variable(np.array(list(levels))):
        away = level - middle
        in_errors = np.ma.where(away > 0.0, away / above, away / below)
        if np.ma.min(abs(in_errors), fill_value=np.inf) < 1.0:
            axes.contourf(x, y, in_errors, [-1.0, 1.0], colors=[_BAND], alpha=0.45, zorder=2)
            drawn = True
    return drawn


def _label_contours(figure: Figure, axes: Axes, lines: Mapping[float, QuadContourSet]) -> None:
    """Write each level on its curve, where it is farthest from the other curves, the ends and the frame."""
    figure.canvas.draw()  # fixes the layout, so that distances on the page are known
    to_page = axes.transData
    paths = {level: to_page.transform_path(drawn.get_paths()[0]) for level, drawn in lines.items()}
    for level, drawn in lines.items():
        others = [_thinned(path) for other, path in paths.items() if other != level]
        x, y = to_page.inverted().transform(_open_place(paths[level], others, np.array(axes.bbox.extents)))
        labels = drawn.clabel(
            fontsize=_SMALL + 0.5,
            fmt=f"{level:.2f}",
            inline_spacing=2,
            manual=[(float(x), float(y))],
            zorder=6,
        )
        for label in labels:
            label.set_path_effects([withStroke(linewidth=2, foreground="white")])


def _thinned(path: MplPath) -> np.ndarray:
    """Return at most 400 vertices of a path, evenly taken."""
    return np.asarray(path.vertices)[:: 1 + len(path) // 400]


def _open_place(path: MplPath, others: Sequence[np.ndarray], frame: np.ndarray) -> np.ndarray:
    """Return the vertex of a path, in pixels, that keeps the largest clearance.

    A label lies along its curve, so the ends of the curve and the frame are to be twice as far as other curves.
    """
    places = _thinned(path)
    starts = np.flatnonzero(path.codes == MplPath.MOVETO)
    ends = np.asarray(path.vertices)[np.concatenate([starts, starts - 1])]
    to_frame = np.minimum(places - frame[:2], frame[2:] - places).min(axis=1)
    clearances = [to_frame / 2, _distance(places, ends) / 2, *(_distance(places, other) for other in others)]
    return places[np.argmax(np.minimum.reduce(clearances))]


def _distance(places: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return the distance from each place to the nearest of the others."""
    return np.linalg.norm(places[:, None] - others, axis=-1).min(axis=1)


def _draw_grid_points(axes: Axes, data: xr.Dataset) -> None:
    """Draw the measured points as dots, in rings where their status is not `ok`; crosses for the missing."""
    x, y = np.meshgrid(1.0 - data.restitution.values, data.packing_fraction.values)
    measured = np.isfinite(data.force_ratio.values)
    axes.plot(x[measured], y[measured], **_DOT, zorder=4)
    axes.plot(x[~measured], y[~measured], **_CROSS, zorder=4)
    suspect = _suspect(data)
    _mark_bad(axes, x[suspect], y[suspect])


def _add_contour_legend(figure: Figure, data: xr.Dataset, banded: bool) -> None:
    """Explain above the axes the symbols that occur in the map."""
    measured = np.isfinite(data.force_ratio.values)
    entries = [
        (measured.any(), Line2D([], [], **_DOT, label="measured")),
        (banded, Patch(facecolor=_BAND, alpha=0.45, label="± standard error")),
        (_suspect(data).any(), _ring_key()),
        (not measured.all(), Line2D([], [], **_CROSS, label="no value")),
    ]
    figure.legend(
        handles=[handle for occurs, handle in entries if occurs],
        loc="outside upper center",
        ncols=len(entries),
        fontsize=_SMALL,
        frameon=False,
        handlelength=1.2,
        columnspacing=1.5,
    )


# ------------------------------------------------------------------------------------- frame and text


def _empty_figure(width: float, height: float) -> Figure:
    """Return a figure of a size in inches that draws without a display."""
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _new_figure(width: float, height: float) -> tuple[Figure, Axes]:
    """Return an empty figure and its only axes."""
    figure = _empty_figure(width, height)
    return figure, figure.add_subplot()


def _run_description(attrs: dict) -> str:
    """Return the parameters without which a force ratio means nothing, in one line; several time steps have an axis."""
    parts = [f"$N={attrs['grains']}$"] if "grains" in attrs else []
    if attrs.get("seeds") is not None:
        parts.append("1 seed" if attrs["seeds"] == 1 else f"{attrs['seeds']} seeds")
    if np.ndim(attrs.get("timestep", ())) == 0:
        parts.append(rf"$\mathrm{{d}}t={_scientific(float(attrs['timestep']))}/\dot{{\gamma}}$")
    if "activation" in attrs:
        parts.append(f"{attrs['activation']} activation")
    if "strain" in attrs:
        parts.append(f"strain {float(attrs['strain']):g} per seed")
    return ", ".join(parts)


def _scientific(value: float) -> str:
    """Return a number as mathematical text, such as 3 × 10⁻⁴."""
    mantissa, exponent = f"{value:.2e}".split("e")
    power = rf"10^{{{int(exponent)}}}"
    return power if float(mantissa) == 1.0 else rf"{float(mantissa):g}\times {power}"


def _contour_note(absent: Sequence[float]) -> str:
    note = r"Contours of $\langle F\rangle/\langle F_{\mathrm{bc}}\rangle-1$"
    return note + (f"; not reached: {', '.join(f'{level:.2f}' for level in absent)}" if absent else "")


def _status_note(data: xr.Dataset) -> str:
    """Return how many points carry each status that is not `ok`."""
    counts = Counter(name for name in _status_names(data).flat if name != "ok")
    words = ", ".join(f"{name.replace('_', ' ')} ({count})" for name, count in counts.most_common())
    return textwrap.fill(f"Status not ok: {words}", width=75) if counts else ""


def _missing_note(data: xr.Dataset, how_drawn: str = "") -> str:
    missing = int((~np.isfinite(data.force_ratio.values)).sum())
    return f"{missing} of {data.force_ratio.size} points without a value{how_drawn}" if missing else ""


def _padded(values: np.ndarray) -> tuple[float, float]:
    """Return the limits of an axis, with room for the symbols at its ends."""
    margin = 0.025 * np.ptp(values) or 0.01
    return float(values.min() - margin), float(values.max() + margin)


def _finish(figure: Figure, data: xr.Dataset, notes: Sequence[str]) -> None:
    """Set the tick style and write the caption lines under the axes."""
    measured = np.isfinite(data.force_ratio.values).any()
    for axes in figure.axes:
        axes.tick_params(which="both", direction="in", top=True, right=True, labelsize=_TICK)
        if not measured:
            box = {"facecolor": "white", "edgecolor": "none"}
            axes.text(0.5, 0.6, "no measured values", transform=axes.transAxes, ha="center", fontsize=_LABEL, bbox=box)
    caption = "\n".join(line for line in (_run_description(data.attrs), *notes) if line)
    figure.supxlabel(caption, fontsize=_SMALL)


def _write(figure: Figure, path: Path) -> Path:
    """Write a figure as PNG under a temporary name beside its place, then move it there."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        figure.savefig(temporary, format="png", dpi=200)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
    return path
