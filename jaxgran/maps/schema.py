"""What a dataset must contain to be a ratio map; checked before it is drawn or fitted."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr

from jaxgran.model.checks import InputError

RATIO = ("force_ratio", "force_ratio_stderr")
_AXES = ("packing_fraction", "restitution")
_FURTHER_DIMENSIONS = (set(), {"timestep"}, {"axis_a", "axis_b"}, {"timestep", "axis_a", "axis_b"})


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
    for name in (*_AXES, "timestep"):
        if name in data.coords and name in (*_AXES, *data.dims):
            axis = data[name]
            numeric = axis.dtype.kind in "iuf" and axis.dims == (name,) and axis.size > 0
            if not numeric or not np.isfinite(axis.values).all() or np.unique(axis.values).size < axis.size:
                return f"its {name} is no list of different numbers"
    for name in (*names, *(("status",) if "status" in data else ())):
        variable = data[name]
        further = set(variable.dims) - set(_AXES)
        on_axes = set(_AXES) <= set(variable.dims) and further in _FURTHER_DIMENSIONS
        if variable.dtype.kind not in "iuf" or not on_axes:
            return f"its {name} is no number at every packing_fraction and restitution"
    if "status" in data and "force_ratio" in names:  # figures of the force ratio show the status
        flags = data.status.attrs.get("flag_values", ()), str(data.status.attrs.get("flag_meanings", "")).split()
        if np.size(flags[0]) == 0 or np.size(flags[0]) != len(flags[1]):
            return "its status has no flag_values and flag_meanings"
    return ""
