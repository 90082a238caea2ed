"""The last state of each point of a map with ``snapshots``, from which its contacts and forces are
computed.
"""

from collections.abc import Mapping
from typing import Any

import jax
import numpy as np
import xarray as xr

from jaxgran.analysis.contacts import ForceNetwork, force_network
from jaxgran.dynamics.snapshots import snapshot
from jaxgran.maps.replica import Key, Replica
from jaxgran.model.choices import Activation
from jaxgran.model.flow import ShearFlow
from jaxgran.model.grains import Grains
from jaxgran.model.state import State
from jaxgran.model.status import GIVEN_UP, Status

_OF_GRAINS = {"positions": (2,), "velocities": (2,), "radii": (), "masses": ()}
FIELDS = (*_OF_GRAINS, "side", "tilt")
"""The variables of the group ``states``."""


def first_of_points(replicas: Mapping[Key, Replica | None]) -> dict[int, State]:
    """The last state of the first good seed of every point that has one."""
    good = {
        key: replica.state
        for key, replica in replicas.items()
        if replica is not None and replica.status < GIVEN_UP and replica.state is not None
    }
    return {point: good[point, seed] for point, seed in sorted(good, reverse=True)}


def state_values(count: int, states: Mapping[int, State]) -> dict[str, np.ndarray]:
    """The fields of the states of ``count`` points, by name; NaN for points without one, and after
    the last grain.

    Args:
      count: number of points.
      states: states by the number of the point.
    """
    grains = max((len(state.grains.radii) for state in states.values()), default=0)
    columns = {}
    for name in FIELDS:
        shape = (grains, *_OF_GRAINS[name]) if name in _OF_GRAINS else ()
        column = columns[name] = np.full((count, *shape), np.nan)
        for point, state in states.items():
            owner = state.grains if name in ("radii", "masses") else state
            part = np.asarray(getattr(owner, name))
            column[(point, slice(len(part))) if shape else point] = part
    return columns


def state_of(values: Mapping[str, np.ndarray], dtype: Any = float) -> State | None:
    """The state of one point from its values by name; None if it has none."""
    if not np.isfinite(values["side"]):
        return None
    grains = np.isfinite(values["radii"])
    fields: dict[str, Any] = {
        name: np.asarray(values[name][grains] if name in _OF_GRAINS else values[name], dtype)
        for name in FIELDS
    }
    return State(Grains(fields.pop("radii"), fields.pop("masses")), **fields)


def states_of(data: xr.Dataset, count: int, dtype: Any = float) -> dict[int, State]:
    """The states in the group ``states`` of a map of ``count`` points, by the number of the
    point.
    """
    columns = {}
    for name in FIELDS:
        column = data[name].values
        further = 1 + len(_OF_GRAINS[name]) if name in _OF_GRAINS else 0
        columns[name] = column.reshape(count, *column.shape[column.ndim - further :])
    states = (
        state_of({name: column[point] for name, column in columns.items()}, dtype)
        for point in range(count)
    )
    return {point: state for point, state in enumerate(states) if state is not None}


_snapshot = jax.jit(snapshot)


def instant_at(
    state: State,
    restitution: float,
    packing_fraction: float,
    timestep: float,
    activation: Activation,
) -> ForceNetwork | None:
    """The grains of a state, and the forces of the time step that begins with it, by the default
    solver, in float64 also where JAX has another precision.

    None where contacts may be missing or have no solution.
    """
    flow = ShearFlow(
        len(state.grains.radii), restitution, packing_fraction, timestep, activation=activation
    )
    with jax.enable_x64(True):
        last = _snapshot(flow, state)
    return None if last.status >= Status.infeasible else force_network(last)
