"""The diagnostics of a map: how well contacts were solved, momentum and energy kept, and how
samples are correlated.
"""

import numpy as np
import xarray as xr

from jaxgran.maps.points import PointAverages, PointGrid
from jaxgran.sampling.observables import GROUPS


def diagnostic_variables(grid: PointGrid, averages: PointAverages) -> dict[str, xr.Variable]:
    """The group ``diagnostics``.

    ===========================  ===================================================================
    variable                     meaning
    ===========================  ===================================================================
    NAME                         each observable of this group
    correlation_strain           strain of one independent sample of each scalar average, along
                                 ``observable``
    friction_error_correlation   correlation of the errors of macroscopic_friction and
                                 inertial_number
    ===========================  ===================================================================
    """
    by_name = averages.observable_correlation
    friction = {
        "long_name": "correlation of the errors of macroscopic friction and inertial number",
        "units": "1",
    }
    return grid.averages(GROUPS["diagnostics"], averages.values) | {
        "correlation_strain": grid.variable(
            np.stack(list(by_name.values()), axis=-1),
            {"long_name": "strain of one independent sample of an observable", "units": "1"},
            "observable",
        ),
        "friction_error_correlation": grid.variable(averages.friction_error_correlation, friction),
    }


def observable_coordinate(averages: PointAverages) -> xr.Variable:
    """The names of the observables that have a correlation strain."""
    names = list(averages.observable_correlation)
    return xr.Variable("observable", names, {"long_name": "name of an observable"})
