"""Snapshots: flows at single instants with the contact forces that act then, for all that needs more than sums.

A time step begins with the state of a snapshot: its contacts change the velocities at once, and the grains then fly
freely for dt. So the contact forces are impulses over dt, and ``collided`` and ``flown`` are the two halves of a step.
"""

from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from jaxgran.contact.delassus import grain_impulses
from jaxgran.contact.network import Contacts
from jaxgran.contact.solver import solve
from jaxgran.dynamics.advance import advance
from jaxgran.dynamics.collision import contacts_now
from jaxgran.model.cell import remap_tilt, wrap
from jaxgran.model.checks import require_whole
from jaxgran.model.flow import ShearFlow, require_strain
from jaxgran.model.state import State, require_state

_MOST_SNAPSHOTS = 10**9  # times grains


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Snapshot:
    """A flow at the beginning of a time step, with the contacts of that step; a series has a leading (times,) axis.

    ===========  ===========  ====  ===============================================================
    field        shape        unit  meaning
    ===========  ===========  ====  ===============================================================
    state        State        –     positions, and velocities before the contacts act
    contacts     Contacts     –     the contact network of the step
    impulses     (contacts,)  mσγ̇   impulse p of each contact: grain i gains p n, grain j loses it
    timestep     ()           1/γ̇   dt; the force of a contact is p/dt
    shear_rate   ()           1/t   γ̇
    restitution  ()           –     α
    status       ()           –     the worst status since the snapshot before, this solve included
    ===========  ===========  ====  ===============================================================
    """

    state: State
    contacts: Contacts
    impulses: Float[Array, "*times contacts"]
    timestep: Float[Array, "*times"]
    shear_rate: Float[Array, "*times"]
    restitution: Float[Array, "*times"]
    status: Int[Array, "*times"]


def snapshot(flow: ShearFlow, state: State) -> Snapshot:
    """The snapshot of a flow as it is: its next contact network is solved, nothing moves."""
    network = contacts_now(flow, state)
    solution = solve(
        network,
        flow.grains,
        flow.shear_rate,
        flow.tolerance,
        flow.max_iterations,
        flow.relaxation,
        flow.solver,
        jnp.any(network.approach < 0),
    )
    restitution = jnp.asarray(flow.restitution, state.side.dtype)
    return snapshot_of(flow, state, network, (1 + restitution) * solution.impulses, solution.status)


def snapshot_of(flow: ShearFlow, state: State, contacts: Contacts, impulses: Array, status: Array) -> Snapshot:
    """The snapshot of a flow whose contacts have been solved."""
    timestep, shear_rate, restitution = (
        jnp.asarray(x, state.side.dtype) for x in (flow.timestep, flow.shear_rate, flow.restitution)
    )
    return Snapshot(state, contacts, impulses, timestep, shear_rate, restitution, status)


def snapshot_series(flow: ShearFlow, state: State, strain: float | Array, count: int) -> tuple[State, Snapshot]:
    """Shear a flow and take snapshots at equal distances of strain; ``jit``, ``vmap`` and ``lax.map`` apply.

    Args:
      flow: parameters, those of the state.
      state: the flow at the beginning, best from ``prepare``.
      strain: strain to shear in all, rounded to whole time steps. A change of it compiles nothing anew.
      count: number of snapshots, static; the first follows a strain of ``strain / count``. With a strain of ``count``
        time steps, every step is taken.

    Returns:
      The state at the end, which is that of the last snapshot, and the snapshots with a leading (times,) axis.

    Raises:
      ValueError: the strain is not a positive number, shorter than a time step for each snapshot or longer than
        2**31 - 1 of them.
    """
    require_state(flow, state)
    require_whole("count", count, 1, _MOST_SNAPSHOTS // flow.grains, "as memory is limited")
    require_strain(flow, strain, count)
    return _snapshot_series(flow, state, strain, count)


@partial(jax.jit, static_argnames="count")
def _snapshot_series(flow: ShearFlow, state: State, strain: Array, count: int) -> tuple[State, Snapshot]:
    steps = jnp.round(strain / (flow.shear_rate * flow.timestep))
    edges = jnp.round(steps * jnp.arange(count + 1, dtype=steps.dtype) / count)

    def one(now: State, steps: Array) -> tuple[State, Snapshot]:
        now, tally = advance(flow, now, steps)
        seen = snapshot(flow, now)
        return now, replace(seen, status=jnp.maximum(seen.status, tally.status))

    return lax.scan(one, state, jnp.diff(edges).astype(jnp.int32))


def collided(seen: Snapshot) -> State:
    """The state after the contacts of a snapshot have acted, before the flight."""
    state = seen.state
    gained = grain_impulses(seen.contacts, seen.impulses, state.grains.radii.size)
    return replace(state, velocities=state.velocities + gained / state.grains.masses[:, None])


def flown(state: State, shear_rate: float | Array, time: float | Array) -> State:
    """The state after free flight: every grain keeps its velocity in the laboratory, and the cell shears."""
    cx, cy = state.velocities[:, 0], state.velocities[:, 1]
    x, y = state.positions[:, 0], state.positions[:, 1]
    moved = jnp.stack([x + time * (cx + shear_rate * y), y + time * cy], axis=-1)
    tilt = remap_tilt(state.tilt + shear_rate * time)
    velocities = jnp.stack([cx - shear_rate * time * cy, cy], axis=-1)
    return replace(state, positions=wrap(moved, state.side, tilt), velocities=velocities, tilt=tilt)
