"""The last state of each point of a map with ``snapshots``, from which its contacts and forces are
computed.
"""

import math
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np
import xarray as xr

from jaxgran.analysis.instant import Instant, instant_of
from jaxgran.dynamics.snapshots import snapshot
from jaxgran.maps.points import PointGrid
from jaxgran.maps.replica import Key, Replica
from jaxgran.model.choices import Activation
from jaxgran.model.flow import ShearFlow
from jaxgran.model.grains import Grains
from jaxgran.model.state import State
from jaxgran.model.status import GIVEN_UP, Status

_PACKED = {"zlib": True, "shuffle": True, "complevel": 4}
_OF_GRAINS = {
    "positions": ("position of a grain, wrapped into the cell", "sigma", ("grain", "axis_a")),
    "velocities": ("peculiar velocity of a grain", "sigma / t", ("grain", "axis_a")),
    "radii": ("radius of a grain", "sigma", ("grain",)),
    "masses": ("mass of a grain", "m", ("grain",)),
}
_OF_CELL = {
    "side": ("side of the cell", "sigma", ()),
    "tilt": ("offset of the image row above, in sides", "1", ()),
}
VARIABLES: dict[str, tuple[str, str, tuple[str, ...]]] = _OF_GRAINS | _OF_CELL
"""Long name, unit and further dimensions of the variables of the group ``states``."""


def first_of_points(replicas: Mapping[Key, Replica | None]) -> dict[int, State]:
    """The last state of the first good seed of every point that has one."""
    good = {
        key: one.state
        for key, one in replicas.items()
        if one is not None and one.status < GIVEN_UP and one.state is not None
    }
    return {point: good[point, seed] for point, seed in sorted(good, reverse=True)}


def state_variables(grid: PointGrid, states: Mapping[int, State]) -> dict[str, xr.Variable]:
    """The group ``states``: the fields of a ``State`` by point; NaN for points without one, and
    after the last grain.

    Args:
      grid: the dimensions of a point.
      states: states by the number of the point.
    """
    count = math.prod(grid.shape)
    grains = max((len(one.grains.radii) for one in states.values()), default=0)
    sizes = {"grain": grains, "axis_a": 2}
    variables = {}
    for name, (long_name, units, further) in VARIABLES.items():
        values = np.full((count, *(sizes[dim] for dim in further)), np.nan)
        for point, one in states.items():
            part = np.asarray(getattr(one.grains if name in ("radii", "masses") else one, name))
            values[(point, slice(len(part))) if further else point] = part
        variables[name] = grid.variable(values, {"long_name": long_name, "units": units}, *further)
        variables[name].encoding = dict(_PACKED) if further else {}
    return variables


def state_of(here: Mapping[str, np.ndarray], dtype: Any = float) -> State | None:
    """The state of one point from its values by name; None if it has none."""
    if not np.isfinite(here["side"]):
        return None
    grains = np.isfinite(here["radii"])
    found: dict[str, Any] = {name: np.asarray(here[name][grains], dtype) for name in _OF_GRAINS}
    found |= {name: np.asarray(here[name], dtype) for name in _OF_CELL}
    return State(Grains(found.pop("radii"), found.pop("masses")), **found)


def states_of(data: xr.Dataset, count: int, dtype: Any = float) -> dict[int, State]:
    """The states in the group ``states`` of a map of ``count`` points, by the number of the
    point.
    """
    values = {name: data[name].values for name in VARIABLES}
    values = {
        name: x.reshape(count, *x.shape[x.ndim - len(VARIABLES[name][2]) :])
        for name, x in values.items()
    }
    found = {
        point: state_of({name: x[point] for name, x in values.items()}, dtype)
        for point in range(count)
    }
    return {point: one for point, one in found.items() if one is not None}


_snapshot = jax.jit(snapshot)


def instant_at(
    state: State,
    restitution: float,
    packing_fraction: float,
    timestep: float,
    activation: Activation,
) -> Instant | None:
    """The grains of a state, and the forces of the time step that begins with it, by the default
    solver.

    None where contacts may be missing or have no solution.
    """
    flow = ShearFlow(
        len(state.grains.radii), restitution, packing_fraction, timestep, activation=activation
    )
    now = _snapshot(flow, state)
    return None if now.status >= Status.infeasible else instant_of(now)
