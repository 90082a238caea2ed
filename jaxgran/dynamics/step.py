"""One event of the engine ``Jax``: a free flight over whole steps, and the next contacts.

Its functions take what does not change (``Constants``) and what does (``Carry``), and return a new
``Carry``:

- ``refresh_lists``: new lists of near pairs.
- ``event``: a flight up to the step in which some pair next becomes an approaching contact, and
  the contacts of that step.
- ``fly``: free flight over a number of steps.
- ``collide``: the contacts of one step change the velocities: the near list becomes a buffer of
  ``ContactPairs``, these a network of ``Contacts``, and their solution a ``Collision``.

How long a near list is valid. It holds every pair whose gap was at most its skin s when it was
built. With V a bound on how fast a gap closes (``closing_speed_bound``), which changes with every
collision, any other pair still has a gap of more than

    slack = s − Σ V t,    over the flights of duration t since the list was built.

A step looks θ·dt ahead, so the list holds all of its contacts while slack ≥ V θ dt; below that it
has expired. So a flight has at most slack/(V dt) − θ steps, and a list that does not allow for one
step, slack < V (1 + θ) dt, is renewed before the event.

In a batch, a replica that is finished or has no step to solve keeps what it has, see
``model.control_flow``.
"""

from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxgran.contact.compaction import count_bits, pack_bits
from jaxgran.contact.delassus import NetworkOperator
from jaxgran.contact.law import contact_terms, first_step, flight_of, kinetic_means
from jaxgran.contact.near_pairs import (
    Frame,
    PairLists,
    no_lists,
    present,
    refresh,
    separations_now,
)
from jaxgran.contact.network import (
    ContactPairs,
    PairMotion,
    first_contact_time,
    is_contact,
    pair_motion,
)
from jaxgran.contact.projected_methods import ProjectedMethod
from jaxgran.contact.solver import single_contact, solve
from jaxgran.dynamics.contact_sums import solved_contacts
from jaxgran.dynamics.moving_contacts import contact_delays, delayed_shift, displaced, is_binary
from jaxgran.dynamics.observer import (
    Observe,
    ObserveNow,
    middle_of_flight,
    nothing_observed,
    observe_at,
    with_contacts,
    with_flight,
)
from jaxgran.dynamics.tally import CONTACT, RunningSums, empty_sums
from jaxgran.dynamics.velocity_scales import READ_AFTER, readings
from jaxgran.model.control_flow import any_replica, switch_replica, where_active
from jaxgran.model.flow import ShearFlow
from jaxgran.model.grains import Grains
from jaxgran.model.indexing import taken
from jaxgran.model.reductions import largest, smallest, sums_of
from jaxgran.model.state import State, status_at_start
from jaxgran.model.status import Status

LONGEST_FLIGHT = 0.05  # strain; a bound on the change of the peculiar velocities within one flight
_SINGLE_SLOTS = 4  # for one contact: in one slot XLA would compute the terms once for each sum


class Constants(NamedTuple):
    """What does not change in an advance; the last four are static."""

    flow: ShearFlow
    grains: Grains
    side: Float[Array, ""]
    steps: Int[Array, ""]  # to fly in all
    solver: ProjectedMethod
    free_flight: bool = True  # whether steps without an approaching contact are jumped over
    # Numbers of contacts for which a solve is compiled, smallest first, beside that of all pairs;
    # none in loops for derivatives
    buffers: tuple[int, ...] = ()
    moving_contacts: bool = False  # whether derivatives include that a contact moves in time
    observe: Observe | None = None


class Carry(NamedTuple):
    """What an event changes."""

    lists: PairLists
    pairs: PairMotion  # of the near list
    slack: Float[Array, ""]  # of the near list, see the module
    closing_speed: Float[Array, ""]  # bound on how fast any gap closes
    velocities: Float[Array, "grains 2"]
    step: Int[Array, ""]  # steps flown
    solved: Bool[Array, ""]  # whether the contacts of the present step have been dealt with
    sums: RunningSums
    collisions_read: Float[Array, ""]  # collisions until the last reading of the velocity scales


def start(constants: Constants, state: State) -> Carry:
    """The carry before the first step, without lists."""
    lists, dtype = no_lists(state.positions, state.tilt), state.positions.dtype
    sums = empty_sums(dtype)._replace(status=status_at_start(constants.flow, state))
    now = Carry(
        lists=lists,
        pairs=PairMotion(*4 * [jnp.zeros_like(lists.near.reach)]),
        slack=lists.near.skin,
        closing_speed=jnp.full_like(constants.side, jnp.inf),  # so that the lists are stale
        velocities=state.velocities,
        step=jnp.int32(0),
        solved=jnp.bool_(False),
        sums=sums,
        collisions_read=jnp.zeros_like(constants.side),
    )
    observe_now = observer_of(constants, now)
    if observe_now is None:
        return now
    nothing = nothing_observed(observe_now, lists.near.reach.size, dtype)
    return now._replace(sums=sums._replace(user_sums=nothing))


