"""Where kinetic theory fails, and the clusters that carry the stress there.

The figures show the largest number of grains and the shortest time step of a map that has several.
A green line in a plane is where the force ratio is 1.05: up to it collisions are binary.
"""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib import colormaps
from matplotlib.figure import Figure

from jaxgran.maps.schema import MapData
from jaxgran.model.choices import HALF_INTERVAL
from jaxgran.model.display import counted
from jaxgran.plotting.plane import (
    BINARY_EXCESS,
    Legend,
    add_plane_legend,
    draw_binary_limit,
    draw_plane,
)
from jaxgran.plotting.selection import describe, plane, require_plane, suspect
from jaxgran.plotting.style import (
    ALPHA_TITLE,
    TWO_COLUMNS,
    add_curve_legend,
    draw_curves,
    empty_figure,
    label_log_axis,
    styled,
)

_LABELS = "÷10", "÷5", "−50 %", "−25 %", "−10 %", "−5 %", "+5 %", "+10 %", "+25 %", "+50 %"
_QUOTIENTS = 0.1, 0.2, 0.5, 0.75, 0.9, 0.95, 1.05, 1.1, 1.25, 1.5, 2.0, 5.0, 10.0
ERROR_LEVELS: dict[str, float] = dict(
    zip((*_LABELS, "×2", "×5", "×10"), np.log(_QUOTIENTS), strict=True)
)
"""Contour values of the logarithm of a quotient, by their labels."""

_QUANTITIES = {"pressure": "pressure", "shear_stress": "shear stress"}
THEORY = (
    *(*_QUANTITIES, "stress_ratio"),
    *(f"{name}_large_system{end}" for name in _QUANTITIES for end in ("", "_ci95")),
    *(f"theory/{name}" for name in _QUANTITIES),
    *("stresses/kinetic_stress", "stresses/binary_stress", "stress_ratio_stderr"),
)
"""Variables of a map that :func:`theory_errors` needs beside the ratio."""

_SHARE = "stresses/cluster_pressure_share"
CLUSTERS = (_SHARE, f"{_SHARE}_stderr")
_LEAST_EXCESS = 1e-5  # smallest excess that its logarithmic axis shows


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
    sign, components = (1, [(0, 0), (1, 1)]) if quantity == "pressure" else (-1, [(0, 1)])

    def part_of(tensor: xr.DataArray) -> np.ndarray:
        return np.mean([tensor.isel(axis_a=a, axis_b=b).values for a, b in components], axis=0)

    large, theory = data[f"{quantity}_large_system"].values, data[f"theory/{quantity}"].values
    ci95 = data[f"{quantity}_large_system_ci95"].sel(error_source="total").values
    kinetic, collisional = (
        sign * part_of(data[f"stresses/{name}_stress"]) for name in ("kinetic", "binary")
    )
    binary = kinetic + collisional
    ratio_error = part_of(np.abs(data.stress_ratio_stderr / data.stress_ratio))
    with np.errstate(divide="ignore", invalid="ignore"):
        parts = {
            "total": (np.log(theory / large), ci95 / HALF_INTERVAL / large),
            "binary": (np.log(binary / data[quantity].values), collisional / binary * ratio_error),
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
    data = plane(data, *THEORY)
    require_plane(data)
    figure = empty_figure(TWO_COLUMNS, height=5.4)
    grid = figure.subplots(2, 2, sharex=True, sharey=True)
    tints = 0.55 + 0.45 * colormaps["PuOr_r"](np.linspace(0.12, 0.88, len(ERROR_LEVELS) + 1))
    titles = {"total": "all assumptions", "binary": "binary collisions alone"}
    legend: Legend = {}
    panels = [(quantity, part) for quantity in _QUANTITIES for part in titles]
    for axes, letter, (quantity, part) in zip(grid.flat, "abcd", panels, strict=True):
        value, error = error_parts(data, quantity)[part]
        fields = value, value - error, value + error
        legend |= draw_plane(axes, data, fields, ERROR_LEVELS, tints)
        legend |= draw_binary_limit(axes, data)
        axes.set_title(f"({letter}) {_QUANTITIES[quantity]}: {titles[part]}")
        axes.label_outer()
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


@styled
def cluster_shares(data: MapData) -> Figure:
    """Return the share of the contact pressure that clusters of three or more grains carry, against
    the excess of the force ratio, one curve per restitution.

    Args:
      data: a map with `stresses/cluster_pressure_share` and `force_ratio`, with `_stderr`, and
        `status`.
    """
    data = plane(data, *CLUSTERS)
    excess, share, bad = data.force_ratio.values - 1.0, data[_SHARE].values, suspect(data)
    x_error, y_error = data.force_ratio_stderr.values, data[f"{_SHARE}_stderr"].values
    figure = empty_figure(TWO_COLUMNS, height=2.9)
    axes = figure.add_subplot(ylim=(-0.03, 1.03), ylabel="share of pressure in clusters")
    draw_curves(axes, excess.T, share.T, bad.T, xerr=x_error.T, yerr=y_error.T)
    shown = excess >= _LEAST_EXCESS
    limits = (excess[shown].min() / 1.6, excess[shown].max() * 1.6) if shown.any() else (1e-5, 1)
    label = r"excess of the force ratio $\langle F\rangle/\langle F_{\mathrm{bc}}\rangle-1$"
    axes.set(xscale="log", xlim=limits, xlabel=label)
    label_log_axis(axes.xaxis)
    labels = [f"{alpha:.4g}" for alpha in data.restitution.values]
    add_curve_legend(figure, labels, ALPHA_TITLE, bad.any())
    beyond = (np.isfinite(excess) & ~shown).sum()
    describe(
        figure,
        data,
        "Share of the contact pressure in clusters of three or more grains; bars are standard "
        "errors",
        f"{counted(beyond, 'point')} left out, whose excess is too small for the axis"
        if beyond
        else "",
    )
    return figure
