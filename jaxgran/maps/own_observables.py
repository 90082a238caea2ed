"""Observables of the user's in a map: what identifies their function, and their variables."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

import jax
import numpy as np

from jaxgran.maps.schema import ERROR_SOURCES
from jaxgran.model.choices import HALF_INTERVAL
from jaxgran.model.status import GIVEN_UP
from jaxgran.sampling.observables import unit_attributes
from jaxgran.sampling.observe import digest_of, dimensions_of, observed_shapes
from jaxgran.sampling.sample import observed_estimates

if TYPE_CHECKING:
    import xarray as xr

    from jaxgran.maps.points import PointGrid
    from jaxgran.maps.replica import Key, Replica
    from jaxgran.maps.settings import MapSettings
    from jaxgran.sampling.sample import Sample


def sums_by_name(settings: MapSettings) -> dict[str, jax.ShapeDtypeStruct] | None:
    """Shape and dtype of the sums of each of the user's observables; None without any."""
    return None if settings.observe is None else observed_shapes(settings.observe, settings.flows()[0])


def identity_of(settings: MapSettings) -> str | None:
    """What is compared before a map is continued or replaced: names and ``digest_of`` the function; None without one.

    So a function may move to another module, and what it calls counts too.
    """
    if settings.observe is None:
        return None
    return f"{', '.join(sums_by_name(settings) or ())}: {digest_of(settings.observe, settings.flows()[0])}"


def own_variables(
    settings: MapSettings, grid: PointGrid, samples: Mapping[int, Sequence[Sample]]
) -> dict[str, xr.Variable]:
    """The variables NAME, NAME_stderr and NAME_ci95 in the root, for what ``observe`` returns.

    An array has the dimensions NAME_dim_0, NAME_dim_1, … behind those of a point. Of the sources of an error only that
    of sampling is known; NAME_ci95 is NaN for the others, and in total.
    """
    if settings.observe is None:
        return {}
    variables = {}
    found = {point: observed_estimates(seeds) for point, seeds in samples.items()}
    for name, sums in (sums_by_name(settings) or {}).items():
        dims = dimensions_of(name, sums.shape)
        value, stderr = (np.full((len(grid.flows), *sums.shape), np.nan) for _ in range(2))
        for point, (values, stderrs) in found.items():
            value[point], stderr[point] = values[name], stderrs[name]
        interval = np.full((*value.shape, len(ERROR_SOURCES)), np.nan)
        interval[..., ERROR_SOURCES.index("sampling")] = HALF_INTERVAL * stderr
        about = {"long_name": f"mean of {name} over all time steps", "cell_methods": "realization: time: mean"}
        variables[name] = grid.variable(value, about, *dims)
        about = {"long_name": f"standard error of the mean of {name}"}
        variables[f"{name}_stderr"] = grid.variable(stderr, about, *dims)
        about = {"long_name": f"half-width of the 95 % interval of the mean of {name}, known for sampling only"}
        variables[f"{name}_ci95"] = grid.variable(interval, about, *dims, "error_source")
    return variables


def label_units(data: xr.DataTree, units: Mapping[str, str]) -> None:
    """Give the variables of the user's observables the attributes of their units, as built-in ones have them."""
    for name, unit in units.items():
        for group in (data, data["seeds"]):
            for variable in (name, f"{name}_stderr", f"{name}_ci95"):
                if variable in group.data_vars:
                    group[variable].attrs.update(unit_attributes(unit))


def units_of(data: xr.DataTree, names: Iterable[str]) -> dict[str, str]:
    """The units that ``label_units`` gave a map, by name."""
    attributes = {name: data[name].attrs for name in names}
    return {name: about.get("reduced_unit", "1") for name, about in attributes.items() if "units" in about}


def own_seed_variables(
    settings: MapSettings, grid: PointGrid, replicas: Mapping[Key, Replica | None]
) -> dict[str, xr.Variable]:
    """The variable NAME in the group ``seeds``, for what ``observe`` returns, if the map has several seeds."""
    if settings.observe is None or settings.seeds == 1:
        return {}
    totals = {key: one.sample.tally.total(axis=0) for key, one in replicas.items() if one and one.status < GIVEN_UP}
    variables = {}
    for name, sums in (sums_by_name(settings) or {}).items():
        value = np.full((len(grid.flows), settings.seeds, *sums.shape), np.nan)
        for key, total in totals.items():
            value[key] = np.asarray(total.observed[name]) / np.maximum(total.steps, 1)
        about = {"long_name": f"mean of {name} over all time steps", "cell_methods": "time: mean"}
        variables[name] = grid.variable(value, about, "seed", *dimensions_of(name, sums.shape))
    return variables
