"""The figures of a ratio map: curves of its ratios, and contours of the excess over one.

They follow Figures 1 and 2 of Lois, Lemaître and Carlson, *Momentum transport in granular flows*,
and show the largest number of grains and the shortest time step of a map that has several. The
force ratio is ⟨F⟩/⟨F_bc⟩, the excess is ⟨F⟩/⟨F_bc⟩ − 1, and the shear-stress ratio is that of the
contact stress to the binary stress, component xy.
"""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from jaxgran.maps.schema import MapData, shear_stress_ratio
from jaxgran.plotting.plane import EXCESS_LEVELS, add_plane_legend, contour_variable, draw_plane
from jaxgran.plotting.selection import describe, plane, require_plane, suspect
from jaxgran.plotting.style import (
    ALPHA_TITLE,
    NU_LABEL,
    ONE_COLUMN,
    RATIO_LABEL,
    TWO_COLUMNS,
    add_curve_legend,
    draw_curves,
    draw_reference,
    empty_figure,
    label_log_axis,
    padded,
    styled,
)

LOG_SPAN = 2.5  # largest over smallest ratio from which the axis is logarithmic
_SHEAR_LABEL = r"shear-stress ratio $\Sigma^{xy}/\Sigma^{xy}_{\mathrm{bc}}$"


@styled
def ratio_curves(data: MapData) -> Figure:
    """Return force ratio and shear-stress ratio against the packing fraction, one curve per
    restitution (Figure 1).

    Args:
      data: a map with `force_ratio`, `force_ratio_stderr` and, where present, `status`,
        `stress_ratio` and `stress_ratio_stderr`. The largest of several numbers of grains and the
        shortest of several time steps are drawn.

    Returns:
      Two panels with one scale, or one where the map has no `stress_ratio`. Error bars are one
      standard error, and a point whose status is not `ok` is an open symbol in a ring, in all
      figures of a map.

    Raises:
      InputError: (a ValueError) the data are not a map.
    """
    data = plane(data)
    panels = {RATIO_LABEL: (data.force_ratio, data.force_ratio_stderr)}
    if "stress_ratio" in data and "stress_ratio_stderr" in data:
        panels[_SHEAR_LABEL] = shear_stress_ratio(data)
    figure = empty_figure(TWO_COLUMNS, height=2.9)
    grid = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
    nu, bad = data.packing_fraction.values, suspect(data)
    for axes, letter, (label, (ratio, error)) in zip(grid, "ab", panels.items(), strict=False):
        draw_reference(axes)
        draw_curves(axes, nu, ratio.values.T, bad.T, yerr=error.values.T)
        axes.xaxis.set_major_locator(MaxNLocator(8, steps=(1, 2, 5, 10)))  # more would touch
        ylabel = f"({letter}) {label}" if len(panels) > 1 else label
        axes.set(xlim=padded(nu), xlabel=NU_LABEL, ylabel=ylabel)
        axes.tick_params(labelleft=True)
    set_ratio_scale(grid[0], np.concatenate([ratio.values for ratio, _ in panels.values()]))
    labels = [f"{alpha:.4g}" for alpha in data.restitution.values]
    add_curve_legend(figure, labels, ALPHA_TITLE, bad.any())
    describe(
        figure, data, "The ratios are 1 where all collisions are binary; bars are standard errors"
    )
    return figure


def set_ratio_scale(axes: Axes, ratio: np.ndarray) -> None:
    """Make the axis of a ratio logarithmic, with plain numbers, if the range is large enough."""
    values = ratio[np.isfinite(ratio) & (ratio > 0.0)]
    if values.size and values.max() >= LOG_SPAN * values.min():
        axes.set_yscale("log")
        label_log_axis(axes.yaxis)


@styled
def ratio_contours(data: MapData) -> Figure:
    """Return the contours of the excess force ratio in the plane of 1 − α and ν (Figure 2).

    The contoured variable is asinh(excess/0.01). It is logarithmic for an excess well above 0.01,
    and linear below, where noise may make the excess negative. It is interpolated linearly between
    the points. A cell with a missing corner is hatched. The band of a level has the points whose
    excess differs from it by at most the interpolated standard error.

    Args:
      data: as in :func:`ratio_curves`.

    Returns:
      The levels 0.05, 0.10, 0.25, 0.50 and 1.00, labelled; those that the map does not reach are
      named in the caption.

    Raises:
      InputError: (a ValueError) fewer than two restitutions or two packing fractions.
    """
    data = plane(data)
    require_plane(data)
    excess = data.force_ratio.values - 1.0
    error = np.nan_to_num(data.force_ratio_stderr.values)  # NaN where the ratio is 1 in all blocks
    levels = {f"{level:.2f}": float(contour_variable(level)) for level in EXCESS_LEVELS}
    figure = empty_figure(ONE_COLUMN, height=3.3)
    axes = figure.add_subplot()
    fields = [contour_variable(excess + k * error) for k in (0.0, -1.0, 1.0)]
    greys = [str(value) for value in np.linspace(1.0, 0.8, len(levels) + 1)]
    legend = draw_plane(axes, data, fields, levels, greys)
    add_plane_legend(figure, legend)
    reached = np.nanmin(excess, initial=np.inf), np.nanmax(excess, initial=-np.inf)
    absent = [f"{level:.2f}" for level in EXCESS_LEVELS if not reached[0] < level < reached[1]]
    not_reached = f"; not reached: {', '.join(absent)}" if absent else ""
    describe(
        figure,
        data,
        r"Contours of $\langle F\rangle/\langle F_{\mathrm{bc}}\rangle-1$: below the first, nearly "
        f"all forces are those of binary collisions{not_reached}",
    )
    return figure
