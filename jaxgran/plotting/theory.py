"""The errors of kinetic theory and their two causes, and the share of the stress in clusters, over
the plane.

The figures show the largest number of grains and the shortest time step of a map that has several.
The excess is ⟨F⟩/⟨F_bc⟩ − 1, that of the force ratio over one. In the plane of 1 − α and ν its
contours are drawn on top of each figure.
"""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from jaxgran.maps.schema import RATIO, MapData, finest, require_map, what_lacks
from jaxgran.plotting.contours import (
    EXCESS_LEVELS,
    add_plane_legend,
    draw_excess,
    draw_levels,
    draw_plane,
    excess_keys,
    excess_style,
)
from jaxgran.plotting.drawing import (
    ALPHA_LABEL,
    ALPHA_TITLE,
    LABEL_SIZE,
    NU_LABEL,
    ONE_COLUMN,
    PANEL_TITLE,
    SMALL_SIZE,
    TWO_COLUMNS,
    add_ring_legend,
    curve_key,
    curve_styles,
    empty_figure,
    finish,
    is_plane,
    label_log_axis,
    mark_bad,
    missing_note,
    ordered,
    require_plane,
    status_note,
    suspect,
)
from jaxgran.plotting.interpolation import interpolated, left_out_note, refined_axes

ERROR_LEVELS = {
    "÷10": np.log(0.1),
    "÷5": np.log(0.2),
    "−50 %": np.log(0.5),
    "−25 %": np.log(0.75),
    "−10 %": np.log(0.9),
    "−5 %": np.log(0.95),
    "+5 %": np.log(1.05),
    "+10 %": np.log(1.1),
    "+25 %": np.log(1.25),
    "+50 %": np.log(1.5),
    "×2": np.log(2.0),
    "×5": np.log(5.0),
    "×10": np.log(10.0),
}
"""Contour values of the logarithm of a quotient, by their labels."""

SHARE_LEVELS = (0.05, 0.10, 0.25, 0.50, 0.75, 0.90)
"""Contour values of the share of clusters."""

_QUANTITIES = {"pressure": "pressure", "shear_stress": "shear stress"}
_STRESSES = [
    *(f"{part}{name}" for name in _QUANTITIES for part in ("", "theory/")),
    *("stresses/kinetic_stress", "stresses/binary_stress"),
]
_STRESSES_NEEDED = (
    *_STRESSES,
    *(f"{name}_stderr" for name in _QUANTITIES),
    "stress_ratio",
    "stress_ratio_stderr",
)
SHARES = [
    f"stresses/cluster_{name}_share{end}"
    for name in ("pressure", "shear")
    for end in ("", "_stderr")
]
_LEAST_EXCESS = 1e-5  # smallest excess that its logarithmic axis shows
# share of clusters above which the error of interpolation is quoted, below the lowest level
_LEAST_SHARE = 0.02
_EXCESS_LABEL = r"excess $\langle F\rangle/\langle F_{\mathrm{bc}}\rangle-1$"
_CLUSTER_NOTE = "Share of the contact stress in clusters of three or more grains"
_THEORY_NOTE = "Black contours: quotient, or less one in % (dashed where negative); (a) = (b) × (c)"


def has_theory(data: xr.Dataset) -> bool:
    """Return whether a map has the variables that :func:`theory_errors` draws."""
    return not what_lacks(data, *RATIO, *_STRESSES_NEEDED)


def has_clusters(data: xr.Dataset) -> bool:
    """Return whether a map has the variables that :func:`cluster_shares` draws."""
    return not what_lacks(data, *RATIO, *SHARES)


# ----------------------------------------------------------------------------------------------
# theory


