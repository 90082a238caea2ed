"""The last state of each point of a map with ``snapshots``, from which its contacts and forces are
computed.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np

from jaxgran.analysis.contacts import ForceNetwork, force_network
from jaxgran.dynamics.snapshots import snapshot
from jaxgran.model.choices import Activation
from jaxgran.model.flow import ShearFlow
from jaxgran.model.grains import Grains
from jaxgran.model.state import State
from jaxgran.model.status import Status

_OF_GRAINS = {"positions": (2,), "velocities": (2,), "radii": (), "masses": ()}
FIELDS = (*_OF_GRAINS, "side", "tilt")
"""The variables of the group ``states``."""


def state_values(states: Sequence[State | None]) -> dict[str, np.ndarray]:
    """The fields of the states of points, by name; NaN for points without one, and after the last
    grain.
    """
    known = {point: values_of(state) for point, state in enumerate(states) if state is not None}
    grains = max((len(values["radii"]) for values in known.values()), default=0)
    columns = {}
    for name in FIELDS:
        shape = (grains, *_OF_GRAINS[name]) if name in _OF_GRAINS else ()
        column = columns[name] = np.full((len(states), *shape), np.nan)
        for point, values in known.items():
            part = values[name]
            column[(point, slice(len(part))) if shape else point] = part
    return columns


def values_of(state: State) -> dict[str, np.ndarray]:
    """The fields of a state by name."""
    owners = {"radii": state.grains, "masses": state.grains}
    return {name: np.asarray(getattr(owners.get(name, state), name)) for name in FIELDS}


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
