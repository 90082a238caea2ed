"""Observables of the user's in a map: what identifies their function, and their variables."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import jax
import numpy as np
import xarray as xr

from jaxgran.maps.points import PointGrid
from jaxgran.maps.settings import MapSettings
from jaxgran.sampling.observe import digest_of, dimensions_of, observed_shapes
from jaxgran.sampling.sample import Sample, observed_estimates

_REFERENCE = {"restitution": 0.5, "packing_fraction": 0.5, "timestep": 1e-3}
"""Flow for the hash of an observable, which maps of other axes have in common."""


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