def unfinished(constants: Constants, now: Carry) -> Bool[Array, ""]:
    """Whether there is a step to fly, and all numbers are finite."""
    return (now.step < constants.steps) & (now.sums.status < Status.nonfinite)


def needs_lists(constants: Constants, now: Carry) -> Bool[Array, ""]:
    """Whether the near list may miss a contact of the next step."""
    flow = constants.flow
    suffices = now.slack >= now.closing_speed * (1 + flow.activation) * flow.timestep
    return unfinished(constants, now) & ~suffices


def refresh_lists(constants: Constants, now: Carry) -> Carry:
    """A new near list where it is needed, and a new outer one where that is used up."""
    stale = needs_lists(constants, now)
    lists = refresh(now.lists, constants.grains, constants.side, stale)
    skin = lax.stop_gradient(lists.near.skin)
    separations = separations_now(lists.near, lists.frame)
    new = now._replace(
        lists=lists,
        pairs=pair_motion(
            lists.near.i, lists.near.j, separations, now.velocities, constants.flow.shear_rate
        ),
        slack=skin,
        closing_speed=closing_speed_bound(constants.flow, constants.grains, now.velocities, skin),
    )
    return where_active(stale, new, now)


def closing_speed_bound(
    flow: ShearFlow, grains: Grains, velocities: Array, skin: Array
) -> Float[Array, ""]:
    """Bound on how fast the gap of a pair outside of the near list closes, in σγ̇.

    A gap closes no faster than 2 max|c| from the peculiar velocities and γ̇ Δx Δy / r ≤ γ̇ r / 2
    from the shear. A pair outside of the list has to close the last part of its way, from r = d +
    skin to r = d. Within a flight and the look-ahead of its last step, |c| grows by a factor
    1 + γ̇ t at most.
    """
    cx, cy = lax.stop_gradient(velocities).T  # the choice of pairs has no derivative
    step = flow.shear_rate * flow.timestep
    longest = jnp.maximum(LONGEST_FLIGHT, step) + flow.activation * step
    speed = jnp.sqrt(largest(cx * cx + cy * cy)) * (1 + longest)
    return 2 * speed + flow.shear_rate * (2 * jnp.max(lax.stop_gradient(grains.radii)) + skin) / 2


def event(constants: Constants, now: Carry) -> Carry:
    """A flight to the next step with an approaching contact, and the contacts of that step.

    A flight ends earlier where the near list does; a new list then comes before the contacts.
    """
    flow, near = constants.flow, now.lists.near
    active = unfinished(constants, now)
    jump = _steps_to_fly(constants, now)
    after_flight = fly(constants, now, jump)

    slack = after_flight.slack - now.closing_speed * flow.activation * flow.timestep
    rounding = 16 * jnp.finfo(slack.dtype).eps * near.skin  # summed over flights
    expired = slack < -rounding
    needs_solve = active & (after_flight.step < constants.steps) & ~(expired & (jump > 0))
    collided = collide(constants, after_flight, needs_solve)

    missing = near.overflow | (expired & needs_solve)  # contacts, perhaps
    status = jnp.where(missing, Status.capacity, Status.ok)
    status = jnp.where(jnp.isfinite(now.closing_speed), status, Status.nonfinite).astype(jnp.int32)
    sums = collided.sums._replace(status=jnp.maximum(collided.sums.status, status))
    speed = closing_speed_bound(flow, constants.grains, collided.velocities, near.skin)
    after = collided._replace(closing_speed=speed, solved=needs_solve, sums=sums)
    return where_active(active, _with_readings(constants, after), now)


def _steps_to_fly(constants: Constants, now: Carry) -> Int[Array, ""]:
    """Steps to the next contact that the near list holds; at least one if the present one is
    solved.
    """
    flow, least = constants.flow, now.solved.astype(jnp.int32)
    time, closest = first_contact_time(now.pairs, now.lists.near.reach)
    steps = jnp.maximum(first_step(time, flow.timestep, flow.activation), least.astype(time.dtype))
    steps_to_contact = smallest(jnp.where(steps * flow.timestep < closest, steps, jnp.inf))
    longest = jnp.divide(LONGEST_FLIGHT, flow.shear_rate) / flow.timestep
    steps_of_list = now.slack / now.closing_speed / flow.timestep - flow.activation
    allowed = jnp.floor(jnp.minimum(steps_of_list, longest))
    jump = jnp.where(constants.free_flight, jnp.minimum(steps_to_contact, allowed), 0)
    remaining = constants.steps - now.step
    return jnp.clip(
        jnp.minimum(jump, remaining.astype(jump.dtype)).astype(jnp.int32), least, remaining
    )


