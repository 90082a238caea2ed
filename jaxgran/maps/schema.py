"""What a dataset must hold to be a ratio map, before any of it is drawn or fitted."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr

from jaxgran.model.checks import InputError

RATIO = ("force_ratio", "force_ratio_stderr")
_AXES = ("packing_fraction", "restitution")
_OTHERS = ({"timestep"}, {"axis_a", "axis_b"}, {"timestep", "axis_a", "axis_b"}, set())  # dimensions beside the axes


def require_map(data: Any, *names: str) -> None:
    """Raise an InputError in one sentence where this is no ratio map, or lacks some of the named variables."""
    lack = what_lacks(data, *names)
    if lack:
        raise InputError(f"data must be the dataset of a ratio map, and {lack}.")


def what_lacks(data: Any, *names: str) -> str:
    """What keeps a dataset from being a ratio map with the named variables, in words; empty where nothing does."""
    if not isinstance(data, xr.Dataset):
        return f"this is a {type(data).__name__}"
    missing = [name for name in (*_AXES, *names) if name not in data.variables]
    if missing:
        return f"it has no {', '.join(missing)}"
    for name in (*_AXES, "timestep"):
        if name in data.coords and name in (*_AXES, *data.dims):
            axis = data[name]
            known = axis.dtype.kind in "iuf" and axis.dims == (name,) and axis.size > 0
            if not known or not np.isfinite(axis.values).all() or np.unique(axis.values).size < axis.size:
                return f"its {name} is no list of different numbers"
    for name in (*names, *(("status",) if "status" in data else ())):
        variable = data[name]
        others = set(variable.dims) - set(_AXES)
        if variable.dtype.kind not in "iuf" or not set(_AXES) <= set(variable.dims) or others not in _OTHERS:
            return f"its {name} is no number at every packing_fraction and restitution"
    if "status" in data and "force_ratio" in names:  # then its meanings are drawn
        flags = data.status.attrs.get("flag_values", ()), str(data.status.attrs.get("flag_meanings", "")).split()
        if np.size(flags[0]) == 0 or np.size(flags[0]) != len(flags[1]):
            return "its status has no flag_values and flag_meanings"
    return ""
