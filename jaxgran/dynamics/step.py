"""One event of the engine ``Jax``: a free flight over whole steps, and the next contacts.

Its functions take what does not change (``Constants``) and what does (``Carry``), and return a new
``Carry``:

- ``refresh_lists``: new lists of near pairs.
- ``event``: a flight up to the step in which some pair next becomes an approaching contact, and
  the contacts of that step.
- ``fly``: free flight over a number of steps.
- ``collide`` of ``collisions``: the contacts of one step change the velocities.

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

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxgran.contact.law import first_step, flight_of, kinetic_means
from jaxgran.contact.near_pairs import Frame, refresh, separations_now
from jaxgran.contact.network import first_contact_time, pair_motion
from jaxgran.dynamics.carry import Carry, Constants, observer_of, state_of
from jaxgran.dynamics.collisions import collide
from jaxgran.dynamics.observer import middle_of_flight, with_flight
from jaxgran.dynamics.tally import RunningSums
from jaxgran.dynamics.velocity_scales import READ_AFTER, readings
from jaxgran.model.control_flow import any_replica, where_active
from jaxgran.model.flow import ShearFlow
from jaxgran.model.grains import Grains
from jaxgran.model.reductions import largest, smallest
from jaxgran.model.status import Status

LONGEST_FLIGHT = 0.05  # strain; a bound on the change of the peculiar velocities within one flight


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

    needed = now.closing_speed * flow.activation * flow.timestep
    rounding = 16 * jnp.finfo(near.skin.dtype).eps * near.skin  # of the slack, summed over flights
    expired = after_flight.slack - needed < -rounding
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


def _with_readings(constants: Constants, now: Carry) -> Carry:
    """With readings of the velocity scales where it is time for some."""
    if not constants.buffers:  # loops for derivatives are too short for a second reading
        return now
    sums, interval, count = now.sums, now.reading_interval, constants.grains.radii.size
    duration = sums.value("duration")
    is_known = sums.value("collisions") >= READ_AFTER * count / 4
    first = jnp.where(is_known, 2 * duration, 0)
    due = (interval > 0) & (duration - sums.value("read_until") >= interval)

    def read() -> RunningSums:
        return where_active(due, sums.with_reading(readings(state_of(constants, now))), sums)

    sums_after = lax.cond(any_replica(due), read, lambda: sums)
    return now._replace(sums=sums_after, reading_interval=jnp.where(interval > 0, interval, first))