def fly(constants: Constants, now: Carry, steps: Int[Array, ""]) -> Carry:
    """Exact free flight (SLLOD) over a number of steps: the laboratory velocities stay as they
    are.
    """
    shear_rate = constants.flow.shear_rate
    time = steps.astype(now.slack.dtype) * constants.flow.timestep
    sums = _with_flight(now.sums, now.velocities, constants.grains, steps, time, shear_rate)
    if constants.observe is not None:
        middle = middle_of_flight(sums.user_sums, steps) * constants.flow.timestep
        observe_now = observer_of(constants, _moved(now, middle, shear_rate))
        assert observe_now is not None
        sums = sums._replace(user_sums=with_flight(sums.user_sums, observe_now, steps))
    return _moved(now, time, shear_rate)._replace(
        pairs=now.pairs.moved(time),
        slack=now.slack - now.closing_speed * time,
        step=now.step + steps,
        sums=sums,
    )


def _moved(now: Carry, time: Array, shear_rate: float | Array) -> Carry:
    """The grains and the cell after free flight."""
    frame, cy = now.lists.frame, now.velocities[:, 1]
    dx, dy, cx = flight_of(now.velocities[:, 0], cy, frame.strain, time, shear_rate)
    displacements = frame.displacements + jnp.stack([dx, dy], axis=-1)
    return now._replace(
        lists=replace(now.lists, frame=Frame(displacements, frame.strain + shear_rate * time)),
        velocities=jnp.stack([cx, cy], axis=-1),
    )


def _with_flight(
    sums: RunningSums,
    velocities: Array,
    grains: Grains,
    steps: Array,
    time: Array,
    shear_rate: float | Array,
) -> RunningSums:
    """The sums with the time of a flight and ∫ Σ m c ⊗ c dt along it, where c_x falls by γ̇ c_y
    t.
    """
    cx, cy = velocities[:, 0], velocities[:, 1]
    px, py = grains.masses * cx, grains.masses * cy
    products = ((px, cx), (px, cy), (py, cy))
    xx, xy, yy = (jnp.dot(p, c, precision=lax.Precision.HIGHEST) for p, c in products)
    means = kinetic_means(xx, xy, yy, shear_rate * time)
    return sums.added(duration=time, steps=steps, kinetic_moment=[time * mean for mean in means])


class Collision(NamedTuple):
    """What the contacts of one step do to the grains, and what they add to the sums."""

    momenta: Float[Array, "grains 2"]
    contact_sums: Float[Array, " contact"]
    largest_overlap: Float[Array, ""]
    iterations: Int[Array, ""]
    residual: Float[Array, ""]
    status: Int[Array, ""]
    user_sums: Any
    shift: Float[Array, "grains 2"] | None  # of ``moving_contacts``


def collide(constants: Constants, now: Carry, needs_solve: Bool[Array, ""]) -> Carry:
    """The contacts of one step change the velocities; not where none approaches or no step needs
    it.

    The contacts are compacted from the near list into the smallest buffer that holds them, and
    solved and summed there; more than the largest buffer holds are solved and summed on the list.
    """
    near, grains, flow = now.lists.near, constants.grains, constants.flow
    look_ahead = flow.activation * flow.timestep
    all_contacts, approaching = is_contact(now.pairs, near.reach, look_ahead)
    acts = needs_solve & jnp.any(pack_bits(approaching) > 0)
    contact, motion, delays = all_contacts & acts, now.pairs, None
    if constants.moving_contacts:
        delays = contact_delays(now.pairs, near.reach, approaching, flow.timestep)
        motion = now.pairs.moved(jnp.where(is_binary(near, contact, grains), delays, 0))
    pairs, words = ContactPairs(near.i, near.j, near.reach, motion, contact), pack_bits(contact)

    sizes = (1, *constants.buffers) if constants.buffers else ()
    in_buffer = partial(_collision_in_buffer, constants, now, pairs, words)
    on_list = partial(_collision, constants, now, pairs, delays)
    programs = [*(partial(in_buffer, size) for size in sizes), on_list]
    branch = jnp.sum(count_bits(words) > jnp.asarray([0, *sizes], jnp.int32), dtype=jnp.int32)
    collision = switch_replica(branch, _no_collision(now, delays), programs)

    kicks = collision.momenta / grains.masses[:, None]
    x, y = kicks.T
    ux, uy = (taken(a, near.i) - taken(a, near.j) for a in (x, y))
    kicked = now._replace(
        pairs=now.pairs._replace(ux=now.pairs.ux + ux, uy=now.pairs.uy + uy),
        velocities=now.velocities + kicks,
        sums=_with_collision(now.sums, collision, acts),
    )
    if collision.shift is None:
        return kicked
    frame, velocities, motion = displaced(
        collision.shift, flow.shear_rate, now.lists, kicked.velocities, kicked.pairs
    )
    return kicked._replace(
        lists=replace(now.lists, frame=frame), velocities=velocities, pairs=motion
    )


