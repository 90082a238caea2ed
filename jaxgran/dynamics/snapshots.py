"""The snapshot of a flow now, and series of them at equal intervals of strain."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Int

from jaxgran.contact.compaction import pack_bits
from jaxgran.contact.delassus import NetworkOperator
from jaxgran.contact.near_pairs import outer_pairs
from jaxgran.contact.network import MOST_CONTACTS, ContactPairs, Contacts, is_contact, pair_motion
from jaxgran.contact.projected_methods import DEFAULT_SOLVER, ProjectedMethod
from jaxgran.contact.solver import solve
from jaxgran.dynamics.advance import advance_replica
from jaxgran.dynamics.batch import checked_batch, shear_batch
from jaxgran.dynamics.engine import Engine, Numerics, checked_numerics
from jaxgran.dynamics.snapshot import Snapshot, snapshot_of
from jaxgran.dynamics.step import closing_speed_bound
from jaxgran.model.checks import as_array, require, require_whole
from jaxgran.model.flow import ShearFlow, require_strain, steps_of_blocks, steps_of_strain
from jaxgran.model.state import State, check_precision, require_state
from jaxgran.model.status import Status

_MOST_GRAIN_SNAPSHOTS = 10**9  # snapshots times grains of one series; memory is limited


def snapshot(flow: ShearFlow, state: State, solver: ProjectedMethod = DEFAULT_SOLVER) -> Snapshot:
    """The snapshot of a flow now: the contact network of the next step is solved, and nothing
    moves.
    """
    network, status = contacts_now(flow, state)
    operator, approaches = NetworkOperator(network, flow.grains), jnp.any(network.approach < 0)
    solution = solve(operator, flow.shear_rate, solver, approaches)
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
    contacts = ContactPairs(pairs.i, pairs.j, pairs.reach, motion, contact)
    return contacts.compacted(room, pack_bits(contact)).network(grains), status


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
    check_precision(flow, state)


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
    state, tally = advance_replica(flow, state, steps, numerics)
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
