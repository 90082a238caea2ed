"""The engine ``Jax``: one replica through time in JAX, on every backend, with every solver, and with derivatives.

A time step finds the contacts at its beginning, changes the velocities by the impulses of the contact network, and
flies freely for dt. Between contacts the velocity in the laboratory frame is constant, so separations are linear
in time, and the step in which some pair next becomes an approaching contact is known in advance. The loop jumps
there in one evaluation. The trajectory is that of the fixed time step; the cost follows the contacts.

Derivatives of a trajectory hold the time steps of its contacts: the numbers of steps flown are whole and do not change.
That is the derivative of what is computed. It is not that of the flow in the limit dt → 0, in which a contact comes
earlier or later where the grains before it are moved. With ``moving_contacts`` every contact that begins in a step adds
what a shift of its time by dτ does, to first order, with the values as they are. This is exact for collisions of two
grains. Where a grain strikes a cluster, only the impulse that its own approach accounts for moves in time.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Int

from jaxgran.contact.near_pairs import PairLists, no_lists, present
from jaxgran.contact.network import Contacts, PairMotion
from jaxgran.contact.projected_methods import DEFAULT_SOLVER, ProjectedMethod, require_solver
from jaxgran.dynamics.collision import AdvanceOptions, Observe, collide, contact_buffers, shifted
from jaxgran.dynamics.flight import (
    Carry,
    add_flight,
    closing_speed,
    fly,
    is_stale,
    steps_of_list,
    steps_to_contact,
    with_new_lists,
)
from jaxgran.dynamics.observer import ObserveNow, nothing_observed, with_flight
from jaxgran.dynamics.tally import RunningSums, Tally, empty_sums
from jaxgran.dynamics.velocity_scales import READ_AFTER, readings
from jaxgran.model.checks import require_number, require_whole
from jaxgran.model.choices import MAX_STEPS
from jaxgran.model.control_flow import any_replica, where_active
from jaxgran.model.flow import ShearFlow
from jaxgran.model.grains import Grains
from jaxgran.model.state import (
    State,
    kinetic_energy,
    relative_momentum,
    require_match,
    require_state,
    status_if_finite,
)
from jaxgran.model.status import Status

T = TypeVar("T")


def require_advance(flow: ShearFlow, state: State, steps: Any) -> None:
    """Raise an InputError unless this is one flow, one state of it and a number of time steps."""
    require_state(flow, state)
    words = f"a whole number of 0 to {MAX_STEPS}"
    require_number("steps", steps, lambda x: (x.dtype.kind in "iu") & (x >= 0) & (x <= MAX_STEPS), words)
    require_match(flow, state)


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
    derivatives = events is not None or moving_contacts  # those of a solve of each size would be compiled
    options = AdvanceOptions(solver, () if derivatives else contact_buffers(flow.grains), moving_contacts)
    loop = _event_loop(flow, state, steps, free_flight, options)
    if events is None:
        end = loop.end()
        return _ended(state, end, loop.unfinished)
    require_whole("events", events, 1, MAX_STEPS, "the most steps of an advance")
    end = loop.scanned(events)
    return _nan_where(loop.unfinished(end), _ended(state, end, loop.unfinished))


def observe_by_jax(
    flow: ShearFlow, solver: ProjectedMethod, state: State, steps: Int[Array, ""], observe: Observe
) -> tuple[State, Tally, Any]:
    """``advance_by_jax``, and the sum over all its time steps of what a function finds in them, see ``observer``."""
    options = AdvanceOptions(solver, contact_buffers(flow.grains), observe=observe)
    loop = _event_loop(flow, state, steps, True, options)
    end = loop.end()
    return *_ended(state, end, loop.unfinished), end.sums.user_sums.sums


def _nan_where(invalid: Array, values: T) -> T:
    """The values, with NaN in place of every real number where they are invalid, and in all of their derivatives."""
    factor = jnp.where(invalid, jnp.nan, 1.0)
    return jax.tree.map(lambda x: x * factor.astype(x.dtype) if jnp.issubdtype(x.dtype, jnp.inexact) else x, values)


def _ended(state: State, end: Carry, unfinished: Callable) -> tuple[State, Tally]:
    """The state and the tally at the end of an advance from a state."""
    short = jnp.where(unfinished(end), Status.capacity, Status.ok).astype(jnp.int32)
    sums = end.sums._replace(status=jnp.maximum(end.sums.status, short))
    return ended(state, *present(end.lists, state.side), end.velocities, sums)


def ended(state: State, positions: Array, tilt: Array, velocities: Array, sums: RunningSums) -> tuple[State, Tally]:
    """The state and the tally of an advance that led from a state to these positions, tilt and velocities."""
    grains = state.grains
    end = State(grains, positions, velocities, state.side, tilt)
    tally = sums.with_reading(readings(end)).tally(
        energy_change=kinetic_energy(grains, velocities) - kinetic_energy(grains, state.velocities),
        momentum_drift=relative_momentum(grains, velocities),
    )
    status = jnp.maximum(sums.status, status_if_finite(positions, velocities))
    return end, replace(tally, status=status)


def count_events(
    flow: ShearFlow,
    state: State,
    steps: Int[Array, ""],
    free_flight: bool = True,
    *,
    solver: ProjectedMethod = DEFAULT_SOLVER,
) -> Int[Array, ""]:
    """Steps that an advance by the engine ``Jax`` visits: the ``events`` that it needs in a loop of fixed length.

    Arguments and errors are those of ``advance``.
    """
    require_advance(flow, state, steps)
    require_solver(solver)
    options = AdvanceOptions(solver)  # as in the loop of fixed length
    return _event_loop(flow, state, steps, free_flight, options).length()


class EventLoop(NamedTuple):
    """The loop over events, in parts: see its methods for how they are put together."""

    start: Carry
    event: Callable[[Carry], Carry]
    listed: Callable[[Carry], Carry]  # with a new list of near pairs
    unfinished: Callable[[Carry], Array]
    stale: Callable[[Carry], Array]  # whether the list has to be made anew

    def until_stale(self, now: Carry) -> Carry:
        """A new list, and the events until one replica of the batch needs the next; at least one event."""

        def goes_on(at: tuple[Array, Carry]) -> Array:
            begins, now = at
            return any_replica(self.unfinished(now)) & (begins | ~any_replica(self.stale(now)))

        start = jnp.bool_(True), self.listed(now)
        return lax.while_loop(goes_on, lambda at: (jnp.bool_(False), self.event(at[1])), start)[1]

    def end(self) -> Carry:
        """The end of as many events as there are: a loop over lists round one over events."""
        return lax.while_loop(lambda now: any_replica(self.unfinished(now)), self.until_stale, self.start)

    def next(self, now: Carry) -> Carry:
        """The next event, with a new list where that is needed."""
        return self.event(lax.cond(any_replica(self.stale(now)), self.listed, lambda now: now, now))

    def scanned(self, events: int) -> Carry:
        """The end of a loop of fixed length; reverse mode keeps what is carried and computes all else again."""

        def one(now: Carry, _: None) -> tuple[Carry, None]:
            return lax.cond(any_replica(self.unfinished(now)), self.next, lambda now: now, now), None

        return lax.scan(jax.checkpoint(one), self.start, length=events)[0]

    def length(self) -> Int[Array, ""]:
        """How many events there are."""

        def going(at: tuple[Array, Carry]) -> Array:
            return any_replica(self.unfinished(at[1]))

        return lax.while_loop(going, lambda at: (at[0] + 1, self.next(at[1])), (jnp.int32(0), self.start))[0]


def _event_loop(flow: ShearFlow, state: State, steps: Array, free_flight: bool | Array, options: AdvanceOptions):
    """Start and body of the loop of an advance, and whether it has to continue."""
    grains, side, observe = state.grains, state.side, options.observe
    observe = None if observe is None else partial(observe, flow)
    flow = jax.tree.map(lambda x: jnp.asarray(x, side.dtype), flow)
    dt, shear_rate = flow.timestep, flow.shear_rate

    def observer_at(lists: PairLists, velocities: Array) -> ObserveNow | None:
        """What the user observes of the flow as it is; None where nothing is observed."""
        return None if observe is None else partial(_observed_at, observe, lists, grains, velocities, side)

    def unfinished(now: Carry):
        return (now.step < steps) & (now.sums.status < Status.nonfinite)

    def event(now: Carry) -> Carry:
        go = unfinished(now)
        lists, pairs, slack, loss = now.lists, now.pairs, now.slack, now.loss
        least = now.solved.astype(jnp.int32)
        jump = steps_to_contact(pairs, lists.near.reach, flow, least)
        jump = jnp.minimum(jump, steps_of_list(now, flow))
        jump = jnp.where(free_flight, jump, 0)
        remaining = steps - now.step
        jump = jnp.clip(jnp.minimum(jump, remaining.astype(jump.dtype)).astype(jnp.int32), least, remaining)
        flight = jump.astype(slack.dtype) * dt

        sums = add_flight(now.sums, now.velocities, grains, jump, flight, shear_rate)
        observe_now = observer_at(lists, now.velocities)
        sums = sums if observe_now is None else sums._replace(user_sums=with_flight(sums.user_sums, observe_now, jump))
        frame, velocities = fly(lists.frame, now.velocities, flight, shear_rate)
        lists, slack = replace(lists, frame=frame), slack - loss * flight
        pairs = pairs.moved(flight)
        step = now.step + jump
        spare = slack - loss * flow.activation_fraction * dt
        expired = spare < -16 * jnp.finfo(slack.dtype).eps * lists.near.skin
        meets = go & (step < steps) & ~(expired & (jump > 0))  # a new list comes first
        observe_now = observer_at(lists, velocities)
        velocities, pairs, sums, shift = collide(
            flow, lists.near, grains, velocities, pairs, sums, meets, options, observe_now
        )
        if shift is not None:
            frame, velocities, pairs = shifted(shift, shear_rate, lists, velocities, pairs)
            lists = replace(lists, frame=frame)
        status = jnp.where(lists.near.overflow | (expired & meets), Status.capacity, Status.ok)
        status = jnp.where(jnp.isfinite(loss), status, Status.nonfinite).astype(jnp.int32)
        sums = sums._replace(status=jnp.maximum(sums.status, status))
        loss = closing_speed(flow, grains, velocities, lists.near.skin)
        sums, counted = with_readings(sums, now.counted, lists, velocities)
        return where_active(go, Carry(lists, pairs, slack, loss, velocities, step, meets, sums, counted), now)

    def with_readings(sums: RunningSums, counted: Array, lists: PairLists, velocities: Array) -> tuple:
        """The sums with readings of the state, and the collisions until then, where it is time for some."""
        due = sums.collisions - counted >= READ_AFTER * grains.radii.size / 2

        def read() -> tuple:
            positions, tilt = present(lists, side)
            now = State(grains, positions, velocities, side, tilt)
            return where_active(due, (sums.with_reading(readings(now)), sums.collisions), (sums, counted))

        # The loop of a fixed length, for reverse mode, is too short for a second reading.
        return lax.cond(any_replica(due), read, lambda: (sums, counted)) if options.buffers else (sums, counted)

    def stale(now: Carry) -> Array:
        return unfinished(now) & is_stale(now, flow)

    def listed(now: Carry) -> Carry:
        return with_new_lists(now, flow, grains, side, stale(now))

    lists = no_lists(state.positions, state.tilt)
    pairs = PairMotion(*4 * [jnp.zeros_like(lists.near.reach)])
    sums = empty_sums(state.positions.dtype)
    sums = sums._replace(status=status_if_finite(state.positions, state.velocities))
    observe_now = observer_at(lists, state.velocities)
    if observe_now is not None:
        sums = sums._replace(user_sums=nothing_observed(observe_now, lists.near.reach.size, state.positions.dtype))
    loss = jnp.full_like(side, jnp.inf)  # there is no list yet
    start = Carry(
        lists,
        pairs,
        lists.near.skin,
        loss,
        state.velocities,
        jnp.int32(0),
        jnp.bool_(False),
        sums,
        jnp.zeros_like(side),
    )
    return EventLoop(start, event, listed, unfinished, stale)


def _observed_at(
    observe: Callable[[State, Contacts, Array], Any],
    lists: PairLists,
    grains: Grains,
    velocities: Array,
    side: Array,
    contacts: Contacts,
    p: Array,
) -> Any:
    """What is observed of one time step with the given contacts and impulses p."""
    positions, tilt = present(lists, side)
    return observe(State(grains, positions, velocities, side, tilt), contacts, p)