def _no_collision(now: Carry, delays: Array | None) -> Collision:
    """No contact approaches."""
    still, zero = jnp.zeros_like(now.velocities), jnp.zeros_like(now.slack)
    no_sums, shift = jnp.zeros_like(now.sums.of(CONTACT)), None if delays is None else still
    return Collision(
        still, no_sums, zero, jnp.int32(0), zero, jnp.int32(0), now.sums.user_sums, shift
    )


def _collision_in_buffer(
    constants: Constants, now: Carry, pairs: ContactPairs, words: Array, size: int, active: Array
) -> Collision:
    """What no more than ``size`` contacts do; a single one is solved in closed form."""
    single = size == 1
    contacts = pairs.compacted(_SINGLE_SLOTS if single else size, words)
    return _collision(constants, now, contacts, None, active, single)


def _collision(
    constants: Constants,
    now: Carry,
    pairs: ContactPairs,
    delays: Array | None,
    active: Array,
    single: bool = False,
) -> Collision:
    """What contacts do, from their network and its solution."""
    flow, grains = constants.flow, constants.grains
    network = pairs.network(grains)
    operator = NetworkOperator(network, grains.radii.size)
    if single:
        solution = single_contact(operator)
    else:
        solution = solve(operator, flow.shear_rate, constants.solver, active)
    contacts, momenta = solved_contacts(flow, pairs.reach, network, grains, solution)
    user_sums, observe_now = now.sums.user_sums, observer_of(constants, now)
    if observe_now is not None:
        user_sums = with_contacts(user_sums, observe_now, network, contacts.impulse)
    return Collision(
        momenta=momenta,
        contact_sums=jnp.stack(sums_of(contact_terms(contacts))),
        largest_overlap=jnp.max(contacts.overlap),
        iterations=solution.iterations,
        residual=solution.residual,
        status=solution.status,
        user_sums=user_sums,
        shift=None if delays is None else delayed_shift(delays, network, grains, contacts),
    )


def _with_collision(sums: RunningSums, collision: Collision, acts: Array) -> RunningSums:
    """The sums with what the contacts of one step add."""
    added = sums.added(
        collision.contact_sums,
        solves=acts,
        iterations=collision.iterations,
        unconverged=collision.status != Status.ok,
        largest_overlap=collision.largest_overlap,
        worst_residual=collision.residual,
    )
    status = jnp.maximum(sums.status, collision.status)
    return added._replace(status=status, user_sums=collision.user_sums)


def observer_of(constants: Constants, now: Carry) -> ObserveNow | None:
    """What the user observes now, given contacts and impulses; None where nothing is observed."""
    if constants.observe is None:
        return None
    return observe_at(constants.observe, constants.flow, _state_of(constants, now))


def _state_of(constants: Constants, now: Carry) -> State:
    positions, tilt = present(now.lists, constants.side)
    return State(constants.grains, positions, now.velocities, constants.side, tilt)


def _with_readings(constants: Constants, now: Carry) -> Carry:
    """With readings of the velocity scales where it is time for some."""
    if not constants.buffers:  # loops for derivatives are too short for a second reading
        return now
    sums, collisions_read = now.sums, now.collisions_read
    due = sums.value("collisions") - collisions_read >= READ_AFTER * constants.grains.radii.size / 2

    def read() -> tuple[RunningSums, Array]:
        state = _state_of(constants, now)
        read_now = sums.with_reading(readings(state)), sums.value("collisions")
        return where_active(due, read_now, (sums, collisions_read))

    sums_after, read_after = lax.cond(any_replica(due), read, lambda: (sums, collisions_read))
    return now._replace(sums=sums_after, collisions_read=read_after)
