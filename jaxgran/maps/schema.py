"""The groups and names in the data of a map: checks before they are drawn or fitted, and
selections.

The data of a map are a DataTree. Functions that read it also accept a Dataset, such as its root
alone, or a selection that has been flattened.
"""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
import xarray as xr

from jaxgran.maps.replica import AXES, FURTHER, PLANE
from jaxgran.sampling.budget import ERROR_SOURCES
from jaxgran.sampling.observables import OBSERVABLES, TENSOR_AXES

FORMAT_VERSION = 5
"""Version of the groups and names in the data of a map; a file of another one is refused."""

MapData: TypeAlias = xr.DataTree | xr.Dataset

RATIO = ("force_ratio", "force_ratio_stderr")

SOURCES_AND_TOTAL = ("total", *ERROR_SOURCES)
"""Coordinate ``error_source`` of ``NAME_large_system_ci95``."""


def flattened(data: MapData) -> xr.Dataset:
    """The variables of all groups in one Dataset, those of the root as ``NAME``, others as
    ``GROUP/NAME``.
    """
    if isinstance(data, xr.Dataset):
        return data
    flat = data.to_dataset()
    for node in data.descendants:
        own = node.to_dataset(inherit=False)
        flat = flat.assign_coords(
            {name: x for name, x in own.coords.variables.items() if name not in flat.coords}
        )
        flat = flat.assign(
            {f"{node.path[1:]}/{name}": own.variables[name] for name in own.data_vars}
        )
    return flat


def path_of(observable: str) -> str:
    """Where an observable is in the data of a map: ``NAME`` in the root, or ``GROUP/NAME``."""
    group = OBSERVABLES[observable].group if observable in OBSERVABLES else "/"
    return observable if group == "/" else f"{group}/{observable}"


def what_lacks(data: Any, *names: str) -> str:
    """Why data are not a ratio map with the named variables, as the end of a sentence; "" if they
    are one.
    """
    if not isinstance(data, MapData):
        return f"this is a {type(data).__name__}"
    data = flattened(data)
    missing = [name for name in (*PLANE, *names) if name not in data.variables]
    if missing:
        return f"it has no {', '.join(missing)}"
    for name in (*PLANE, *FURTHER):
        if name in data.coords and name in (*PLANE, *data.dims):
            axis = data[name]
            numeric = axis.dtype.kind in "iuf" and axis.dims == (name,) and axis.size > 0
            if (
                not numeric
                or not np.isfinite(axis.values).all()
                or np.unique(axis.values).size < axis.size
            ):
                return f"its {name} is not a list of different numbers"
    for name in (*names, *(("status",) if "status" in data else ())):
        variable = data[name]
        further = set(variable.dims) - {*AXES}
        on_axes = set(PLANE) <= set(variable.dims) and further in (
            set(),
            {*TENSOR_AXES},
            {"error_source"},
        )
        if variable.dtype.kind not in "iuf" or not on_axes:
            return f"its {name} is not a number at every packing_fraction and restitution"
    if "status" in data and "force_ratio" in names:  # figures of the force ratio show the status
        flags = (
            data.status.attrs.get("flag_values", ()),
            str(data.status.attrs.get("flag_meanings", "")).split(),
        )
        if np.size(flags[0]) == 0 or np.size(flags[0]) != len(flags[1]):
            return "its status has no flag_values and flag_meanings"
    return ""


def parts(data: MapData) -> list[xr.Dataset]:
    """The parts of a map for each number of grains and time step, flattened; these become
    attributes of the part.
    """
    selected = [flattened(data)]
    for name in FURTHER:
        if name in selected[0].dims:
            values = selected[0][name].values.tolist()
            selected = [
                part.isel({name: k}).assign_attrs({name: x})
                for part in selected
                for k, x in enumerate(values)
            ]
    return selected


def flag_names(flags: xr.DataArray) -> dict[int, str]:
    """The names of the values of a flag variable, such as ``status``."""
    values = np.atleast_1d(flags.attrs["flag_values"]).tolist()
    return dict(zip(values, flags.attrs["flag_meanings"].split(), strict=True))


def shear_stress_ratio(data: MapData) -> tuple[xr.DataArray, xr.DataArray]:
    """Contact over binary shear stress, and its standard error: component xy of the ratio of the
    stresses.
    """
    value, stderr = (
        flattened(data)[name].isel(axis_a=0, axis_b=1)
        for name in ("stress_ratio", "stress_ratio_stderr")
    )
    return value, stderr
