"""The half-widths of the 95 % intervals of a map, with the sources of error along a dimension."""

import numpy as np
import xarray as xr

from jaxgran.maps.points import PointAverages, PointGrid
from jaxgran.maps.schema import ERROR_SOURCES
from jaxgran.model.choices import HALF_INTERVAL
from jaxgran.sampling.budget import BUDGET, error_budget
from jaxgran.sampling.observables import OBSERVABLES


def confidence_variables(grid: PointGrid, averages: PointAverages, tolerance: float) -> dict[str, xr.Variable]:
    """The variables NAME_ci95 of a map, for the names in ``BUDGET``, with the dimension ``error_source``.

    ===========  ====================================================================================
    source       half-width
    ===========  ====================================================================================
    total        of all sources together, √(sampling² + timestep² + size² + tolerance²)
    sampling     1.96 standard errors
    timestep     bound on the error from the time step
    size         bound on the difference from a large system
    tolerance    bound on the error from the tolerance of the contact solves
    ===========  ====================================================================================
    """
    flows = grid.batch
    budget = error_budget(
        averages.values,
        averages.stderrs,
        flows.restitution,
        flows.packing_fraction,
        grid.grains,
        flows.timestep,
        tolerance,
    )
    variables = {}
    for name in BUDGET:
        observable, one = OBSERVABLES[name], budget[name]
        by_source = {
            "total": one.error,
            "sampling": HALF_INTERVAL * one.stderr,
            "timestep": one.timestep,
            "size": one.size,
            "tolerance": one.tolerance,
        }
        values = np.stack([by_source[source] for source in ERROR_SOURCES], axis=-1)
        about = {"long_name": f"half-width of the 95 % interval of {observable.meaning}", "units": observable.unit}
        variables[f"{name}_ci95"] = grid.variable(values, about, "error_source")
    return variables
