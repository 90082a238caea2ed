"""The figure that says which assumption of kinetic theory fails where: its factors in the plane of
1 − α and ν.
"""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from jaxgran.maps.schema import RATIO, MapData, finest, require_map, what_lacks
from jaxgran.plotting.contours import add_plane_legend, draw_excess, excess_keys
from jaxgran.plotting.drawing import (
    ALPHA_LABEL,
    LABEL_SIZE,
    NU_LABEL,
    PANEL_TITLE,
    TWO_COLUMNS,
    empty_figure,
    finish,
    missing_note,
    ordered,
    require_plane,
    status_note,
)
from jaxgran.plotting.interpolation import left_out_note
from jaxgran.plotting.theory import draw_errors, noise_keys

PANELS = {
    "local_temperature": "(a) local temperature",
    "anisotropy": "(b) anisotropy",
    "chaos": "(c) chaos: speed of approach",
    "pairs": "(d) pairs at contact",
    "binary": "(e) binary assumption",
}
"""Factors of the map and the titles of their panels."""

LENGTH_PANEL = r"(f) correlation length $L'/\sigma$"
"""Title of the last panel."""

_NOTES = (
    (
        "Contact pressure: measured = Enskog × (a) × (b) × (c) × (d) × (e); (f) Γ over pressure, "
        "Enskog over measured"
    ),
    "Black contours: factor or length, or less one in % (dashed where negative)",
)
_DRAWN = {f"theory/enskog_factor_pressure_{factor}": title for factor, title in PANELS.items()}
_DRAWN |= {"theory/correlation_length_from_pressure": LENGTH_PANEL}
_NEEDED = [f"{name}{end}" for name in _DRAWN for end in ("", "_stderr")]


def has_factors(data: xr.Dataset) -> bool:
    """Return whether a map has the variables that :func:`enskog_factors` draws."""
    return not what_lacks(data, *RATIO, *_NEEDED)


def enskog_factors(data: MapData) -> Figure:
    """Return the factors by which the contact pressure differs from Enskog's, in the plane.

    Each factor is the pressure with one more assumption replaced by what was measured, over the
    pressure before; the last panel is the correlation length L′: see
    ``jaxgran.sampling.enskog_factors``. The axes are 1 − α and ν. Black contours have the factor as
    their label; they are dashed where it is below one. In dotted areas it differs from one by less
    than its standard error. Green contours show the excess of the force ratio.

    Args:
      data: a map with `theory/enskog_factor_pressure_...`,
        `theory/correlation_length_from_pressure` and `force_ratio`, with `_stderr`, and `status`.

    Raises:
      InputError: (a ValueError) fewer than two restitutions or two packing fractions.
    """
    data = require_map(data, *RATIO, *_NEEDED)
    require_plane(data)
    data = finest(ordered(data, *_NEEDED))
    figure = empty_figure(TWO_COLUMNS, height=5.3)
    grid = figure.subplots(2, 3, sharex=True, sharey=True)
    measured = np.isfinite(data["theory/enskog_factor_pressure_pairs"].values)
    fields, noisy, over = [], False, []
    for axes, (name, title) in zip(grid.flat, _DRAWN.items(), strict=True):
        value, error = (data[f"{name}{end}"].values for end in ("", "_stderr"))
        with np.errstate(divide="ignore", invalid="ignore"):
            logarithm = np.where(value > 0, np.log(value), np.nan)
            noisy |= draw_errors(axes, data, logarithm, error / value)
        fields.append(logarithm)
        over = draw_excess(axes, data)
        axes.set_title(title, **PANEL_TITLE)
    for axes in grid[1]:
        axes.set_xlabel(ALPHA_LABEL, fontsize=LABEL_SIZE)
    for axes in grid[:, 0]:
        axes.set_ylabel(NU_LABEL, fontsize=LABEL_SIZE)
    add_plane_legend(figure, data, measured, [*(noise_keys() if noisy else []), *excess_keys(over)])
    found = left_out_note(data, fields, "each factor")
    finish(
        figure,
        data,
        measured,
        [*_NOTES, found, status_note(data), missing_note(measured, " (hatched)")],
    )
    return figure
