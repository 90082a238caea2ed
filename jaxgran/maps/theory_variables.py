"""What kinetic theory predicts at the points of a map, and which of its assumptions fails there."""

from collections.abc import Mapping, Sequence

import numpy as np
import xarray as xr

from jaxgran.maps.points import PointGrid
from jaxgran.model.flow import ShearFlow
from jaxgran.sampling.enskog_factors import FACTORS, STRESSES, stress_factors
from jaxgran.sampling.observables import OBSERVABLES, STRESS_UNIT
from jaxgran.sampling.prediction import kinetic_theory
from jaxgran.sampling.sample import Sample

THEORY = ("granular_temperature", "pressure", "shear_stress", "collision_rate")  # predicted
_THEORY_NAME = "Enskog moments of an anisotropic Gaussian in each size class"
_LARGEST = 1e12  # a prediction above it has no steady state


def theory_variables(grid: PointGrid, samples: Mapping[int, Sequence[Sample]]) -> dict[str, xr.Variable]:
    """The group ``theory``.

    ============================  ===================================================================================
    variable                      meaning
    ============================  ===================================================================================
    NAME                          prediction of kinetic theory, for the names in ``THEORY``
    enskog_STRESS                 contact pressure and shear stress of Enskog's theory at the measured granular
                                  temperature, with ``_stderr``
    enskog_factor_STRESS_FACTOR   factors whose product times enskog_STRESS is contact_STRESS, see
                                  ``sampling.enskog_factors``, with ``_stderr``
    ============================  ===================================================================================
    """
    variables = {}
    for name, values in _predictions(grid.batch).items():
        long_name, units = OBSERVABLES[name]
        about = {"long_name": f"kinetic theory's prediction of the {long_name}", "units": units, "theory": _THEORY_NAME}
        variables[name] = grid.variable(values, about)
    return variables | _enskog_variables(grid, samples)


def _predictions(flows: ShearFlow) -> dict[str, np.ndarray]:
    """Prediction of kinetic theory at every point; NaN where it has no steady state, as at α = 1."""
    theory = kinetic_theory(flows.restitution, flows.packing_fraction, flows.shear_rate, flows.polydispersity)
    with np.errstate(invalid="ignore"):
        values = {name: getattr(theory, name) for name in THEORY}
        return {name: np.where(np.isfinite(x) & (x < _LARGEST), x, np.nan) for name, x in values.items()}


def _enskog_variables(grid: PointGrid, samples: Mapping[int, Sequence[Sample]]) -> dict[str, xr.Variable]:
    """Enskog's stresses, the factors between them and the measured ones, and their standard errors."""
    attrs = {
        f"enskog_{stress}": (f"contact {words} of Enskog's theory at the measured granular temperature", STRESS_UNIT)
        for stress, words in STRESSES.items()
    }
    for stress, words in STRESSES.items():
        for factor, (measured, assumed) in FACTORS.items():
            attrs[f"{stress}_{factor}"] = (f"contact {words} with {measured} over that with {assumed}", "1")
    values, stderrs = ({name: np.full(len(grid.flows), np.nan) for name in attrs} for _ in range(2))
    for point, seeds in samples.items():
        value, stderr = stress_factors(grid.flows[point], seeds)
        for name in attrs:
            values[name][point], stderrs[name][point] = value[name], stderr[name]
    variables = {}
    for name, (long_name, units) in attrs.items():
        full = name if name.startswith("enskog_") else f"enskog_factor_{name}"
        variables[full] = grid.variable(values[name], {"long_name": long_name, "units": units})
        about = {"long_name": f"standard error of {long_name}", "units": units}
        variables[f"{full}_stderr"] = grid.variable(stderrs[name], about)
    return variables
