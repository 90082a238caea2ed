"""What a figure shows of a map: its points in four dimensions, their status, and its parameters."""

from __future__ import annotations

from collections import Counter

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from jaxgran.maps.replica import AXES, PLANE
from jaxgran.maps.schema import RATIO, MapData, flag_names, flattened, what_lacks
from jaxgran.model.checks import InputError
from jaxgran.model.display import counted
from jaxgran.plotting.style import add_caption, scientific


def points(data: MapData, *names: str) -> xr.Dataset:
    """Return a map, flattened, in the order of ``AXES``, each of which increases.

    A scalar coordinate becomes a dimension of one value. A dimension that the map does not tell has
    the size one and no coordinate.

    Raises:
      InputError: (a ValueError) the data are not a map, or the map lacks one of the variables.
    """
    if isinstance(data, MapData):
        data = flattened(data)
        data = data.expand_dims([name for name in AXES if name not in data.dims])
    if problem := what_lacks(data, *names):
        raise InputError(f"data must be a ratio map, and {problem}.")
    return data.sortby(list(AXES)).transpose(*AXES, ...)


def plane(data: MapData, *names: str) -> xr.Dataset:
    """Return the points of the largest number of grains and the shortest time step, as
    (packing_fraction, restitution).
    """
    return points(data, *RATIO, *names).isel(grains=-1, timestep=0)


def require_plane(data: xr.Dataset) -> None:
    """Raise an InputError unless a map has at least two restitutions and packing fractions."""
    if min(data.sizes[name] for name in PLANE) < 2:
        raise InputError(
            "contours need at least two restitutions and two packing fractions, "
            f"and this map has {data.sizes['restitution']} and {data.sizes['packing_fraction']}."
        )


def status_names(data: xr.Dataset) -> np.ndarray:
    """Return the name of the status of every point; `ok` in a map without a status."""
    if "status" not in data:
        return np.full(data.force_ratio.shape, "ok", dtype=object)
    names = flag_names(data.status)
    name_of = np.vectorize(lambda code: names.get(code, f"status {code}"), otypes=[object])
    return name_of(data.status.values)


def suspect(data: xr.Dataset) -> np.ndarray:
    """Return whether a point has a value and a status that is not `ok`."""
    return np.isfinite(data.force_ratio.values) & (status_names(data) != "ok")


def describe(figure: Figure, data: xr.Dataset, *sentences: str) -> None:
    """Write the caption: sentences, the points that are missing or suspect, and the parameters."""
    measured = np.isfinite(data.force_ratio.values)
    counts = Counter(name for name in status_names(data).flat if name != "ok")
    bad = ", ".join(f"{name.replace('_', ' ')} ({count})" for name, count in counts.most_common())
    missing = f"{(~measured).sum()} of {counted(measured.size, 'point')} without a value"
    notes = [f"Status not ok: {bad}"] * bool(bad) + [missing] * (not measured.all())
    add_caption(figure, [*sentences, *notes, _parameters(data)])
    if not measured.any():
        for axes in figure.axes:
            axes.text(0.5, 0.6, "no measured values", transform=axes.transAxes, ha="center")


def _parameters(data: xr.Dataset) -> str:
    """Return the parameters on which a force ratio depends; one of several values has an axis."""
    attrs, parts = data.attrs, []
    if "point_grains" in data:
        sizes = data.point_grains.values
        parts.append(f"$N={sizes.min()}$ to ${sizes.max()}$")
    elif "grains" in data.coords and data.grains.ndim == 0:
        parts.append(f"$N={data.grains.item()}$")
    if "seeds" in attrs:
        parts.append(counted(attrs["seeds"], "seed"))
    if "timestep" in data.coords and data.timestep.ndim == 0:
        parts.append(rf"$\mathrm{{d}}t={scientific(data.timestep.item())}/\dot{{\gamma}}$")
    if "activation" in attrs:
        parts.append(f"{attrs['activation']} activation")
    if "strain" in attrs:
        parts.append(f"strain {float(attrs['strain']):g} per seed")
    return ", ".join(parts)
