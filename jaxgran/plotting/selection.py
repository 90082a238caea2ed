"""What a figure shows of a map: its points in order, their status, and its parameters in words."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from jaxgran.maps.schema import FINEST, RATIO, MapData, finest, flag_names, require_map
from jaxgran.model.checks import InputError
from jaxgran.model.display import counted
from jaxgran.plotting.style import add_caption, scientific


def selection(data: MapData, *names: str, along: str | None = None) -> xr.Dataset:
    """Return force ratio, status and the named variables, with their errors, as (packing_fraction,
    restitution).

    Of several numbers of grains the largest is kept, and of several time steps the shortest. The
    dimension ``along`` is kept whole and comes first. The values of all axes increase.

    Raises:
      InputError: (a ValueError) the data are not a map, or the map lacks one of the variables.
    """
    data = require_map(data, *RATIO, *names)
    data = finest(data, *(name for name in FINEST if name != along))
    shown = {*RATIO, *names, *(f"{name}_stderr" for name in names), "status"}
    dims = [name for name in (along, "packing_fraction", "restitution") if name in data.dims]
    return (
        data[[name for name in data.data_vars if name in shown]]
        .sortby(dims)
        .transpose(*dims, ...)
        .assign_attrs({"seeds": data.sizes.get("seed")} | data.attrs)
    )


def is_plane(data: xr.Dataset) -> bool:
    """Return whether a map has at least two restitutions and two packing fractions."""
    return min(data.sizes["restitution"], data.sizes["packing_fraction"]) >= 2


def require_plane(data: xr.Dataset) -> None:
    """Raise an InputError if a map is not a plane."""
    if not is_plane(data):
        raise InputError(
            "contours need at least two restitutions and two packing fractions, "
            f"and this map has {data.sizes['restitution']} and {data.sizes['packing_fraction']}."
        )


def suspect(data: xr.Dataset) -> np.ndarray:
    """Return whether a point has a value and a status that is not `ok`."""
    return np.isfinite(data.force_ratio.values) & (_status_names(data) != "ok")


def _status_names(data: xr.Dataset) -> np.ndarray:
    """Return the name of the status of every point, in the shape of the map."""
    if "status" not in data:
        return np.full(data.force_ratio.shape, "ok", dtype=object)
    names, codes = flag_names(data.status), data.status.values
    return np.array([names.get(code, f"status {code}") for code in codes.flat], object).reshape(
        codes.shape
    )


def describe(figure: Figure, data: xr.Dataset, *sentences: str) -> None:
    """Write the caption: sentences, the points that are missing or suspect, and the parameters."""
    measured = np.isfinite(data.force_ratio.values)
    counts = Counter(name for name in _status_names(data).flat if name != "ok")
    bad = ", ".join(f"{name.replace('_', ' ')} ({count})" for name, count in counts.most_common())
    lost = (~measured).sum()
    missing = f"{lost} of {counted(measured.size, 'point')} without a value"
    notes = [f"Status not ok: {bad}"] * bool(bad) + [missing] * (not measured.all())
    add_caption(figure, [*sentences, *notes, _parameters(data.attrs)])
    if not measured.any():
        for axes in figure.axes:
            axes.text(0.5, 0.6, "no measured values", transform=axes.transAxes, ha="center")


def _parameters(attrs: dict[str, Any]) -> str:
    """Return the parameters on which a force ratio depends; one of several values has an axis."""
    parts = []
    if "grains_by_point" in attrs:
        parts.append(
            f"$N={np.min(attrs['grains_by_point'])}$ to ${np.max(attrs['grains_by_point'])}$"
        )
    elif np.ndim(attrs.get("grains", ())) == 0:
        parts.append(f"$N={attrs['grains']}$")
    if attrs.get("seeds") is not None:
        parts.append(counted(attrs["seeds"], "seed"))
    if np.ndim(attrs.get("timestep", ())) == 0:
        parts.append(rf"$\mathrm{{d}}t={scientific(float(attrs['timestep']))}/\dot{{\gamma}}$")
    if "activation" in attrs:
        parts.append(f"{attrs['activation']} activation")
    if "strain" in attrs:
        parts.append(f"strain {float(attrs['strain']):g} per seed")
    return ", ".join(parts)
