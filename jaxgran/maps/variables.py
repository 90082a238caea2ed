"""The table of the variables of a map: a row for each, from which ``map_dataset`` makes it and the
page of the file describes it. The averages have their rows in ``sampling.observables``.
"""

from collections.abc import Callable, Mapping
from itertools import chain
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from jaxgran.maps.point_values import PointValues
from jaxgran.maps.schema import ERROR_SOURCES, path_of
from jaxgran.maps.seeds import STATUS_FLAGS
from jaxgran.sampling.budget import LARGE_SYSTEM, MEASURED_POLYDISPERSITY, MEASURED_RANGES
from jaxgran.sampling.enskog_factors import LENGTHS
from jaxgran.sampling.observables import GROUPS, OBSERVABLES, STRESS_UNIT
from jaxgran.theory.assumptions import ASSUMPTIONS

_COMPRESSED = {"zlib": True, "shuffle": True, "complevel": 4}
_LONG = {"grain", "quantity"}  # dimensions of many numbers
_THEORY = "Enskog moments of an anisotropic Gaussian in each size class"


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

    Args:
      path: NAME in the root, or GROUP/NAME.
      meaning: what it is, without its unit.
      values: its values (points, ...); None if the map has none.
      unit: "1" for a pure number, None for flags.
      dims: its dimensions behind those of a point.
      stderr: the standard errors of the values, for the variable NAME_stderr.
      attrs: further attributes.
    """

    path: str
    meaning: str
    values: Callable[[PointValues], np.ndarray | None]
    unit: str | None = "1"
    dims: tuple[str, ...] = ()
    stderr: Callable[[PointValues], np.ndarray] | None = None
    attrs: Mapping[str, Any] = {}

    @property
    def group(self) -> str:
        return self.path.rpartition("/")[0] or "/"

    def on(self, points: PointValues) -> dict[str, xr.Variable]:
        """NAME and, if it has errors, NAME_stderr on the points of a map; none without values."""
        name, unit = self.path.rpartition("/")[2], {} if self.unit is None else {"units": self.unit}
        values = self.values(points)
        if values is None:
            return {}
        about = {"long_name": self.meaning, **unit, **self.attrs}
        variables = {name: points.grid.variable(values, about, *self.dims)}
        if _LONG & {*self.dims}:
            variables[name].encoding = dict(_COMPRESSED)
        if self.stderr is not None:
            about = {"long_name": f"standard error of {self.meaning}", **unit}
            errors = self.stderr(points)
            variables[f"{name}_stderr"] = points.grid.variable(errors, about, *self.dims)
        return variables


def _average(name: str) -> Variable:
    row = OBSERVABLES[name]
    how = "maximum" if row.extreme else "mean (ratio of sums over time steps)"
    return Variable(
        path_of(name),
        row.meaning,
        lambda points: points.averages.values[name],
        row.unit,
        row.axes,
        None if row.group == "diagnostics" else lambda points: points.averages.stderrs[name],
        {"cell_methods": f"realization: time: {how}"},
    )


def _large_system(name: str) -> tuple[Variable, Variable]:
    """The average of a large system, and the half-widths of its 95 % interval by source."""
    row = OBSERVABLES[name]
    about = {"comment": LAWS}

    def estimate(points: PointValues) -> np.ndarray:
        return points.large_system[name].value

    def half_widths(points: PointValues) -> np.ndarray:
        parts = points.large_system[name]._asdict()
        return np.stack([parts[source] for source in ERROR_SOURCES], axis=-1)

    path, meaning = f"{name}_large_system", f"{row.meaning}, of a large system"
    half = f"half-width of the 95 % interval of the {meaning}"
    return (
        Variable(path, meaning, estimate, row.unit, attrs=about),
        Variable(f"{path}_ci95", half, half_widths, row.unit, ("error_source",), attrs=about),
    )


def _prediction(name: str) -> Variable:
    return Variable(
        f"theory/{name}",
        f"kinetic theory's prediction of the {OBSERVABLES[name].meaning}",
        lambda points: points.prediction(name),
        OBSERVABLES[name].unit,
        attrs={"comment": _THEORY},
    )


def _over_enskog(path: str, name: str, meaning: str, unit: str = "1") -> Variable:
    return Variable(
        f"theory/{path}",
        meaning,
        lambda points: points.over_enskog[0][name],
        unit,
        stderr=lambda points: points.over_enskog[1][name],
    )


def _state(name: str, meaning: str, unit: str, *dims: str) -> Variable:
    return Variable(f"states/{name}", meaning, lambda points: points.states.get(name), unit, dims)


VARIABLES: tuple[Variable, ...] = (
    *map(_average, GROUPS["/"]),
    Variable(
        "status",
        "worst status of a point, over all seeds and of their samples together",
        lambda points: points.status,
        None,
        attrs={**STATUS_FLAGS, "standard_name": "aggregate_quality_flag"},
    ),
    Variable(
        "correlation_strain",
        "strain over which the flow is correlated, that of one sample",
        lambda points: points.averages.correlation_strain,
    ),
    *chain.from_iterable(map(_large_system, LARGE_SYSTEM)),
    *map(_average, GROUPS["stresses"]),
    _prediction("granular_temperature"),
    _prediction("pressure"),
    _prediction("shear_stress"),
    _prediction("dissipation_rate"),
    _prediction("collision_rate"),
    _over_enskog(
        "enskog_pressure",
        "enskog_pressure",
        "contact pressure of Enskog's theory at the measured granular temperature",
        STRESS_UNIT,
    ),
    *(
        _over_enskog(
            f"enskog_factor_pressure_{name}",
            f"pressure_{name}",
            f"contact pressure with {assumption.measured} over that with {assumption.assumed}",
        )
        for name, assumption in ASSUMPTIONS.items()
    ),
    *(_over_enskog(name, name, meaning, "sigma") for name, meaning in LENGTHS.items()),
    *map(_average, GROUPS["diagnostics"]),
    Variable(
        "diagnostics/correlation_strain",
        "strain of one independent sample of an observable",
        lambda points: np.stack([*points.averages.observable_correlation.values()], axis=-1),
        dims=("observable",),
    ),
    Variable(
        "sums/status",
        "status of a seed",
        lambda points: points.statuses,
        None,
        ("seed",),
        attrs={**STATUS_FLAGS, "standard_name": "quality_flag"},
    ),
    Variable("sums/strain", "sampled strain", lambda points: points.strains[0], dims=("seed",)),
    Variable(
        "sums/equilibration_strain",
        "strain sheared before the sample",
        lambda points: points.strains[1],
        dims=("seed",),
    ),
    Variable(
        "sums/area",
        "area of the cell",
        lambda points: points.sums.get("area"),
        "sigma^2",
        ("seed",),
    ),
    Variable(
        "sums/tally",
        "running sums of each block of a sample, in the order of the fields of Tally, then those "
        "of the user's observables",
        lambda points: points.sums.get("tally"),
        dims=("seed", "block", "quantity"),
    ),
    _state("positions", "position of a grain, wrapped into the cell", "sigma", "grain", "axis_a"),
    _state("velocities", "peculiar velocity of a grain", "sigma / t", "grain", "axis_a"),
    _state("radii", "radius of a grain", "sigma", "grain"),
    _state("masses", "mass of a grain", "m", "grain"),
    _state("side", "side of the cell", "sigma"),
    _state("tilt", "offset of the image row above, in sides", "1"),
)

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
