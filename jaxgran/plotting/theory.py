"""Where kinetic theory fails, and the clusters that carry the stress there.

The figures show the largest number of grains and the shortest time step of a map that has several.
A green line in a plane is where the force ratio is 1.05: up to it collisions are binary.
"""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from jaxgran.maps.schema import RATIO, MapData, what_lacks
from jaxgran.model.choices import HALF_INTERVAL
from jaxgran.model.display import counted
from jaxgran.plotting.plane import (
    BINARY_EXCESS,
    Legend,
    add_plane_legend,
    draw_binary_limit,
    draw_plane,
    label_axes,
)
from jaxgran.plotting.selection import describe, is_plane, require_plane, selection, suspect
from jaxgran.plotting.style import (
    ALPHA_TITLE,
    ONE_COLUMN,
    RING,
    TWO_COLUMNS,
    draw_points,
    empty_figure,
    label_log_axis,
    styled,
)

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

SHARE_LEVELS = {f"{level:.2f}": level for level in (0.05, 0.10, 0.25, 0.50, 0.75, 0.90)}
"""Contour values of the share of clusters, by their labels."""

_QUANTITIES = {"pressure": "pressure", "shear_stress": "shear stress"}
_MEASURED = (*_QUANTITIES, "stress_ratio")
_LARGE = tuple(f"{name}_large_system{end}" for name in _QUANTITIES for end in ("", "_ci95"))
_THEORY = (
    *_LARGE,
    *(f"theory/{name}" for name in _QUANTITIES),
    *("stresses/kinetic_stress", "stresses/binary_stress"),
    *(f"{name}_stderr" for name in _MEASURED),
)
_SHARE = "stresses/cluster_pressure_share"
CLUSTERS = (_SHARE, f"{_SHARE}_stderr")
_LEAST_EXCESS = 1e-5  # smallest excess that its logarithmic axis shows
_EXCESS_LABEL = r"excess $\langle F\rangle/\langle F_{\mathrm{bc}}\rangle-1$"


def has_theory(data: xr.Dataset) -> bool:
    """Return whether a map has the variables that :func:`theory_errors` draws."""
    return not what_lacks(data, *RATIO, *_MEASURED, *_THEORY)


def has_clusters(data: xr.Dataset) -> bool:
    """Return whether a map has the variables that :func:`cluster_shares` draws."""
    return not what_lacks(data, *RATIO, *CLUSTERS)


# ----------------------------------------------------------------------------------------------
# theory


