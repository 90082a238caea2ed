"""State of a flow, exact free flight, one contact-dynamics step, and the advance over many steps.

A time step finds the contacts at its beginning, changes the velocities by the impulses of the contact network, and
flies freely for dt. Between contacts the velocity in the laboratory frame is constant, so separations are linear
in time and the step at which some pair next becomes an approaching contact is known in advance: ``advance`` jumps
there in one evaluation. The trajectory is the one of the fixed time step; the cost follows the contacts.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from jaxgran.cell import relative_velocity
from jaxgran.contacts import Contacts, contact_network, first_contact_time, is_contact
from jaxgran.flow import ShearFlow
from jaxgran.grains import Grains
from jaxgran.pairs import Frame, Neighbourhood, PairList, first_true, neighbourhood, present, refresh, separations_now
from jaxgran.replica import any_replica, largest_replica, where_active
from jaxgran.solver import grain_impulses, solve
from jaxgran.status import Status
from jaxgran.tally import Tally, empty_tally

DEEP_OVERLAP = 1e-2
_LONGEST_FLIGHT = 0.05  # strain; a bound on the change of the peculiar velocities within one flight


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class State:
    """A sheared packing at one instant.

    ==========  ===========  ====  =====================================================
    field       shape        unit  meaning
    ==========  ===========  ====  =====================================================
    grains      Grains       –     radii and masses
    positions   (grains, 2)  σ     centres, wrapped into the cell
    velocities  (grains, 2)  σγ̇    peculiar velocities c; the laboratory's are c + γ̇ y x̂
    side        ()           σ     side L of the cell
    tilt        ()           –     offset of the image row above, in L, in [−½, ½)
    ==========  ===========  ====  =====================================================
    """

    grains: Grains
    positions: Float[Array, "grains 2"]
    velocities: Float[Array, "grains 2"]
    side: Float[Array, ""]
    tilt: Float[Array, ""]


class _Carry(NamedTuple):
    hood: Neighbourhood
    velocities: Array
    step: Array  # steps flown
    solved: Array  # whether the contacts of the present step have been dealt with
    tally: Tally


def contact_capacities(grains: int) -> tuple[int, ...]:
    """Sizes of the contact buffers, smallest first. Contacts of discs form a planar graph: at most 3 N of them."""
    top = 3 * grains
    return tuple(sorted({max(8, top // 4**k) for k in range(5)}))


def advance(flow: ShearFlow, state: State, steps: Int[Array, ""], free_flight: bool = True) -> tuple[State, Tally]:
    """Advance one replica by a number of time steps.

    Args:
      flow: parameters; all numbers of one replica.
      state: the flow at the beginning.
      steps: number of time steps, traced.
      free_flight: whether steps without an approaching contact are jumped over. ``False`` visits every step;
        the trajectory is the same.

    Returns:
      The state after the last step, and the tally of the steps. A replica that is no longer finite stops with
      the status ``nonfinite``.
    """
    dt, shear_rate, grains, side = flow.timestep, flow.shear_rate, state.grains, state.side

    def unfinished(now: _Carry):
        return (now.step < steps) & (now.tally.status < Status.nonfinite)

    def body(now: _Carry) -> _Carry:
        go = unfinished(now)
        hood, room = _fresh_lists(now, flow, grains, side, go)
        pairs = hood.near
        separations = separations_now(pairs, hood.frame)
        u = relative_velocity(now.velocities, pairs.i, pairs.j, separations, shear_rate)

        least = now.solved.astype(jnp.int32)
        jump = jnp.minimum(_steps_to_contact(separations, u, pairs.reach, flow, least), jnp.floor(room / dt))
        jump = jump if free_flight else jnp.zeros_like(jump)
        remaining = steps - now.step
        jump = jnp.clip(jnp.minimum(jump, remaining).astype(jnp.int32), least, remaining)
        flight = jump * dt

        tally = _tally_flight(now.tally, now.velocities, grains, jump, flight, shear_rate)
        frame, velocities = _fly(hood.frame, now.velocities, flight, shear_rate)
        hood = replace(hood, frame=frame)
        step = now.step + jump
        meets = go & (step < steps)
        velocities, tally = _collide(flow, pairs, separations + flight * u, u, grains, velocities, tally, meets)
        overrun = pairs.overflow | (room < flight)
        status = jnp.where(jnp.all(jnp.isfinite(velocities)), jnp.where(overrun, Status.capacity, Status.ok), Status.nonfinite)
        tally = replace(tally, status=jnp.maximum(tally.status, status.astype(jnp.int32)))
        return where_active(go, _Carry(hood, velocities, step, meets, tally), now)

    finite = jnp.all(jnp.isfinite(state.positions)) & jnp.all(jnp.isfinite(state.velocities))
    tally = empty_tally(state.positions.dtype)
    tally = replace(tally, status=jnp.where(finite, tally.status, Status.nonfinite).astype(jnp.int32))
    hood = neighbourhood(state.positions, grains, side, state.tilt)
    start = _Carry(hood, state.velocities, jnp.int32(0), jnp.bool_(False), tally)
    end = lax.while_loop(lambda now: any_replica(unfinished(now)), body, start)
    positions, tilt = present(end.hood, side)
    return State(grains, positions, end.velocities, side, tilt), end.tally


def _flight_room(hood: Neighbourhood, velocities: Array, grains: Grains, shear_rate: Array) -> Float[Array, ""]:
    """Time for which free flight surely keeps the near list valid."""
    tilted = 1 + jnp.abs(hood.near_frame.strain)
    largest = jnp.max(grains.radii) / tilted
    slope = hood.frame.strain
    vx, vy = velocities[:, 0] - slope * velocities[:, 1], velocities[:, 1]
    speed = jnp.sqrt(vx**2 + vy**2) + 2 * _LONGEST_FLIGHT * jnp.abs(vy)
    moved = jnp.sqrt(jnp.sum((hood.frame.displacements - hood.near_frame.displacements) ** 2, axis=-1))
    left = hood.near.skin / (2 * tilted) - largest * jnp.abs(hood.frame.strain - hood.near_frame.strain) - moved
    return jnp.minimum(jnp.min(left / (speed + largest * shear_rate)), _LONGEST_FLIGHT / shear_rate)


def _fresh_lists(now: _Carry, flow: ShearFlow, grains: Grains, side: Array, go: Array) -> tuple[Neighbourhood, Array]:
    """Lists that stay valid for at least one more step, and the time for which they do."""
    room = _flight_room(now.hood, now.velocities, grains, flow.shear_rate)
    stale = go & ~(room >= flow.timestep)

    def fresh(_):
        hood = refresh(now.hood, grains, side, stale)
        return hood, _flight_room(hood, now.velocities, grains, flow.shear_rate)

    return lax.cond(any_replica(stale), fresh, lambda _: (now.hood, room), None)


def _steps_to_contact(separations: Array, u: Array, reach: Array, flow: ShearFlow, least: Array) -> Float[Array, ""]:
    """Number of steps, at least ``least``, after which some pair first is an approaching contact; may be infinite."""
    time, closest = first_contact_time(separations, u, reach)
    steps = jnp.maximum(jnp.ceil(time / flow.timestep - flow.activation_fraction), least)
    return jnp.min(jnp.where(steps * flow.timestep < closest, steps, jnp.inf))


def _fly(frame: Frame, velocities: Array, flight: Array, shear_rate: Array) -> tuple[Frame, Array]:
    """Exact free flight (SLLOD) for a time: the laboratory velocities stay as they are."""
    cx, cy = velocities[:, 0], velocities[:, 1]
    dx = (cx - frame.strain * cy) * flight - shear_rate * cy * flight**2
    moved = frame.displacements + jnp.stack([dx, cy * flight], axis=-1)
    return Frame(moved, frame.strain + shear_rate * flight), jnp.stack([cx - shear_rate * flight * cy, cy], axis=-1)


def _tally_flight(tally: Tally, velocities: Array, grains: Grains, jump: Array, flight: Array, shear_rate: Array) -> Tally:
    """The tally with the time of a flight and ∫ Σ m c ⊗ c dt along it, where c_x falls by γ̇ c_y t."""
    xx, xy, yy = (jnp.sum(grains.masses * velocities[:, a] * velocities[:, b]) for a, b in ((0, 0), (0, 1), (1, 1)))
    turned = shear_rate * flight
    xx, xy = xx - turned * xy + turned**2 / 3 * yy, xy - turned / 2 * yy
    moment = flight * jnp.stack([xx, xy, xy, yy]).reshape(2, 2)
    return replace(
        tally,
        duration=tally.duration + flight,
        steps=tally.steps + jump,
        kinetic_moment=tally.kinetic_moment + moment,
    )


def _collide(
    flow: ShearFlow, pairs: PairList, separations: Array, u: Array, grains: Grains, velocities: Array, tally: Tally, meets: Array
) -> tuple[Array, Tally]:
    """Velocities and tally after the contacts of one step; unchanged where no contact approaches."""
    contact, approaching = is_contact(separations, u, pairs.reach, flow.activation_fraction * flow.timestep)
    count = jnp.sum(contact, dtype=jnp.int32)
    meets = meets & jnp.any(approaching)
    capacities = contact_capacities(grains.radii.size)
    rung = jnp.sum(count > jnp.asarray(capacities[:-1], jnp.int32), dtype=jnp.int32) + 1
    rung = largest_replica(jnp.where(meets, rung, 0))

    def with_capacity(capacity: int):
        def collided(_):
            network = contact_network(first_true(contact, capacity), pairs, separations, u, grains)
            new = _apply_impulses(flow, network, count > capacity, velocities, tally, grains, meets)
            return where_active(meets, new, (velocities, tally))

        return collided

    return lax.switch(rung, [lambda _: (velocities, tally), *map(with_capacity, capacities)], None)


def _apply_impulses(
    flow: ShearFlow, network: Contacts, overflow: Array, velocities: Array, tally: Tally, grains: Grains, meets: Array
) -> tuple[Array, Tally]:
    count = grains.radii.size
    solution = solve(network, count, flow.shear_rate, flow.tolerance, flow.max_iterations, flow.solver, meets)
    bounce = 1 + flow.restitution
    impulses = bounce * solution.impulses
    approach = network.approach
    reduced_mass = 1 / jnp.where(network.used, network.inverse_mass_i + network.inverse_mass_j, jnp.inf)
    binary = bounce * reduced_mass * jnp.maximum(0, -approach)
    directions = network.normals[:, :, None] * network.normals[:, None, :] * network.distances[:, None, None]
    overlaps = jnp.where(network.used, grains.radii[network.i] + grains.radii[network.j] - network.distances, 0)
    deepest = jnp.max(overlaps)
    status = jnp.where(deepest > DEEP_OVERLAP, Status.deep_overlap, Status.ok)
    status = jnp.maximum(jnp.where(overflow, Status.capacity, status), solution.status)
    change = grain_impulses(network, impulses, count) / grains.masses[:, None]
    return velocities + change, replace(
        tally,
        impulse=tally.impulse + jnp.sum(impulses),
        binary_impulse=tally.binary_impulse + jnp.sum(binary),
        contact_moment=tally.contact_moment + jnp.sum(directions * impulses[:, None, None], axis=0),
        binary_moment=tally.binary_moment + jnp.sum(directions * binary[:, None, None], axis=0),
        dissipation=tally.dissipation - jnp.sum(impulses * (approach + bounce / 2 * solution.response)),
        contacts=tally.contacts + jnp.sum(network.used),
        loaded_contacts=tally.loaded_contacts + jnp.sum(impulses > 0),
        collisions=tally.collisions + jnp.sum(network.used & (approach < 0)),
        solves=tally.solves + 1,
        iterations=tally.iterations + solution.iterations,
        unconverged=tally.unconverged + (solution.status != Status.ok),
        residual=tally.residual + solution.residual,
        largest_overlap=jnp.maximum(tally.largest_overlap, deepest),
        status=jnp.maximum(tally.status, status.astype(jnp.int32)),
    )
