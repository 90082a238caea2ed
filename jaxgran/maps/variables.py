"""The table of the variables of a map: from it ``map_dataset`` makes them, and the page of the file
describes them. The averages have their rows in ``sampling.observables``.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from jaxgran.maps.schema import path_of
from jaxgran.model.status import Status
from jaxgran.sampling.budget import LARGE_SYSTEM, MEASURED_POLYDISPERSITY, MEASURED_RANGES
from jaxgran.sampling.enskog_factors import LENGTHS
from jaxgran.sampling.observables import GROUPS, OBSERVABLES, STRESS_UNIT
from jaxgran.theory.assumptions import ASSUMPTIONS

NOT_RUN = -1
"""Status of a replica without a result."""

SCALARS = tuple(name for name, row in OBSERVABLES.items() if not (row.extreme or row.tensor))
"""The averages that have a correlation strain of their own."""

PREDICTED = (
    "granular_temperature",
    "pressure",
    "shear_stress",
    "dissipation_rate",
    "collision_rate",
)
"""The averages that kinetic theory predicts."""

_FLAGS = {
    "flag_values": np.array([NOT_RUN, *Status], np.int8),
    "flag_meanings": " ".join(["not_run", *(status.name for status in Status)]),
}
_RANGES = ", ".join(
    f"{name.replace('_', ' ')} {low:g} to {high:g}" for name, (low, high) in MEASURED_RANGES.items()
)
MEASURED_FLOWS = f"polydispersity {MEASURED_POLYDISPERSITY:g}, {_RANGES}"
"""Where the laws of a large system hold."""

LAWS = (
    "corrected for the number of grains, with bounds of time step and tolerance, by laws measured "
    f"at {MEASURED_FLOWS}"
)
"""How the averages of a large system follow, and where the laws hold."""


class Variable(NamedTuple):
    """A row of the table.

    Attributes:
      meaning: what it is, without its unit.
      unit: "1" for a pure number, None for flags.
      dims: its dimensions behind those of a point.
      has_error: whether there is also a variable NAME_stderr.
      attrs: further attributes.
    """

    meaning: str
    unit: str | None = "1"
    dims: tuple[str, ...] = ()
    has_error: bool = False
    attrs: Mapping[str, Any] = {}


def _averages(group: str) -> dict[str, Variable]:
    rows = {}
    for name in GROUPS[group]:
        row = OBSERVABLES[name]
        how = "maximum" if row.extreme else "mean (ratio of sums over time steps)"
        about = {"cell_methods": f"realization: time: {how}"}
        has_error = group != "diagnostics"
        rows[path_of(name)] = Variable(row.meaning, row.unit, row.axes, has_error, about)
    return rows


def _of_large_system() -> dict[str, Variable]:
    """The averages of a large system, and the half-widths of their 95 % intervals by source."""
    rows = {}
    for name in LARGE_SYSTEM:
        meaning, unit = f"{OBSERVABLES[name].meaning}, of a large system", OBSERVABLES[name].unit
        half, about = f"half-width of the 95 % interval of the {meaning}", {"comment": LAWS}
        rows[f"{name}_large_system"] = Variable(meaning, unit, attrs=about)
        rows[f"{name}_large_system_ci95"] = Variable(half, unit, ("error_source",), attrs=about)
    return rows


def _of_theory() -> dict[str, Variable]:
    comment = {"comment": "Enskog moments of an anisotropic Gaussian in each size class"}
    rows = {}
    for name in PREDICTED:
        meaning = f"kinetic theory's prediction of the {OBSERVABLES[name].meaning}"
        rows[f"theory/{name}"] = Variable(meaning, OBSERVABLES[name].unit, attrs=comment)
    rows["theory/enskog_pressure"] = Variable(
        "contact pressure of Enskog's theory at the measured granular temperature",
        STRESS_UNIT,
        has_error=True,
    )
    for name, row in ASSUMPTIONS.items():
        meaning = f"contact pressure with {row.measured} over that with {row.assumed}"
        rows[f"theory/enskog_factor_pressure_{name}"] = Variable(meaning, has_error=True)
    for name, meaning in LENGTHS.items():
        rows[f"theory/{name}"] = Variable(meaning, "sigma", has_error=True)
    return rows


VARIABLES: dict[str, Variable] = {
    **_averages("/"),
    "status": Variable(
        "worst status of a point, over all seeds and of their samples together",
        None,
        attrs={**_FLAGS, "standard_name": "aggregate_quality_flag"},
    ),
    "correlation_strain": Variable("strain over which the flow is correlated, that of one sample"),
    **_of_large_system(),
    **_averages("stresses"),
    **_of_theory(),
    **_averages("diagnostics"),
    "diagnostics/correlation_strain": Variable(
        "strain of one independent sample of an observable", dims=("observable",)
    ),
    "sums/status": Variable(
        "status of a seed", None, ("seed",), attrs={**_FLAGS, "standard_name": "quality_flag"}
    ),
    "sums/strain": Variable("sampled strain", dims=("seed",)),
    "sums/equilibration_strain": Variable("strain sheared before the sample", dims=("seed",)),
    "sums/area": Variable("area of the cell", "sigma^2", ("seed",)),
    "sums/tally": Variable(
        "running sums of each block of a sample, in the order of the fields of Tally, then those "
        "of the user's observables",
        dims=("seed", "block", "quantity"),
    ),
    "states/positions": Variable(
        "position of a grain, wrapped into the cell", "sigma", ("grain", "axis_a")
    ),
    "states/velocities": Variable("peculiar velocity of a grain", "sigma / t", ("grain", "axis_a")),
    "states/radii": Variable("radius of a grain", "sigma", ("grain",)),
    "states/masses": Variable("mass of a grain", "m", ("grain",)),
    "states/side": Variable("side of the cell", "sigma"),
    "states/tilt": Variable("offset of the image row above, in sides"),
}
"""Every variable of a map by its path, NAME in the root or GROUP/NAME."""

COORDINATES: dict[str, dict[str, str]] = {
    "grains": {"long_name": "number of grains", "units": "1"},
    "timestep": {"long_name": "time step of the sample", "units": "1 / shear rate"},
    "packing_fraction": {"long_name": "packing fraction", "units": "1"},
    "restitution": {"long_name": "restitution", "units": "1"},
    "point_grains": {"long_name": "number of grains", "units": "1"},
    "error_source": {"long_name": "source of an error"},
    "axis_a": {"long_name": "direction of the centre-to-centre vector"},
    "axis_b": {"long_name": "direction of the force"},
    "seed": {
        "long_name": "seed of the random numbers, from the first",
        "units": "1",
        "standard_name": "realization",
    },
    "observable": {"long_name": "name of an observable"},
}
"""The attributes of the coordinates of a map."""