def error_parts(data: xr.Dataset, quantity: str) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return the error of the theory in `pressure` or `shear_stress` of a large system, the part of
    it due to the binary assumption, and their standard errors.

    ========== ============================ ========================================================
    name       value                        source of the standard error
    ========== ============================ ========================================================
    total      ln(theory/large system)      total error of the stress of a large system
    binary     ln(binary/measured)          measured ratio of contact to binary stress
    ========== ============================ ========================================================

    Binary is the measured kinetic stress plus the contact stress if all collisions were binary. All
    are NaN where a quotient is not positive or not known.
    """
    components = [(0, 0), (1, 1)] if quantity == "pressure" else [(0, 1)]

    def part_of(tensor: xr.DataArray) -> np.ndarray:
        return np.mean([tensor.isel(axis_a=a, axis_b=b).values for a, b in components], axis=0)

    large = f"{quantity}_large_system"
    measured, theory, limit = (
        data[name].values for name in (quantity, f"theory/{quantity}", large)
    )
    stderr = data[f"{large}_ci95"].sel(error_source="total").values / HALF_INTERVAL
    sign = 1 if quantity == "pressure" else -1
    kinetic, collisional = (
        sign * part_of(data[f"stresses/{name}_stress"]) for name in ("kinetic", "binary")
    )
    ratio_error = part_of(np.abs(data.stress_ratio_stderr / data.stress_ratio))
    binary = kinetic + collisional
    with np.errstate(divide="ignore", invalid="ignore"):
        parts = {
            "total": (np.log(theory / limit), stderr / limit),
            "binary": (np.log(binary / measured), collisional / binary * ratio_error),
        }
    return {
        name: (np.where(np.isfinite(value), value, np.nan), error)
        for name, (value, error) in parts.items()
    }


@styled
def theory_errors(data: MapData) -> Figure:
    """Return the error of kinetic theory in the plane of 1 − α and ν, and the part of it
    due to the binary assumption.

    The rows are pressure and shear stress. The columns are the whole error and that of the binary
    assumption alone, as in :func:`error_parts`; the rest is the closure. Contours have the error as
    their label; they are dashed where the theory is too low. The theory is the Enskog balance of
    the second moments of anisotropic Gaussian velocities, for each size class.

    Args:
      data: a map with what :func:`error_parts` needs, `force_ratio` and `status`.

    Raises:
      InputError: (a ValueError) fewer than two restitutions or two packing fractions.
    """
    data = selection(data, *_MEASURED, *_THEORY)
    require_plane(data)
    figure = empty_figure(TWO_COLUMNS, height=5.4)
    grid = figure.subplots(2, 2, sharex=True, sharey=True)
    tints = colormaps["PuOr_r"](np.linspace(0.12, 0.88, len(ERROR_LEVELS) + 1))
    legend: Legend = {}
    titles = ("all assumptions", "binary collisions alone")
    panels = zip(grid.flat, "abcd", [(q, k) for q in _QUANTITIES for k in (0, 1)], strict=True)
    for axes, letter, (quantity, column) in panels:
        value, error = list(error_parts(data, quantity).values())[column]
        fields = value, value - error, value + error
        legend |= draw_plane(axes, data, fields, ERROR_LEVELS, 0.55 + 0.45 * tints)
        legend |= draw_binary_limit(axes, data)
        axes.set_title(f"({letter}) {_QUANTITIES[quantity]}: {titles[column]}")
    label_axes(grid)
    add_plane_legend(figure, legend)
    total = error_parts(data, "pressure")["total"][0]
    wrong = abs(np.expm1(total)) > 0.1
    binary = (wrong & (data.force_ratio.values < 1 + BINARY_EXCESS)).sum()
    describe(
        figure,
        data,
        f"Kinetic theory misses the pressure by more than 10 % at {wrong.sum()} of "
        f"{counted(np.isfinite(total).sum(), 'measured point')}, {binary} of which "
        f"{'has' if binary == 1 else 'have'} a force ratio below {1 + BINARY_EXCESS:g}",
        "Left: theory over the stress of a large system, whose standard error has all sources. "
        "Right: the measured flow with all collisions taken as binary, over measurement, with the "
        "standard error of sampling",
    )
    return figure


# --------------------------------------------------------------------------------------------
# clusters


@styled
def cluster_shares(data: MapData) -> Figure:
    """Return the share of the contact pressure that clusters of three or more grains carry.

    Left: against the excess of the force ratio, coloured by restitution. Right, if the map is a
    plane: its contours.

    Args:
      data: a map with `stresses/cluster_pressure_share` and `force_ratio`, with `_stderr`, and
        `status`.

    Returns:
      Error bars are one standard error, in both directions.
    """
    data = selection(data, _SHARE)
    plane = is_plane(data)
    figure = empty_figure(TWO_COLUMNS if plane else ONE_COLUMN, height=2.9)
    grid = figure.subplots(1, 1 + plane, squeeze=False)
    beyond = _draw_shares(grid[0, 0], data)
    legend: Legend = {}
    if suspect(data).any():
        legend[RING["label"]] = Line2D([], [], **RING)
    if plane:
        axes, share, error = grid[0, 1], data[_SHARE].values, data[f"{_SHARE}_stderr"].values
        greys = [str(value) for value in np.linspace(1.0, 0.8, len(SHARE_LEVELS) + 1)]
        fields = share, share - error, share + error
        legend |= draw_plane(axes, data, fields, SHARE_LEVELS, greys)
        legend |= draw_binary_limit(axes, data)
        label_axes(grid[:, 1:])
        grid[0, 0].set_title("(a) against the excess")
        axes.set_title("(b) in the plane")
    add_plane_legend(figure, legend)
    describe(
        figure,
        data,
        "Share of the contact pressure in clusters of three or more grains"
        + (": it grows with the excess of the force ratio" if _grows(data) else ""),
        f"{counted(beyond, 'point')} left out, whose excess is too small for the axis; bars are "
        "standard errors"
        if beyond
        else "Bars are standard errors",
    )
    return figure


def _grows(data: xr.Dataset) -> bool:
    """Return whether the share grows with the excess: by ranks, over at least three points."""
    excess, share = data.force_ratio.values, data[_SHARE].values
    known = np.isfinite(excess) & np.isfinite(share)
    if known.sum() < 3:
        return False
    of_excess, of_share = (np.argsort(np.argsort(x[known])) for x in (excess, share))
    return bool(np.corrcoef(of_excess, of_share)[0, 1] > 0.5)


def _draw_shares(axes: Axes, data: xr.Dataset) -> int:
    """Draw shares against the excess, in the colour of their restitution; return how many points
    are not on the logarithmic axis.
    """
    excess, share, bad = data.force_ratio.values - 1.0, data[_SHARE].values, suspect(data)
    x_error, y_error = data.force_ratio_stderr.values, data[f"{_SHARE}_stderr"].values
    colours = ScalarMappable(Normalize(0.0, 1.2), "viridis")  # up to 1: no yellow
    for k, alpha in enumerate(data.restitution.values):
        style = {"color": colours.to_rgba(alpha), "marker": "o", "markersize": 3, "linestyle": ""}
        errors = {"xerr": x_error[:, k], "yerr": y_error[:, k]}
        draw_points(axes, excess[:, k], share[:, k], bad[:, k], style, **errors)
    shown = excess >= _LEAST_EXCESS
    limits = (excess[shown].min() / 1.6, excess[shown].max() * 1.6) if shown.any() else (1e-5, 1)
    axes.set(xscale="log", xlim=limits, ylim=(-0.03, 1.03), xlabel=_EXCESS_LABEL)
    label_log_axis(axes.xaxis)
    axes.set_ylabel("share of pressure in clusters")
    bar = axes.figure.colorbar(colours, cax=axes.inset_axes((0.08, 0.5, 0.035, 0.4)))
    bar.set_label(ALPHA_TITLE)
    bar.ax.set_ylim(0.0, 1.0)
    return int((np.isfinite(excess) & ~shown).sum())
