"""The figure that says which assumption of kinetic theory fails where: four factors in the plane of 1 − α and ν."""

from __future__ import annotations

from typing import Literal

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
    "anisotropy": "(a) anisotropy of the temperature",
    "chaos": "(b) chaos: squared speed of approach",
    "pairs": "(c) pair correlation at contact",
    "binary": "(d) binary assumption",
}
"""Factors of the map and the titles of their panels."""

_NOTE = (
    "Contact {}: measured = Enskog × (a) × (b) × (c) × (d). "
    "Black contours: factor, or less one in % (dashed where negative)"
)


def _needed(stress: str) -> list[str]:
    """Return the names of the variables that :func:`enskog_factors` draws."""
    return [f"theory/enskog_factor_{stress}_{factor}{end}" for factor in PANELS for end in ("", "_stderr")]


def has_factors(data: xr.Dataset) -> bool:
    """Return whether a map has the variables that :func:`enskog_factors` draws."""
    return not what_lacks(data, *RATIO, *_needed("pressure"))


def enskog_factors(data: MapData, stress: Literal["pressure", "shear_stress"] = "pressure") -> Figure:
    """Return the four factors by which a measured contact stress differs from Enskog's, in the plane of 1 − α and ν.

    Each factor is a stress with one more assumption replaced by what was measured, over the stress before:
    see ``jaxgran.sampling.enskog_factors``. Black contours have it as their label; they are dashed where it is below
    one. In dotted areas it differs from one by less than its standard error. Green contours show the excess of the
    force ratio.

    Args:
      data: a map with `theory/enskog_factor_...` of the stress and `force_ratio`, with `_stderr`, and `status`.
      stress: "pressure" or "shear_stress".

    Raises:
      InputError: (a ValueError) fewer than two restitutions or two packing fractions.
    """
    data = require_map(data, *RATIO, *_needed(stress))
    require_plane(data)
    data = finest(ordered(data, *_needed(stress)))
    figure = empty_figure(width=7.4, height=6.8)
    grid = figure.subplots(2, 2, sharex=True, sharey=True)
    measured = np.isfinite(data[f"theory/enskog_factor_{stress}_pairs"].values)
    fields, noisy, over = [], False, []
    for axes, (factor, title) in zip(grid.flat, PANELS.items(), strict=True):
        value, error = (data[f"theory/enskog_factor_{stress}_{factor}{end}"].values for end in ("", "_stderr"))
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
    note = _NOTE.format(stress.replace("_", " "))
    found = left_out_note(data, fields, "each factor")
    finish(figure, data, measured, [note, found, status_note(data), missing_note(measured, " (hatched)")])
    return figure
