"""The variables of a map that say which assumption of kinetic theory fails at each point."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from jaxgran.maps.settings import MapSettings
from jaxgran.sampling.enskog_factors import FACTORS, STRESSES, stress_factors
from jaxgran.sampling.observables import STRESS_UNIT
from jaxgran.sampling.sample import Sample


def enskog_factor_variables(
    settings: MapSettings, dims: tuple[str, ...], samples: Mapping[int, Sequence[Sample]]
) -> dict[str, Any]:
    """The variables enskog_factor_STRESS_FACTOR and enskog_STRESS of a map, and their standard errors.

    Args:
      settings: the map.
      dims: dimensions of a point.
      samples: finite samples of a point, by its number in the order of ``settings.flows()``.
    """
    attrs = {
        f"enskog_{stress}": (f"contact {words} of Enskog's theory at the measured granular temperature", STRESS_UNIT)
        for stress, words in STRESSES.items()
    }
    for stress, words in STRESSES.items():
        for factor, (measured, assumed) in FACTORS.items():
            about = f"contact {words} with {measured} over that with {assumed}"
            attrs[f"{stress}_{factor}"] = (about, "1")
    flows, shape = settings.flows(), tuple(map(len, settings.axes.values()))
    values, errors = ({name: np.full(len(flows), np.nan) for name in attrs} for _ in range(2))
    for point, seeds in samples.items():
        value, error = stress_factors(flows[point], seeds)
        for name in attrs:
            values[name][point], errors[name][point] = value[name], error[name]
    variables = {}
    for name, (long_name, units) in attrs.items():
        full = name if name.startswith("enskog_") else f"enskog_factor_{name}"
        variables[full] = (dims, values[name].reshape(shape), {"long_name": long_name, "units": units})
        about = {"long_name": f"standard error of {long_name}", "units": units}
        variables[f"{full}_stderr"] = (dims, errors[name].reshape(shape), about)
    return variables
