"""Advances one replica by the numba engine, and sums what a user's function observes, from the
records of the engine.
"""

from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Int

from jaxgran.contact.delassus import grain_impulses
from jaxgran.contact.network import MOST_CONTACTS, Contacts
from jaxgran.contact.projected_methods import ProjectedMethod
from jaxgran.dynamics.numba_engine import layout
from jaxgran.dynamics.numba_engine.call import (
    NumbaCall,
    advance_unobserved,
    call_numba,
    ended_by_numba,
    first_row,
)
from jaxgran.dynamics.observer import (
    Observe,
    Observed,
    middle_of_flight,
    nothing_observed,
    observe_at,
    with_contacts,
    with_flight,
)
from jaxgran.dynamics.snapshot import free_flight
from jaxgran.dynamics.tally import Tally, place_of
from jaxgran.model.cell import wrap
from jaxgran.model.flow import ShearFlow
from jaxgran.model.grains import Grains
from jaxgran.model.state import State

_MOST_ROOM = 320  # records of one call; usual lists have some 10 to 300, mostly of small time steps
_LEAST_ROOM = 2  # those of a list and of its first contacts
_MOST_BYTES = 2**26  # of the records of one call, above 170,000 grains those of the least
_STEPS = place_of("steps")
_FEW = 16  # grains for a slot in the smaller one of two buffers for contacts


