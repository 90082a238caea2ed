"""What kinetic theory predicts at the points of a map, and which of its assumptions fails there."""

from collections.abc import Mapping, Sequence
from operator import itemgetter

import jax
import numpy as np
import xarray as xr

from jaxgran.maps.points import PointGrid
from jaxgran.model.flow import ShearFlow
from jaxgran.model.grains import Grains
from jaxgran.sampling.enskog_factors import FACTORS, RATES, measured_over_enskog
from jaxgran.sampling.observables import OBSERVABLES
from jaxgran.sampling.prediction import kinetic_theory
from jaxgran.sampling.sample import Sample

THEORY = (
    "granular_temperature",
    "pressure",
    "shear_stress",
    "dissipation_rate",
    "collision_rate",
)  # predicted
ENSKOG = ("pressure", "dissipation_rate")  # rates of Enskog's theory
LENGTHS = {
    "correlation_length": "Enskog's dissipation rate over the measured one, at the local "
    "temperature",
    "correlation_length_from_pressure": "the same quotient of the dissipation rates over the "
    "contact pressures",
}
_THEORY_NAME = "Enskog moments of an anisotropic Gaussian in each size class"
_LARGEST = 1e12  # a prediction above it has no steady state


def theory_variables(
    grid: PointGrid, samples: Mapping[int, Sequence[Sample]]
) -> dict[str, xr.Variable]:
    """The group ``theory``.

    ============================  ==================================================================
    variable                      meaning
    ============================  ==================================================================
    NAME                          prediction of kinetic theory, for the names in ``THEORY``
    enskog_pressure,              contact pressure and dissipation rate of Enskog's theory at the
                                  measured granular
    enskog_dissipation_rate       temperature, with ``_stderr``
    enskog_factor_pressure_…      factors whose product times enskog_pressure is the measured
                                  contact pressure, see
                                  ``sampling.enskog_factors``, with ``_stderr``
    correlation_length,           L and L′ of ``sampling.enskog_factors``, with ``_stderr``
    correlation_length_
    from_pressure
    ============================  ==================================================================
    """
    variables = {}
    for name, values in _predictions(grid.batch, grid.classes).items():
        long_name, units = OBSERVABLES[name].meaning, OBSERVABLES[name].unit
        about = {
            "long_name": f"kinetic theory's prediction of the {long_name}",
            "units": units,
            "theory": _THEORY_NAME,
        }
        variables[name] = grid.variable(values, about)
    return variables | _enskog_variables(grid, samples)


def _predictions(flows: ShearFlow, classes: Grains | None) -> dict[str, np.ndarray]:
    """Prediction of kinetic theory at every point; NaN where it has no steady state, as at α =
    1.
    """
    numbers = flows.restitution, flows.packing_fraction, flows.shear_rate, flows.polydispersity
    theory = kinetic_theory(*numbers, classes)
    with np.errstate(invalid="ignore"):
        values = {name: getattr(theory, name) for name in THEORY}
        return {
            name: np.where(np.isfinite(x) & (x < _LARGEST), x, np.nan) for name, x in values.items()
        }


def _enskog_variables(
    grid: PointGrid, samples: Mapping[int, Sequence[Sample]]
) -> dict[str, xr.Variable]:
    """Enskog's rates, the factors between them and the measured ones, correlation lengths, and
    standard errors.
    """
    attrs = {
        f"enskog_{rate}": (
            f"{RATES[rate]} of Enskog's theory at the measured granular temperature",
            OBSERVABLES[rate].unit,
        )
        for rate in ENSKOG
    }
    for factor, (measured, assumed) in FACTORS.items():
        attrs[f"pressure_{factor}"] = (
            f"contact pressure with {measured} over that with {assumed}",
            "1",
        )
    attrs |= {name: (words, "sigma") for name, words in LENGTHS.items()}
    values, stderrs = ({name: np.full(len(grid.flows), np.nan) for name in attrs} for _ in range(2))
    for point, seeds in samples.items():
        grains = None if grid.classes is None else jax.tree.map(itemgetter(point), grid.classes)
        value, stderr = measured_over_enskog(grid.flows[point], seeds, grains)
        for name in attrs:
            values[name][point], stderrs[name][point] = value[name], stderr[name]
    variables = {}
    for name, (long_name, units) in attrs.items():
        full = name if name.startswith("enskog_") or name in LENGTHS else f"enskog_factor_{name}"
        variables[full] = grid.variable(values[name], {"long_name": long_name, "units": units})
        about = {"long_name": f"standard error of {long_name}", "units": units}
        variables[f"{full}_stderr"] = grid.variable(stderrs[name], about)
    return variables
