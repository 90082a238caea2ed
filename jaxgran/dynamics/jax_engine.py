"""The engine ``Jax``: one replica through time in JAX, on every backend, with every solver, and
with derivatives.

A time step finds the contacts at its beginning, changes the velocities by the impulses of the
contact network, and flies freely for dt. Between contacts the velocity in the laboratory frame is
constant, so separations are linear in time, and the step in which some pair next becomes an
approaching contact is known in advance. The loop jumps there in one evaluation. The trajectory is
that of the fixed time step; the cost follows the contacts.

Derivatives of a trajectory keep its contacts in their time steps: the numbers of steps flown are
whole and do not change. That is the derivative of what is computed. It is not that of the flow in
the limit dt → 0, in which a contact comes earlier or later where the grains before it are moved.
With ``moving_contacts`` every contact that begins in a step adds what a shift of its time by dτ
does, to first order, with the values as they are. This is exact for collisions of two grains. Where
a grain strikes a cluster, only the impulse that its own approach accounts for moves in time.
"""

from functools import partial
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Int

from jaxgran.contact.near_pairs import present
from jaxgran.contact.projected_methods import DEFAULT_SOLVER, ProjectedMethod, require_solver
from jaxgran.dynamics.observer import Observe
from jaxgran.dynamics.step import (
    Advance,
    Carry,
    event,
    needs_lists,
    refresh_lists,
    start,
    unfinished,
)
from jaxgran.dynamics.tally import RunningSums, Tally
from jaxgran.dynamics.velocity_scales import readings
from jaxgran.model.checks import require_number, require_whole
from jaxgran.model.choices import MAX_STEPS
from jaxgran.model.control_flow import any_replica
from jaxgran.model.flow import ShearFlow
from jaxgran.model.state import (
    State,
    kinetic_energy,
    relative_momentum,
    require_state,
    status_if_finite,
)
from jaxgran.model.status import Status

T = TypeVar("T")


def require_advance(flow: ShearFlow, state: State, steps: Any) -> None:
    """Raise an InputError unless this is one flow, one state of it and a number of time steps."""
    require_state(flow, state)
    words = f"a whole number of 0 to {MAX_STEPS}"
    require_number(
        "steps", steps, lambda x: (x.dtype.kind in "iu") & (x >= 0) & (x <= MAX_STEPS), words
    )


