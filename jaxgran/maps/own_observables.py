"""Observables of the user's in a map: the check of their function, what identifies it, and their
variables.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from jaxgran.model.checks import InputError, refused, short_repr
from jaxgran.sampling.observables import OBSERVABLES
from jaxgran.sampling.observe import digest_of, dimensions_of, observed_shapes
from jaxgran.sampling.sample import observed_estimates

if TYPE_CHECKING:
    import xarray as xr

    from jaxgran.maps.points import PointGrid
    from jaxgran.maps.settings import MapSettings
    from jaxgran.model.flow import ShearFlow
    from jaxgran.sampling.sample import Sample

_REFERENCE = {"restitution": 0.5, "packing_fraction": 0.5, "timestep": 1e-3}
"""Flow for the hash of an observable, which maps of other axes have in common."""


def require_observe(observe: Any, flow: ShearFlow) -> None:
    """Raise an InputError unless a function returns numbers or arrays, summed over contacts, by
    names of its own.
    """
    if not callable(observe):
        raise refused(
            "observe", observe, "must be a function that is passed to `ratio_map`, or None"
        )
    try:
        hash(observe)
    except TypeError:
        raise refused("observe", observe, "must be hashable") from None
    from jaxgran.maps.variables import COORDINATES, VARIABLES  # which need the settings of a map

    shapes = observed_shapes(observe, flow)
    names = list(shapes) if isinstance(shapes, dict) else []
    if not names or not all(isinstance(x, jax.ShapeDtypeStruct) for x in shapes.values()):
        raise InputError(
            "observe must return a dictionary of numbers or arrays by name.", field="observe"
        )
    if not all(isinstance(name, str) and name.isidentifier() for name in names):
        raise InputError(
            f"observe must return names without spaces and signs, not {short_repr(names)}."
        )
    of_map = {*OBSERVABLES, *COORDINATES, *(row.path.partition("/")[0] for row in VARIABLES)}
    taken = [name for name in names if name in of_map or name.endswith(("_stderr", "_ci95"))]
    if taken:
        raise InputError(
            f"observe must return names that a map does not have, not {short_repr(taken[0])}."
        )


def sums_by_name(settings: MapSettings) -> dict[str, jax.ShapeDtypeStruct] | None:
    """Shape and dtype of the sums of each of the user's observables; None without any."""
    return (
        None if settings.observe is None else observed_shapes(settings.observe, settings.flows()[0])
    )


def identity_of(settings: MapSettings) -> str | None:
    """What is compared before a map is continued or replaced: names and ``digest_of`` the function;
    None without one.

    So a function may move to another module, and what it calls counts too.
    """
    if settings.observe is None:
        return None
    flow = replace(settings.flows()[0], **_REFERENCE)
    return f"{', '.join(sums_by_name(settings) or ())}: {digest_of(settings.observe, flow)}"


def own_variables(
    settings: MapSettings, grid: PointGrid, samples: Mapping[int, Sequence[Sample]]
) -> dict[str, xr.Variable]:
    """The variables NAME and NAME_stderr in the root, for what ``observe`` returns.

    An array has the dimensions NAME_dim_0, NAME_dim_1, … behind those of a point.
    """
    if settings.observe is None:
        return {}
    variables = {}
    estimates = {point: observed_estimates(seeds) for point, seeds in samples.items()}
    for name, sums in (sums_by_name(settings) or {}).items():
        dims = dimensions_of(name, sums.shape)
        value, stderr = (np.full((len(grid.flows), *sums.shape), np.nan) for _ in range(2))
        for point, (values, stderrs) in estimates.items():
            value[point], stderr[point] = values[name], stderrs[name]
        about = {
            "long_name": f"mean of {name} over all time steps",
            "cell_methods": "realization: time: mean",
        }
        variables[name] = grid.variable(value, about, *dims)
        about = {"long_name": f"standard error of the mean of {name}"}
        variables[f"{name}_stderr"] = grid.variable(stderr, about, *dims)
    return variables
