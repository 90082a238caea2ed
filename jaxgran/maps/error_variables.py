"""The variables of a map that hold the error budget of each point."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from jaxgran.maps.schema import ERROR_PARTS
from jaxgran.maps.settings import MapSettings, stack_of_any_size
from jaxgran.sampling.budget import BUDGET, error_budget


def error_variables(
    settings: MapSettings,
    dims: tuple[str, ...],
    values: Mapping[str, np.ndarray],
    errors: Mapping[str, np.ndarray],
    attrs: Mapping[str, tuple[str, str]],
) -> dict[str, Any]:
    """The variables NAME_error_timestep, NAME_error_size, NAME_error_tolerance and NAME_error of a map.

    Args:
      settings: the map.
      dims: dimensions of a point.
      values, errors: averages and standard errors by name, (points,) in the order of ``settings.flows()``.
      attrs: long name and units of each observable.
    """
    shape = tuple(map(len, settings.axes.values()))
    flows = stack_of_any_size(settings.flows())
    grains = np.array([flow.grains for flow in settings.flows()])
    budget = error_budget(
        values,
        errors,
        flows.restitution,
        flows.packing_fraction,
        grains,
        flows.timestep,
        settings.tolerance,  # type: ignore[arg-type]
    )
    variables = {}
    for name in BUDGET:
        long_name, units = attrs[name]
        for part, (ending, meaning) in ERROR_PARTS.items():
            about = {"long_name": meaning.format(long_name), "units": units}
            variables[f"{name}_{ending}"] = (dims, getattr(budget[name], part).reshape(shape), about)
    if settings.grains_by_point is not None:
        about = {"long_name": "number of grains of a point", "units": "1"}
        variables["point_grains"] = (dims, grains.reshape(shape), about)
    return variables
