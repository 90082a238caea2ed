"""Snapshots: flows at single instants, with the contact forces at that instant.

A time step begins with the state of a snapshot. Its contacts change the velocities at once
(``collided``). The grains then fly freely for dt (``flown``). A contact force is the impulse over
dt.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from jaxgran.contact.delassus import grain_impulses
from jaxgran.contact.near_pairs import bit_words, outer_pairs
from jaxgran.contact.network import MOST_CONTACTS, Contacts, Touching, is_contact, pair_motion
from jaxgran.contact.projected_methods import DEFAULT_SOLVER, ProjectedMethod
from jaxgran.contact.solver import solve
from jaxgran.dynamics.advance import advance
from jaxgran.dynamics.batch import checked_batch, shear_batch
from jaxgran.dynamics.engine import Engine, Numerics, checked_numerics
from jaxgran.dynamics.step import closing_speed_bound
from jaxgran.model.cell import remap_tilt, wrap
from jaxgran.model.checks import as_array, require, require_whole
from jaxgran.model.flow import ShearFlow, require_strain, steps_of_blocks, steps_of_strain
from jaxgran.model.state import State, require_state
from jaxgran.model.status import Status
from jaxgran.model.values import Indexable

_MOST_GRAIN_SNAPSHOTS = 10**9  # snapshots times grains of one series; memory is limited


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


def snapshot(flow: ShearFlow, state: State, solver: ProjectedMethod = DEFAULT_SOLVER) -> Snapshot:
    """The snapshot of a flow now: the contact network of the next step is solved, and nothing
    moves.
    """
    network, status = contacts_now(flow, state)
    solution = solve(network, flow.grains, flow.shear_rate, solver, jnp.any(network.approach < 0))
    restitution = jnp.asarray(flow.restitution, state.side.dtype)
    return snapshot_of(
        flow,
        state,
        network,
        (1 + restitution) * solution.impulses,
        jnp.maximum(status, solution.status),
    )


def contacts_now(flow: ShearFlow, state: State) -> tuple[Contacts, Int[Array, ""]]:
    """The contact network that the next time step of a flow would solve, in a buffer that holds any
    packing.

    The status is ``capacity`` where contacts may be missing: a step looks further ahead than the
    list of pairs, or has more contacts than discs that hardly overlap.
    """
    grains, velocities = state.grains, state.velocities
    pairs = outer_pairs(state.positions, grains, state.side, state.tilt)
    motion = pair_motion(pairs.i, pairs.j, pairs.separations, velocities, flow.shear_rate)
    look_ahead = flow.activation * flow.timestep
    contact, _ = is_contact(motion, pairs.reach, look_ahead)
    room = MOST_CONTACTS * grains.radii.size
    suffices = pairs.skin >= closing_speed_bound(flow, grains, velocities, pairs.skin) * look_ahead
    missing = ~suffices | pairs.overflow | (jnp.sum(contact, dtype=jnp.int32) > room)
    status = jnp.where(missing, Status.capacity, Status.ok).astype(jnp.int32)
    touching = Touching(pairs.i, pairs.j, pairs.reach, motion, contact)
    return touching.compacted(room, bit_words(contact)).network(grains), status


def snapshot_of(
    flow: ShearFlow, state: State, contacts: Contacts, impulses: Array, status: Array
) -> Snapshot:
    """The snapshot of a flow, from its contacts and their solved impulses."""
    timestep, shear_rate, restitution = (
        jnp.asarray(x, state.side.dtype) for x in (flow.timestep, flow.shear_rate, flow.restitution)
    )
    return Snapshot(state, contacts, impulses, timestep, shear_rate, restitution, status)


def snapshot_series(
    flow: ShearFlow,
    state: State,
    strain: float | Array,
    count: int,
    *,
    solver: ProjectedMethod = DEFAULT_SOLVER,
    engine: Engine | None = None,
) -> tuple[State, Snapshot]:
    """Shear a flow, or a batch of flows, and take snapshots at equal intervals of strain; ``jit``
    and ``vmap`` apply.

    Args:
      flow: parameters of the state; or those (replicas,) of a batch, as in ``sample``.
      state: the flow at the beginning, usually from ``prepare``; or a batch of states.
      strain: total strain, rounded to whole time steps; for a batch also (replicas,). A new value
        does not recompile.
      count: number of snapshots, static. The first is taken after a strain of ``strain / count``.
        With a strain of ``count`` time steps, there is a snapshot of every step.
      solver, engine: as in ``advance``; the solver also solves the contacts of the snapshots.

    Returns:
      The final state, which is that of the last snapshot, and the snapshots with a leading (times,)
      axis; before it is that of the replicas of a batch.

    Raises:
      InputError: (a ValueError) the axes of a batch differ; the strain is not a positive number, is
        shorter than one time step a snapshot, or is longer than 2**31 - 1 time steps; or the engine
        cannot do this.
    """
    numerics = checked_numerics(solver, engine)
    strain = as_array(strain)
    require("strain", strain, lambda x: (x > 0) & np.isfinite(x), "a positive number")
    if batch := checked_batch(partial(_require_series, count), flow, state, strain):
        return shear_batch(_snapshot_series, numerics, batch, (count,))
    return _snapshot_series(flow, state, strain, numerics, count)


def _require_series(count: int, flow: ShearFlow, state: State, strain: Any) -> None:
    require_state(flow, state)
    require_whole("count", count, 1, _MOST_GRAIN_SNAPSHOTS // flow.grains, "as memory is limited")
    require_strain(flow, strain, count)


@partial(jax.jit, static_argnames="count")
def _snapshot_series(
    flow: ShearFlow, state: State, strain: Array, numerics: Numerics, count: int
) -> tuple[State, Snapshot]:
    return lax.scan(
        partial(_later, flow, numerics),
        state,
        steps_of_blocks(steps_of_strain(flow, strain), count),
    )


def _later(
    flow: ShearFlow, numerics: Numerics, state: State, steps: Array
) -> tuple[State, Snapshot]:
    """The state after some time steps, and its snapshot with the worst status since."""
    state, tally = advance(flow, state, steps, solver=numerics.solver, engine=numerics.engine)
    new = snapshot(flow, state, numerics.solver)
    return state, replace(new, status=jnp.maximum(new.status, tally.status))


_snapshot, _after_steps = jax.jit(snapshot), jax.jit(_later)


def snapshots_from(
    flow: ShearFlow, numerics: Numerics, state: State, strain: float | Array
) -> Snapshot:
    """The snapshots of all time steps of a strain that begins at a state, on the host, with the
    loaded contacts only.

    For a strain of one time step or less it is a single snapshot instead of a series, with all
    contacts.
    """
    snapshots = [jax.tree.map(np.asarray, _snapshot(flow, state, numerics.solver))]
    steps = int(steps_of_strain(flow, strain))
    if steps <= 1:
        return snapshots[0]
    for _ in range(steps - 1):
        state, now = _after_steps(flow, numerics, state, np.int32(1))
        snapshots.append(jax.tree.map(np.asarray, now))
    return _series_of_loaded(snapshots)


def _series_of_loaded(snapshots: Sequence[Snapshot]) -> Snapshot:
    """One series of single snapshots, with as many slots as the most loaded contacts of a time."""
    slots = [np.flatnonzero(snapshot.impulses > 0) for snapshot in snapshots]
    most = max(map(len, slots))

    def loaded(values: Array, slots: np.ndarray) -> np.ndarray:
        return np.pad(
            np.asarray(values)[slots], [(0, most - len(slots)), *[(0, 0)] * (np.ndim(values) - 1)]
        )

    def with_loaded(snapshot: Snapshot, slots: np.ndarray) -> Snapshot:
        contacts, impulses = jax.tree.map(
            partial(loaded, slots=slots), (snapshot.contacts, snapshot.impulses)
        )
        return replace(snapshot, contacts=contacts, impulses=impulses)

    return jax.tree.map(lambda *x: np.stack(x), *map(with_loaded, snapshots, slots))


def collided(snapshot: Snapshot) -> State:
    """The state after the contacts of a snapshot have acted, before the free flight."""
    state = snapshot.state
    momenta = grain_impulses(snapshot.contacts, snapshot.impulses, state.grains.radii.size)
    return replace(state, velocities=state.velocities + momenta / state.grains.masses[:, None])


def flown(state: State, shear_rate: float | Array, time: float | Array) -> State:
    """The state after free flight: grains keep their velocity in the laboratory frame, and the cell
    is sheared.
    """
    cx, cy = state.velocities[:, 0], state.velocities[:, 1]
    x, y = state.positions[:, 0], state.positions[:, 1]
    moved = jnp.stack([x + time * (cx + shear_rate * y), y + time * cy], axis=-1)
    tilt = remap_tilt(state.tilt + shear_rate * time)
    velocities = jnp.stack([cx - shear_rate * time * cy, cy], axis=-1)
    return replace(state, positions=wrap(moved, state.side, tilt), velocities=velocities, tilt=tilt)
