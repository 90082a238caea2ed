"""What a dataset must contain to be a ratio map, checked before it is drawn or fitted; and its parts."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import xarray as xr

from jaxgran.model.checks import InputError
from jaxgran.model.choices import HALF_INTERVAL

RATIO = ("force_ratio", "force_ratio_stderr")
ERROR_PARTS = {  # part of the budget: ending of the variable, and its meaning
    "timestep": ("error_timestep", "bound on the error of the {} from the time step"),
    "size": ("error_size", "bound on the difference of the {} from that of a large system"),
    "tolerance": ("error_tolerance", "bound on the error of the {} from the tolerance of the contact solves"),
    "error": ("error", "whole error of the {}, half the width of an interval of 95 %"),
}
_AXES = ("packing_fraction", "restitution")
FINEST: dict[str, Callable[[list], float]] = {"grains": max, "timestep": min}
"""Dimensions of a map that has several numbers of grains or time steps, and which of them has the smallest errors."""
_TENSOR_AXES = {"axis_a", "axis_b"}


def require_map(data: Any, *names: str) -> None:
    """Raise an InputError if this is not a ratio map with the named variables."""
    problem = what_lacks(data, *names)
    if problem:
        raise InputError(f"data must be the dataset of a ratio map, and {problem}.")


def what_lacks(data: Any, *names: str) -> str:
    """Why a dataset is not a ratio map with the named variables, in words; "" if it is one."""
    if not isinstance(data, xr.Dataset):
        return f"this is a {type(data).__name__}"
    missing = [name for name in (*_AXES, *names) if name not in data.variables]
    if missing:
        return f"it has no {', '.join(missing)}"
    for name in (*_AXES, *FINEST):
        if name in data.coords and name in (*_AXES, *data.dims):
            axis = data[name]
            numeric = axis.dtype.kind in "iuf" and axis.dims == (name,) and axis.size > 0
            if not numeric or not np.isfinite(axis.values).all() or np.unique(axis.values).size < axis.size:
                return f"its {name} is no list of different numbers"
    for name in (*names, *(("status",) if "status" in data else ())):
        variable = data[name]
        further = set(variable.dims) - {*_AXES, *FINEST}
        on_axes = set(_AXES) <= set(variable.dims) and further in (set(), _TENSOR_AXES)
        if variable.dtype.kind not in "iuf" or not on_axes:
            return f"its {name} is no number at every packing_fraction and restitution"
    if "status" in data and "force_ratio" in names:  # figures of the force ratio show the status
        flags = data.status.attrs.get("flag_values", ()), str(data.status.attrs.get("flag_meanings", "")).split()
        if np.size(flags[0]) == 0 or np.size(flags[0]) != len(flags[1]):
            return "its status has no flag_values and flag_meanings"
    return ""


def finest(data: xr.Dataset, *names: str) -> xr.Dataset:
    """A map at its largest number of grains and its shortest time step, which become its attributes.

    With names of these two dimensions, only they are chosen.
    """
    for name in names or FINEST:
        if name in data.dims:
            values = data[name].values.tolist()
            data = data.isel({name: values.index(FINEST[name](values))})
        if name in data.coords:
            data = data.assign_attrs({name: data[name].item()})
    return data


def parts(data: xr.Dataset) -> list[xr.Dataset]:
    """The parts of a map, one for each number of grains and time step, which become attributes of the part."""
    found = [data]
    for name in FINEST:
        if name in data.dims:
            values = data[name].values.tolist()
            found = [part.isel({name: k}).assign_attrs({name: x}) for part in found for k, x in enumerate(values)]
    return found


def relative_parts(data: xr.Dataset, name: str) -> dict[str, np.ndarray]:
    """The parts of the error of an average over the average, at every point; sampling as a half-width of 95 %."""
    value = np.abs(data[name].values)
    with np.errstate(invalid="ignore", divide="ignore"):
        sampling = HALF_INTERVAL * data[f"{name}_stderr"].values / value
        others = {part: data[f"{name}_{ending}"].values / value for part, (ending, _) in ERROR_PARTS.items()}
    return {"sampling": sampling, **others}


def shear_stress_ratio(data: xr.Dataset) -> tuple[xr.DataArray, xr.DataArray]:
    """Contact over binary shear stress, and its standard error: component xy of the ratio of the stresses."""
    value, stderr = (data[name].isel(axis_a=0, axis_b=1) for name in ("stress_ratio", "stress_ratio_stderr"))
    return value, stderr
