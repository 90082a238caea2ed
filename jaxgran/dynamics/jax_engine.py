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

from dataclasses import replace
from functools import partial
from typing import TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Int

from jaxgran.contact.near_pairs import present
from jaxgran.contact.projected_methods import ProjectedMethod
from jaxgran.dynamics.carry import Carry, Constants, start
from jaxgran.dynamics.observer import Observe
from jaxgran.dynamics.step import event, needs_lists, refresh_lists, unfinished
from jaxgran.dynamics.tally import RunningSums, Tally
from jaxgran.dynamics.velocity_scales import readings
from jaxgran.model.control_flow import any_replica
from jaxgran.model.flow import ShearFlow
from jaxgran.model.state import State, kinetic_energy, relative_momentum, status_if_finite
from jaxgran.model.status import Status

T = TypeVar("T")


def contact_buffers(grains: int) -> tuple[int, ...]:
    """Sizes of the buffers for the contacts of dilute and of dense flows, smallest first."""
    return tuple(sorted({max(4, grains // 3), max(4, grains)}))


def advance_by_jax(
    flow: ShearFlow,
    solver: ProjectedMethod,
    state: State,
    steps: Int[Array, "*blocks"],
    observe: Observe | None = None,
    *,
    events: int | None = None,
    moving_contacts: bool = False,
    free_flight: bool = True,
) -> tuple[State, Tally]:
    """Advance one replica by a number of steps, or by one block of steps after another with a tally
    (blocks,) for each.

    The options are those of the engine ``Jax``.
    """
    # For derivatives, one size of a solve is compiled.
    derivatives = events is not None or moving_contacts

    def advance(state: State, steps: Array) -> tuple[State, Tally]:
        constants = _constants(flow, solver, state, steps)._replace(
            free_flight=free_flight,
            buffers=() if derivatives else contact_buffers(flow.grains),
            moving_contacts=moving_contacts,
            observe=observe,
        )
        begin = start(constants, state)
        if events is None:
            return _result(constants, state, _all_events(constants, begin))
        end = _fixed_number_of_events(constants, begin, events)
        return _nan_where(unfinished(constants, end), _result(constants, state, end))

    return lax.scan(advance, state, steps) if jnp.ndim(steps) else advance(state, steps)


def _constants(flow: ShearFlow, solver: ProjectedMethod, state: State, steps: Array) -> Constants:
    """The constants of an advance, with the numbers of the flow in the precision of the state."""
    numbers = jax.tree.map(lambda x: jnp.asarray(x, state.side.dtype), flow)
    return Constants(numbers, state.grains, state.side, steps, solver)


def _events_of_list(constants: Constants, now: Carry) -> Carry:
    """New lists, and the events until one replica of the batch needs the next; at least one
    event.
    """

    def keep_going(at: tuple[Array, Carry]) -> Array:
        is_first, now = at
        stale = any_replica(needs_lists(constants, now))
        return any_replica(unfinished(constants, now)) & (is_first | ~stale)

    begin = jnp.bool_(True), refresh_lists(constants, now)
    _, after = lax.while_loop(
        keep_going, lambda at: (jnp.bool_(False), event(constants, at[1])), begin
    )
    return after


def _all_events(constants: Constants, begin: Carry) -> Carry:
    """The end of as many events as there are: a loop over lists round one over events."""
    return lax.while_loop(
        lambda now: any_replica(unfinished(constants, now)),
        partial(_events_of_list, constants),
        begin,
    )


def _next_event(constants: Constants, now: Carry) -> Carry:
    """The next event, with new lists where they are needed."""
    stale = any_replica(needs_lists(constants, now))
    listed = lax.cond(stale, partial(refresh_lists, constants), lambda now: now, now)
    return event(constants, listed)


def _fixed_number_of_events(constants: Constants, begin: Carry, events: int) -> Carry:
    """The end of a loop of fixed length; reverse mode keeps what is carried and computes all else
    again.
    """

    def visit(now: Carry, _: None) -> tuple[Carry, None]:
        active = any_replica(unfinished(constants, now))
        return lax.cond(active, partial(_next_event, constants), lambda now: now, now), None

    return lax.scan(jax.checkpoint(visit), begin, length=events)[0]


def _nan_where(invalid: Array, values: T) -> T:
    """The values, with NaN in place of every real number where they are invalid, and in all of
    their derivatives.
    """
    factor = jnp.where(invalid, jnp.nan, 1.0)
    return jax.tree.map(
        lambda x: x * factor.astype(x.dtype) if jnp.issubdtype(x.dtype, jnp.inexact) else x, values
    )


def _result(constants: Constants, state: State, end: Carry) -> tuple[State, Tally]:
    """The state and the tally at the end of an advance from a state."""
    short = jnp.where(unfinished(constants, end), Status.capacity, Status.ok).astype(jnp.int32)
    sums = end.sums._replace(status=jnp.maximum(end.sums.status, short))
    after, tally = end_of_advance(state, *present(end.lists, state.side), end.velocities, sums)
    observed = None if constants.observe is None else sums.user_sums.sums
    return after, replace(tally, observed=observed)


def end_of_advance(
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


def events_by_jax(
    flow: ShearFlow, solver: ProjectedMethod, state: State, steps: Int[Array, ""]
) -> Int[Array, ""]:
    """Steps that ``advance_by_jax`` visits."""
    constants = _constants(flow, solver, state, steps)

    def keep_going(at: tuple[Array, Carry]) -> Array:
        return any_replica(unfinished(constants, at[1]))

    def visit(at: tuple[Array, Carry]) -> tuple[Array, Carry]:
        number, now = at
        return number + unfinished(constants, now).astype(number.dtype), _next_event(constants, now)

    return lax.while_loop(keep_going, visit, (jnp.int32(0), start(constants, state)))[0]
