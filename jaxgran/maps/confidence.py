"""The half-widths of the 95 % intervals of a map, with the sources of error along a dimension."""

import numpy as np
import xarray as xr

from jaxgran.maps.points import PointAverages, PointGrid
from jaxgran.maps.schema import ERROR_SOURCES
from jaxgran.sampling.budget import BUDGET, MEASURED_POLYDISPERSITY, error_budget
from jaxgran.sampling.observables import OBSERVABLES

LAWS = (
    "time step, size and tolerance by laws measured at a polydispersity of "
    f"{MEASURED_POLYDISPERSITY:g}"
)
"""What an interval of other sizes says."""


def confidence_variables(
    grid: PointGrid, averages: PointAverages, tolerance: float
) -> dict[str, xr.Variable]:
    """The variables NAME_ci95 of a map, for the names in ``BUDGET``, with the dimension
    ``error_source``.
    """
    flows = grid.batch
    other_sizes = grid.classes is not None or np.any(
        flows.polydispersity != MEASURED_POLYDISPERSITY
    )
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
        observable = OBSERVABLES[name]
        values = np.stack([budget[name][source] for source in ERROR_SOURCES], axis=-1)
        about = {
            "long_name": f"half-width of the 95 % interval of {observable.meaning}",
            "units": observable.unit,
        }
        about |= {"comment": LAWS} if other_sizes else {}
        variables[f"{name}_ci95"] = grid.variable(values, about, "error_source")
    return variables