def error_parts(data: xr.Dataset, quantity: str) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return the error of the theory in `pressure` or `shear_stress`, its two parts, and their
    standard errors.

    ========== ============================ ========================================================
    name       value                        source of the standard error
    ========== ============================ ========================================================
    total      ln(theory/measured)          measured stress
    assumption ln(binary/measured)          measured ratio of contact to binary stress
    closure    ln(theory/binary)            kinetic and binary stress; their errors are added
    ========== ============================ ========================================================

    Binary is the measured kinetic stress plus the contact stress if all collisions were binary. The
    total is the sum of the other two. All are NaN where a quotient is not positive or not known.
    """
    components = [(0, 0), (1, 1)] if quantity == "pressure" else [(0, 1)]

    def part_of(tensor: xr.DataArray) -> np.ndarray:
        return np.mean([tensor.isel(axis_a=a, axis_b=b).values for a, b in components], axis=0)

    measured, theory, stderr = (
        data[name].values for name in (quantity, f"theory/{quantity}", f"{quantity}_stderr")
    )
    sign = 1 if quantity == "pressure" else -1
    kinetic, collisional = (
        sign * part_of(data[f"stresses/{name}_stress"]) for name in ("kinetic", "binary")
    )
    errors = [f"stresses/{name}_stress_stderr" for name in ("kinetic", "binary")]
    kinetic_error, collisional_error = (
        part_of(data[name]) if name in data else np.zeros(()) for name in errors
    )
    ratio_error = part_of(np.abs(data.stress_ratio_stderr / data.stress_ratio))
    binary = kinetic + collisional
    with np.errstate(divide="ignore", invalid="ignore"):
        parts = {
            "total": (np.log(theory / measured), stderr / measured),
            "assumption": (np.log(binary / measured), collisional / binary * ratio_error),
            "closure": (np.log(theory / binary), (kinetic_error + collisional_error) / binary),
        }
    return {
        name: (np.where(np.isfinite(value), value, np.nan), error)
        for name, (value, error) in parts.items()
    }


def theory_errors(data: MapData) -> Figure:
    """Return the error of kinetic theory in the plane of 1 − α and ν, and its two parts.

    The rows are pressure and shear stress. The columns are the total error, the part of the binary
    assumption and that of the closure, as in :func:`error_parts`. Black contours have the error as
    their label; they are dashed where the theory is too low. In dotted areas the error is smaller
    than its standard error. Green contours show the excess of the force ratio. The theory is the
    Enskog balance of the second moments of anisotropic Gaussian velocities, for each size class.

    Args:
      data: a map with what :func:`error_parts` needs, `force_ratio` and `status`.

    Raises:
      InputError: (a ValueError) fewer than two restitutions or two packing fractions.
    """
    data = require_map(data, *RATIO, *_STRESSES_NEEDED)
    require_plane(data)
    data = finest(ordered(data, *_STRESSES, "stress_ratio"))
    titles = (
        "(a) total: theory/measured",
        "(b) collisions: binary/measured",
        "(c) closure: theory/binary",
    )
    figure = empty_figure(TWO_COLUMNS, height=5.3)
    grid = figure.subplots(2, 3, sharex=True, sharey=True)
    fields, noisy, over = [], False, []
    measured = np.ones(data.force_ratio.shape, bool)
    for axes, title in zip(grid[0], titles, strict=True):
        axes.set_title(title, **PANEL_TITLE)
    for axes in grid[1]:
        axes.set_xlabel(ALPHA_LABEL, fontsize=LABEL_SIZE)
    for row, quantity in zip(grid, _QUANTITIES, strict=True):
        parts = error_parts(data, quantity)
        measured &= np.isfinite(parts["total"][0])
        for axes, (value, error) in zip(row, parts.values(), strict=True):
            noisy |= draw_errors(axes, data, value, error)
            fields.append(value)
            over = draw_excess(axes, data)
        row[0].set_ylabel(f"{_QUANTITIES[quantity]}\n{NU_LABEL}", fontsize=LABEL_SIZE)
    add_plane_legend(figure, data, measured, [*(noise_keys() if noisy else []), *excess_keys(over)])
    found = left_out_note(data, fields, "each quotient")
    finish(
        figure,
        data,
        measured,
        [_THEORY_NOTE, found, status_note(data), missing_note(measured, " (hatched)")],
    )
    return figure


def noise_keys() -> list[Patch]:
    """Return the legend entry of the areas that ``draw_errors`` has dotted."""
    return [
        Patch(
            facecolor="white",
            edgecolor="0.5",
            hatch="....",
            linewidth=0,
            label="within ± std. error",
        )
    ]


def draw_errors(axes: Axes, data: xr.Dataset, value: np.ndarray, error: np.ndarray) -> bool:
    """Draw contours and faint shades of an error, the logarithm of a quotient.

    Return whether the error is anywhere smaller than its standard error.
    """
    x, y = refined_axes(data)
    field = interpolated(value)
    bounds = [-1e9, *ERROR_LEVELS.values(), 1e9]
    tints = 0.55 + 0.45 * colormaps["PuOr_r"](np.linspace(0.12, 0.88, len(bounds) - 1))
    axes.contourf(x, y, field, bounds, colors=tints, zorder=1)
    in_errors = field / np.ma.maximum(interpolated(error), 1e-12)
    hidden = bool(np.ma.min(abs(in_errors), fill_value=np.inf) < 1.0)
    if hidden:
        dots = axes.contourf(
            x, y, in_errors, [-1.0, 1.0], colors="none", hatches=["...."], zorder=2
        )
        dots.set_edgecolor("0.5")
        dots.set_linewidth(0.0)
    dashes = ["-" if level > 0.0 else "--" for level in ERROR_LEVELS.values()]
    style = {"colors": "black", "linewidths": 0.9, "linestyles": dashes, "zorder": 3}
    draw_levels(axes, x, y, field, ERROR_LEVELS, **style)
    draw_plane(axes, data, field, np.isfinite(value))
    return hidden


# --------------------------------------------------------------------------------------------
# clusters


def cluster_shares(data: MapData) -> Figure:
    """Return the share of the contact stress that clusters of three or more grains carry, against
    the excess.

    Left: shares of pressure and shear stress against the excess of the force ratio, with a curve
    per restitution and a symbol per packing fraction. Right, if the map is a plane: contours of the
    share of the pressure, and in green those of the excess.

    Args:
      data: a map with `stresses/cluster_pressure_share`, `stresses/cluster_shear_share` and
        `force_ratio`, with `_stderr`, and `status`.

    Returns:
      Error bars are one standard error, in both directions.
    """
    data = require_map(data, *RATIO, *SHARES)
    data = finest(ordered(data, "stresses/cluster_pressure_share", "stresses/cluster_shear_share"))
    shares = {
        "pressure": "stresses/cluster_pressure_share",
        "shear stress": "stresses/cluster_shear_share",
    }
    measured = np.isfinite(data["stresses/cluster_pressure_share"].values)
    plane = is_plane(data)
    entries = data.sizes["restitution"] + data.sizes["packing_fraction"]
    figure = empty_figure(
        TWO_COLUMNS if plane else ONE_COLUMN, height=max(3.8, 1.1 + 0.15 * entries)
    )
    axes = figure.subplot_mosaic(
        "pm;sm" if plane else "p;s", width_ratios=(1.0, 1.15) if plane else None
    )
    axes["s"].sharex(axes["p"])
    for name, (quantity, share) in zip("ps", shares.items(), strict=True):
        _draw_shares(axes[name], data, share)
        axes[name].set_ylabel(f"share of {quantity}", fontsize=LABEL_SIZE)
    axes["p"].tick_params(labelbottom=False)
    axes["s"].set_xlabel(_EXCESS_LABEL, fontsize=LABEL_SIZE)
    left_out = int((measured & ~_set_excess_scale(axes["p"], data)).sum())
    if plane:
        over = _draw_share_plane(axes["m"], data, measured)
        add_plane_legend(figure, data, measured, excess_keys(over))
    else:
        add_ring_legend(figure, data, "outside upper right")
    _add_share_legend(figure, data)
    beyond = (
        f"{left_out} of {measured.size} points have an excess too small for its axis"
        if left_out
        else ""
    )
    share = data["stresses/cluster_pressure_share"].values
    found = left_out_note(data, [share], "the pressure", share > _LEAST_SHARE) if plane else ""
    finish(
        figure,
        data,
        measured,
        [_CLUSTER_NOTE, beyond, found, status_note(data), missing_note(measured)],
    )
    return figure


def _draw_shares(axes: Axes, data: xr.Dataset, name: str) -> None:
    """Draw a share against the excess: a line for each restitution, a symbol for each packing
    fraction.
    """
    axes.set_xscale("log")
    axes.set_xlim(_LEAST_EXCESS, 1.0)  # the range of a map without a positive excess
    styles, symbols = (
        curve_styles(data.sizes[name]) for name in ("restitution", "packing_fraction")
    )
    excess, share, bad = data.force_ratio.values - 1.0, data[name].values, suspect(data)
    x_error, y_error = data.force_ratio_stderr.values, data[f"{name}_stderr"].values
    for k, style in enumerate(styles):
        errors = {"xerr": x_error[:, k], "yerr": y_error[:, k], "elinewidth": 0.8}
        line = {"color": style["color"], "linestyle": style["linestyle"], "linewidth": 0.9}
        axes.errorbar(excess[:, k], share[:, k], **errors, **line, zorder=2)
    colours = [style["color"] for style in styles]
    for k, symbol in enumerate(symbols):
        faces = [
            "white" if open_ else colour for open_, colour in zip(bad[k], colours, strict=True)
        ]
        mark = {"marker": symbol["marker"], "s": 16, "facecolors": faces, "edgecolors": colours}
        axes.scatter(excess[k], share[k], **mark, zorder=4)
    mark_bad(axes, excess[bad], share[bad])
    for level in EXCESS_LEVELS:
        axes.axvline(level, **(excess_style(level) | {"zorder": 0.5, "alpha": 0.3}))
    axes.set_ylim(-0.03, 1.03)
    axes.set_yticks((0.0, 0.25, 0.5, 0.75, 1.0))
    axes.grid(axis="y", color="0.9", linewidth=0.6, zorder=0)


def _set_excess_scale(axes: Axes, data: xr.Dataset) -> np.ndarray:
    """Set the range of the logarithmic axis of the excess from the data, and return which points
    lie on it.
    """
    excess, stderr = data.force_ratio.values - 1.0, np.nan_to_num(data.force_ratio_stderr.values)
    shown = excess >= _LEAST_EXCESS
    if shown.any():
        low, high = excess[shown].min() / 1.6, (excess + stderr)[shown].max() * 1.3
        axes.set_xlim(low, high)
        label_log_axis(axes.xaxis)
    return shown


def _draw_share_plane(axes: Axes, data: xr.Dataset, measured: np.ndarray) -> list[float]:
    """Draw the share of the pressure in the plane; return the contours of the excess that it
    has.
    """
    x, y = refined_axes(data)
    field = interpolated(data["stresses/cluster_pressure_share"].values)
    greys = [str(value) for value in np.linspace(1.0, 0.8, len(SHARE_LEVELS) + 1)]
    axes.contourf(x, y, field, [-1e9, *SHARE_LEVELS, 1e9], colors=greys, zorder=1)
    levels = {f"{level:.2f}": level for level in SHARE_LEVELS}
    draw_levels(axes, x, y, field, levels, colors="black", linewidths=1.0, zorder=3)
    over = draw_excess(axes, data)
    draw_plane(axes, data, field, measured)
    axes.set_xlabel(ALPHA_LABEL, fontsize=LABEL_SIZE)
    axes.set_ylabel(NU_LABEL, fontsize=LABEL_SIZE)
    axes.set_title("share of pressure", **PANEL_TITLE)
    return over


def _add_share_legend(figure: Figure, data: xr.Dataset) -> None:
    """Explain the lines and the symbols of the shares beside their panels."""
    lines = zip(data.restitution.values, curve_styles(data.sizes["restitution"]), strict=True)
    symbols = zip(
        data.packing_fraction.values, curve_styles(data.sizes["packing_fraction"]), strict=True
    )
    plain = {"linestyle": "none", "color": "0.3"}
    by_alpha = [curve_key(style | {"marker": ""}, f"{alpha:.4g}") for alpha, style in lines]
    by_nu = [curve_key(style | plain, f"{nu:.4g}") for nu, style in symbols]
    heading = Line2D([], [], linestyle="none", label=NU_LABEL)
    figure.legend(
        handles=[*by_alpha, heading, *by_nu[::-1]],
        title=ALPHA_TITLE,
        loc="outside left upper",
        fontsize=SMALL_SIZE + 0.5,
        title_fontsize=SMALL_SIZE + 0.5,
        alignment="left",
        frameon=False,
        handlelength=3.2,
    )