def records_of_call(grains: int) -> int:
    """How many records a call of the numba engine keeps, within ``_MOST_BYTES``."""
    return max(_LEAST_ROOM, min(_MOST_ROOM, _MOST_BYTES // (8 * layout.record_numbers(grains))))


class _Progress(NamedTuple):
    """An advance by one call of the numba engine after another: whether the last one is unfinished,
    the grains as it has left them, and its last row.
    """

    unfinished: Array
    state: State
    row: Array
    user_sums: Any


def advance_by_numba(
    flow: ShearFlow,
    solver: ProjectedMethod,
    state: State,
    steps: Int[Array, "*blocks"],
    observe: Observe | None = None,
) -> tuple[State, Tally]:
    """Advance one replica by a number of steps, or by one block of steps after another with a tally
    (blocks,) for each; with the sums of what a function observes.
    """
    if observe is not None:
        run = partial(_advance_observed, observe, flow, solver)
        return lax.scan(run, state, steps) if jnp.ndim(steps) else run(state, steps)
    if jnp.ndim(steps):
        return advance_unobserved(flow, solver, state, steps)
    end, tally = advance_unobserved(flow, solver, state, steps[None])
    return end, jax.tree.map(lambda x: x[0], tally)


def _advance_observed(
    observe: Observe, flow: ShearFlow, solver: ProjectedMethod, state: State, steps: Array
) -> tuple[State, Tally]:
    """Advance one replica, and sum over all time steps what a function finds in them.

    The engine does not call the function. It records the steps that it visits until its list of
    near pairs ends; then JAX applies the function to the records, and the next call goes on from
    there. So only the function is compiled, not an engine. The trajectory is that of
    ``advance_unobserved`` to the bit, but for rounding where the steps of a list outnumber the
    records, or in flows so large that the engine puts its grains in order.
    """
    dtype, room = state.positions.dtype, records_of_call(flow.grains)

    def called(now: _Progress) -> _Progress:
        done = now.row[_STEPS]
        call = call_numba(flow, solver, now.state, steps[None].astype(dtype) - done, now.row, room)
        row = call.blocks[0]
        moved = replace(now.state, positions=call.positions, velocities=call.velocities)
        user_sums = _with_records(flow, state, observe, now.user_sums, call, row[_STEPS] - done)
        return _Progress(row[layout.UNFINISHED] > 0, moved, row, user_sums)

    at_start = observe_at(observe, flow, state)
    nothing = nothing_observed(at_start, MOST_CONTACTS * flow.grains, dtype).sums
    start = _Progress(jnp.bool_(True), state, first_row(flow, state), nothing)
    end = lax.while_loop(lambda now: now.unfinished, called, start)
    after, tally = ended_by_numba(state, end.state, end.row)
    return after, replace(tally, observed=end.user_sums)


def _with_records(
    flow: ShearFlow, state: State, observe: Observe, user_sums: Any, call: NumbaCall, steps: Array
) -> Any:
    """The user sums with what is found in the records of a call of so many steps."""
    records, count = call.records, call.blocks[0, layout.RECORDED].astype(jnp.int32)
    dtype = records.dtype
    timestep, shear_rate = (jnp.asarray(x, dtype) for x in (flow.timestep, flow.shear_rate))
    most = MOST_CONTACTS * flow.grains
    sizes = max(4, flow.grains // _FEW), most

    def with_record(k: Array, user_sums: Any) -> Any:
        record = records[k]
        before = _recorded_state(record, state)

        def with_slots(slots: int) -> tuple[Any, Array]:
            contacts, impulses = _recorded_contacts(record, state.grains, slots)
            kicks = grain_impulses(contacts, impulses, flow.grains) / state.grains.masses[:, None]
            so_far = Observed(user_sums, jnp.zeros((), dtype))
            now = observe_at(observe, flow, before)
            return with_contacts(so_far, now, contacts, impulses).sums, kicks

        size = jnp.sum(
            record[layout.RECORD_CONTACTS] > jnp.asarray([0, *sizes[:-1]], dtype), dtype=jnp.int32
        )
        branches = [
            lambda: (user_sums, jnp.zeros_like(before.velocities)),
            *(partial(with_slots, n) for n in sizes),
        ]
        sums, kicks = lax.switch(size, branches)
        after = State(
            state.grains, before.positions, before.velocities + kicks, state.side, before.tilt
        )
        until = jnp.where(
            k + 1 < count, records[jnp.minimum(k + 1, len(records) - 1), layout.RECORD_STEP], steps
        )
        # The step whose contacts have acted, in this record or an earlier one, is in the sums.
        so_far = Observed(sums, record[layout.RECORD_SOLVED])
        flight = until - record[layout.RECORD_STEP]
        middle = free_flight(after, shear_rate, middle_of_flight(so_far, flight) * timestep)
        return with_flight(so_far, observe_at(observe, flow, middle), flight).sums

    return lax.fori_loop(0, count, with_record, user_sums)


def _recorded_state(record: Array, state: State) -> State:
    """The state of a record, before its contacts act."""
    tilt, count = record[layout.RECORD_TILT], state.grains.radii.size
    numbers = record[layout.RECORD_HEAD : layout.RECORD_HEAD + layout.RECORD_OF_GRAIN * count]
    motion = numbers.reshape(count, layout.RECORD_OF_GRAIN)
    positions, velocities = wrap(motion[:, :2], state.side, tilt), motion[:, 2:]
    return State(state.grains, positions, velocities, state.side, tilt)


def _recorded_contacts(record: Array, grains: Grains, slots: int) -> tuple[Contacts, Array]:
    """The contacts of a record and their impulses, in so many slots."""
    first = layout.RECORD_HEAD + layout.RECORD_OF_GRAIN * grains.radii.size
    rows = record[first : first + slots * layout.RECORD_OF_CONTACT].reshape(
        slots, layout.RECORD_OF_CONTACT
    )
    used = jnp.arange(slots, dtype=record.dtype) < record[layout.RECORD_CONTACTS]
    rows = jnp.where(used[:, None], rows, 0)  # what was never written may be anything
    i = rows[:, layout.RECORD_I].astype(jnp.int32)
    j = rows[:, layout.RECORD_J].astype(jnp.int32)
    contacts = Contacts(
        i=i,
        j=j,
        normals=rows[:, layout.NX : layout.APPROACH],
        distances=jnp.where(used, rows[:, layout.DISTANCE], 1),
        approach=rows[:, layout.APPROACH],
        inverse_mass_i=jnp.where(used, 1 / grains.masses[i], 0),
        inverse_mass_j=jnp.where(used, 1 / grains.masses[j], 0),
        used=used,
    )
    return contacts, rows[:, layout.IMPULSE]
