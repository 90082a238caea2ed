"""Friction and packing fraction against the inertial number, with the fitted laws of dense flow."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxgran.inference.friction_law import (
    LARGEST_INERTIAL_NUMBER,
    NEEDED,
    SMALLEST_PACKING_FRACTION,
    FrictionLaw,
    PowerLaw,
    dense_points,
    enough,
    friction_law,
    is_dense,
)
from jaxgran.maps.schema import RATIO, MapData, finest, require_map, what_lacks
from jaxgran.model.display import with_error
from jaxgran.plotting.drawing import (
    LABEL_SIZE,
    NU_LABEL,
    SMALL_SIZE,
    TWO_COLUMNS,
    add_ring_legend,
    curve_key,
    curve_styles,
    draw_points,
    empty_figure,
    finish,
    label_log_axis,
    missing_note,
    ordered,
    status_note,
    suspect,
)

_FRICTION_NOTE = (
    r"$\mu=\mu_0+aI^b$ and $\nu=\nu_c-kI^c$, fitted to the filled symbols: status ok, "
    rf"$I\leq{LARGEST_INERTIAL_NUMBER:g}$, $\nu\geq{SMALLEST_PACKING_FRACTION:g}$"
)


def has_friction_law(data: xr.Dataset) -> bool:
    """Return whether a map has what :func:`friction_figure` draws, with enough dense points."""
    return not what_lacks(data, *NEEDED) and enough(dense_points(data))


def friction_figure(data: MapData) -> Figure:
    """Return friction and packing fraction against the inertial number, with the laws of dense flow.

    Args:
      data: as in :func:`jaxgran.inference.friction_law.friction_law`.

    Returns:
      Fitted points are filled, other points are open; the parameters of the laws are in the legends.

    Raises:
      InputError: (a ValueError) too few dense points.
    """
    data = require_map(data, *RATIO, *NEEDED)
    law = friction_law(data)
    data = finest(ordered(data, "macroscopic_friction", "inertial_number"))
    measured = np.isfinite(data.macroscopic_friction.values)
    styles = dict(zip(data.restitution.values.tolist(), curve_styles(data.sizes["restitution"]), strict=True))
    figure = empty_figure(TWO_COLUMNS, height=3.6 + 0.15 * len(styles))
    left, right = figure.subplots(1, 2)
    for axes, name in ((left, "macroscopic_friction"), (right, "packing_fraction")):
        axes.set_xscale("log")
        for alpha, style in styles.items():
            _draw_flows(axes, data.sel(restitution=alpha), name, style)
        axes.set_xlabel(r"inertial number $I$", fontsize=LABEL_SIZE)
        label_log_axis(axes.xaxis)
    left.set_ylabel(r"macroscopic friction $\mu$", fontsize=LABEL_SIZE)
    right.set_ylabel(NU_LABEL, fontsize=LABEL_SIZE)
    _add_laws(left, law, styles, lambda one: one.friction, r"$\mu_0$, $a$, $b$")
    _add_laws(right, law, styles, lambda one: one.packing_fraction, r"$\nu_c$, $k$, $c$")
    add_ring_legend(figure, data)
    finish(figure, data, measured, [_FRICTION_NOTE, status_note(data), missing_note(measured)])
    return figure


def _draw_flows(axes: Axes, curve: xr.Dataset, name: str, style: dict[str, Any]) -> None:
    """Draw the points of one restitution against the inertial number; points that are not fitted are open."""
    number, stderr = curve.inertial_number.values, curve.inertial_number_stderr.values
    value = np.broadcast_to(curve[name].values, number.shape)
    errors = curve[f"{name}_stderr"].values if f"{name}_stderr" in curve else np.zeros_like(number)
    mark = {"color": style["color"], "marker": style["marker"], "linestyle": "none"}
    fitted = is_dense(curve).values
    for chosen, face in ((fitted, style["color"]), (~fitted, "white")):
        bars = {"xerr": stderr[chosen], "yerr": errors[chosen]}
        draw_points(axes, number[chosen], value[chosen], suspect(curve)[chosen], mark | {"mfc": face}, **bars)


def _add_laws(
    axes: Axes,
    law: FrictionLaw,
    styles: Mapping[float, dict[str, Any]],
    part: Callable[[FrictionLaw], PowerLaw],
    names: str,
) -> None:
    """Draw the law of each restitution and the law of all points; their parameters are in a legend under the axes."""
    entries = {alpha: (f"{alpha:.4g}", style) for alpha, style in styles.items()}
    laws: dict[float | None, FrictionLaw] = {**law.by_restitution, None: law}
    handles = []
    for key, (label, style) in (entries | {None: ("all", {"color": "black", "marker": "", "linestyle": "-"})}).items():
        if key in laws:
            fit = part(laws[key])
            number = np.geomspace(*fit.span, 100)
            axes.plot(number, fit(number), color=style["color"], linestyle=style["linestyle"], linewidth=1.1, zorder=1)
            label = f"{label}: {parameters_text(fit)}"
        else:
            label = f"{label}: too few points"
        handles.append(curve_key(style, label))
    axes.legend(
        handles=handles,
        title=rf"restitution α: {names} (reduced $\chi^2$)",
        alignment="left",
        loc="upper center",
        bbox_to_anchor=(0.5, -0.14),
        fontsize=SMALL_SIZE,
        title_fontsize=SMALL_SIZE,
        frameon=False,
        handlelength=3.2,
    )


def parameters_text(law: PowerLaw) -> str:
    """Return offset, absolute coefficient and exponent of a law with their standard errors, and the reduced χ²."""
    if not law.determined:
        return "not determined"
    values = law.parameters * [1.0, np.sign(law.parameters[1]), 1.0]
    parts = [with_error(value, error) for value, error in zip(values, law.standard_errors, strict=True)]
    return f"{', '.join(parts)} ({law.chi_squared:.2g})".replace("-", "−")