def contact_buffers(grains: int) -> tuple[int, ...]:
    """Sizes of the buffers for the contacts of dilute and of dense flows, smallest first."""
    return tuple(sorted({max(4, grains // 3), max(4, grains)}))


def advance_by_jax(
    flow: ShearFlow,
    solver: ProjectedMethod,
    state: State,
    steps: Int[Array, ""],
    free_flight: bool | Array = True,
    events: int | None = None,
    moving_contacts: bool = False,
) -> tuple[State, Tally]:
    """Advance one replica by the engine ``Jax``.

    Arguments, derivatives and results are those of ``dynamics.advance``.
    """
    # For derivatives, one size of a solve is compiled.
    derivatives = events is not None or moving_contacts
    advance = _advance_of(flow, solver, state, steps)._replace(
        free_flight=free_flight,
        buffers=() if derivatives else contact_buffers(flow.grains),
        moving_contacts=moving_contacts,
    )
    begin = start(advance, state)
    if events is None:
        return _ended(advance, state, _last(advance, begin))
    require_whole("events", events, 1, MAX_STEPS, "the most steps of an advance")
    end = _after_events(advance, begin, events)
    return _nan_where(unfinished(advance, end), _ended(advance, state, end))


def observe_by_jax(
    flow: ShearFlow, solver: ProjectedMethod, state: State, steps: Int[Array, ""], observe: Observe
) -> tuple[State, Tally, Any]:
    """``advance_by_jax``, and the sum over all its time steps of what a function finds in them, see
    ``observer``.
    """
    advance = _advance_of(flow, solver, state, steps)._replace(
        buffers=contact_buffers(flow.grains), observe=partial(observe, flow)
    )
    end = _last(advance, start(advance, state))
    return *_ended(advance, state, end), end.sums.user_sums.sums


def _advance_of(flow: ShearFlow, solver: ProjectedMethod, state: State, steps: Array) -> Advance:
    """The advance of a state, with the numbers of the flow in its precision."""
    numbers = jax.tree.map(lambda x: jnp.asarray(x, state.side.dtype), flow)
    return Advance(numbers, state.grains, state.side, steps, solver)


def _until_stale(advance: Advance, now: Carry) -> Carry:
    """New lists, and the events until one replica of the batch needs the next; at least one
    event.
    """

    def keep_going(at: tuple[Array, Carry]) -> Array:
        is_first, now = at
        stale = any_replica(needs_lists(advance, now))
        return any_replica(unfinished(advance, now)) & (is_first | ~stale)

    begin = jnp.bool_(True), refresh_lists(advance, now)
    _, after = lax.while_loop(
        keep_going, lambda at: (jnp.bool_(False), event(advance, at[1])), begin
    )
    return after


def _last(advance: Advance, begin: Carry) -> Carry:
    """The end of as many events as there are: a loop over lists round one over events."""
    return lax.while_loop(
        lambda now: any_replica(unfinished(advance, now)), partial(_until_stale, advance), begin
    )


def _next(advance: Advance, now: Carry) -> Carry:
    """The next event, with new lists where they are needed."""
    stale = any_replica(needs_lists(advance, now))
    listed = lax.cond(stale, partial(refresh_lists, advance), lambda now: now, now)
    return event(advance, listed)


def _after_events(advance: Advance, begin: Carry, events: int) -> Carry:
    """The end of a loop of fixed length; reverse mode keeps what is carried and computes all else
    again.
    """

    def visit(now: Carry, _: None) -> tuple[Carry, None]:
        going = any_replica(unfinished(advance, now))
        return lax.cond(going, partial(_next, advance), lambda now: now, now), None

    return lax.scan(jax.checkpoint(visit), begin, length=events)[0]


def _nan_where(invalid: Array, values: T) -> T:
    """The values, with NaN in place of every real number where they are invalid, and in all of
    their derivatives.
    """
    factor = jnp.where(invalid, jnp.nan, 1.0)
    return jax.tree.map(
        lambda x: x * factor.astype(x.dtype) if jnp.issubdtype(x.dtype, jnp.inexact) else x, values
    )


def _ended(advance: Advance, state: State, end: Carry) -> tuple[State, Tally]:
    """The state and the tally at the end of an advance from a state."""
    short = jnp.where(unfinished(advance, end), Status.capacity, Status.ok).astype(jnp.int32)
    sums = end.sums._replace(status=jnp.maximum(end.sums.status, short))
    return ended(state, *present(end.lists, state.side), end.velocities, sums)


def ended(
    state: State, positions: Array, tilt: Array, velocities: Array, sums: RunningSums
) -> tuple[State, Tally]:
    """The state and the tally of an advance that led from a state to these positions, tilt and
    velocities.
    """
    grains = state.grains
    end = State(grains, positions, velocities, state.side, tilt)
    finite = status_if_finite(positions, velocities, tilt)
    read = sums.with_reading(readings(end))._replace(status=jnp.maximum(sums.status, finite))
    tally = read.tally(
        energy_change=kinetic_energy(grains, velocities) - kinetic_energy(grains, state.velocities),
        momentum_drift=relative_momentum(grains, velocities),
    )
    return end, tally


def count_events(
    flow: ShearFlow,
    state: State,
    steps: Int[Array, ""],
    free_flight: bool = True,
    *,
    solver: ProjectedMethod = DEFAULT_SOLVER,
) -> Int[Array, ""]:
    """Steps that an advance by the engine ``Jax`` visits: the ``events`` that it needs in a loop of
    fixed length.

    They are those of these numbers only: with another restitution, as in an optimisation, an
    advance may visit more. Leave room, such as half as many again; ``2 * steps + 1`` are always
    enough. Arguments and errors are those of ``advance``.
    """
    require_advance(flow, state, steps)
    require_solver(solver)
    advance = _advance_of(flow, solver, state, steps)._replace(free_flight=free_flight)

    def keep_going(at: tuple[Array, Carry]) -> Array:
        return any_replica(unfinished(advance, at[1]))

    begin = jnp.int32(0), start(advance, state)
    return lax.while_loop(keep_going, lambda at: (at[0] + 1, _next(advance, at[1])), begin)[0]
