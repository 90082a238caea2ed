"""A snapshot: a flow at one instant, with the contact forces at that instant.

A time step begins with the state of a snapshot. Its contacts change the velocities at once
(``collided``). The grains then fly freely for dt (``free_flight``). A contact force is the impulse
over dt.
"""

from dataclasses import dataclass, replace
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxgran.contact.delassus import grain_impulses
from jaxgran.contact.network import Contacts
from jaxgran.model.cell import remap_tilt, wrap
from jaxgran.model.flow import ShearFlow
from jaxgran.model.state import State
from jaxgran.model.status import Status
from jaxgran.model.values import Indexable


@dataclass(frozen=True, eq=False, repr=False)
class Snapshot(Indexable):
    """A flow at the beginning of a time step, with the contacts of that step; a series has a
    leading (times,) axis.

    ===========  ===========  ====  ===============================================================
    field        shape        unit  meaning
    ===========  ===========  ====  ===============================================================
    state        State        –     positions, and velocities before the contacts act
    contacts     Contacts     –     the contact network of the step
    impulses     (contacts,)  mσ/t  impulse J of each contact: grain i gains J n, grain j loses J n
    timestep     ()           t     dt; the force of a contact is J/dt
    shear_rate   ()           1/t   γ̇
    restitution  ()           –     α
    status       ()           –     worst status since the last snapshot, with that of its own solve
    ===========  ===========  ====  ===============================================================
    """

    state: State
    contacts: Contacts
    impulses: Float[Array, "*times contacts"]
    timestep: Float[Array, "*times"]
    shear_rate: Float[Array, "*times"]
    restitution: Float[Array, "*times"]
    status: Int[Array, "*times"]

    def _shown(self) -> dict[str, Any]:
        return {
            **({"times": len(self)} if self._axes else {}),
            "grains": np.shape(self.state.positions)[-2],
            "loaded_contacts": np.sum(np.asarray(self.impulses) > 0, axis=-1),
            "timestep": self.timestep,
            "shear_rate": self.shear_rate,
            "restitution": self.restitution,
            "status": Status(int(np.max(self.status))).name,
        }

    @property
    def _axes(self) -> tuple[int, ...]:
        return np.shape(self.state.side)


def snapshot_of(
    flow: ShearFlow, state: State, contacts: Contacts, impulses: Array, status: Array
) -> Snapshot:
    """The snapshot of a flow, from its contacts and their solved impulses."""
    numbers = flow.timestep, flow.shear_rate, flow.restitution
    timestep, shear_rate, restitution = (jnp.asarray(x, state.side.dtype) for x in numbers)
    return Snapshot(state, contacts, impulses, timestep, shear_rate, restitution, status)


def collided(snapshot: Snapshot) -> State:
    """The state after the contacts of a snapshot have acted, before the free flight."""
    state = snapshot.state
    momenta = grain_impulses(snapshot.contacts, snapshot.impulses, state.grains.radii.size)
    return replace(state, velocities=state.velocities + momenta / state.grains.masses[:, None])


def free_flight(state: State, shear_rate: float | Array, time: float | Array) -> State:
    """The state after free flight: grains keep their velocity in the laboratory frame, and the cell
    is sheared.
    """
    cx, cy = state.velocities[:, 0], state.velocities[:, 1]
    x, y = state.positions[:, 0], state.positions[:, 1]
    moved = jnp.stack([x + time * (cx + shear_rate * y), y + time * cy], axis=-1)
    tilt = remap_tilt(state.tilt + shear_rate * time)
    velocities = jnp.stack([cx - shear_rate * time * cy, cy], axis=-1)
    return replace(state, positions=wrap(moved, state.side, tilt), velocities=velocities, tilt=tilt)
