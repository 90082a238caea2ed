"""State of a flow, exact free flight, one contact-dynamics step, and the advance over many steps.

A time step finds the contacts at its beginning, changes the velocities by the impulses of the contact network, and
flies freely for dt. Between contacts the velocity in the laboratory frame is constant, so separations are linear
in time and the step at which some pair next becomes an approaching contact is known in advance: ``advance`` jumps
there in one evaluation. The trajectory is the one of the fixed time step; the cost follows the contacts.

Derivatives of a trajectory hold the time steps of its contacts: the numbers of steps flown are whole and do not change.
That is the derivative of what is computed. It is not that of the flow in the limit dt → 0, in which a contact comes
earlier or later where the grains before it are moved: with ``moving_contacts`` every contact that begins in a step adds
what a shift of its time by dτ does, to first order, with the values as they are. Exact for collisions of two grains;
where a grain strikes a cluster, only the impulse that its own approach accounts for moves in time.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from jaxgran.contact.delassus import grain_impulses, in_clusters
from jaxgran.contact.near_pairs import (
    Frame,
    Neighbourhood,
    PairList,
    bit_words,
    neighbourhood,
    present,
    refresh,
    separations_now,
    set_bits,
)
from jaxgran.contact.network import Contacts, contact_network, first_contact_time, is_contact
from jaxgran.contact.solver import solve
from jaxgran.dynamics.observer import Look, nothing_observed, with_contacts, with_flight
from jaxgran.dynamics.tally import RESIDUAL_EDGES, Sums, Tally, empty_sums
from jaxgran.model.cell import relative_velocity
from jaxgran.model.control_flow import any_replica, in_batch, largest_replica, where_active
from jaxgran.model.display import Row, arrays, methods, rounded
from jaxgran.model.flow import MAX_STEPS, InputError, ShearFlow, require_flow, require_number, require_whole
from jaxgran.model.grains import Grains
from jaxgran.model.status import Status

DEEP_OVERLAP = 1e-2
_FEW_RUNGS = 3  # of the contact buffers, where derivatives are compiled along
_LONGEST_FLIGHT = 0.05  # strain; a bound on the change of the peculiar velocities within one flight


def _rows(state: "State") -> list[Row]:
    known = arrays(state.grains.radii, state.grains.masses, state.velocities)
    if not known or known[-1].ndim < 2:
        return [Row("positions", state.positions), Row("side", state.side, "σ"), Row("tilt", state.tilt)]
    radii, masses, velocities = known
    *replicas, grains, _ = velocities.shape
    temperature = np.sum(masses[..., None] * velocities**2, axis=(-2, -1)) / (2 * grains)
    return [
        *[Row("replicas", count) for count in replicas],
        Row("grains", grains),
        Row("packing_fraction", rounded(np.sum(np.pi * radii**2, axis=-1) / np.asarray(state.side) ** 2)),
        Row("granular_temperature", rounded(temperature), "mσ²/t²"),
        Row("side", rounded(state.side), "σ"),
        Row("tilt", rounded(state.tilt)),
        Row("precision", str(velocities.dtype)),
    ]


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

    __repr__, _repr_html_ = methods("State", _rows)


def require_state(flow: ShearFlow, state: State) -> None:
    """Raise an InputError unless this is one flow, and one state of its grains."""
    require_flow(flow)
    if not isinstance(state, State) or jnp.shape(state.positions) != (flow.grains, 2):
        raise InputError(
            f"state must be one State of {flow.grains} grains, best from prepare, not "
            f"{f'of positions {jnp.shape(state.positions)}' if isinstance(state, State) else type(state).__name__}."
        )


def require_advance(flow: ShearFlow, state: State, steps: Any) -> None:
    """Raise an InputError unless this is one flow, one state of its grains and a number of time steps."""
    require_state(flow, state)
    words = f"a whole number of 0 to {MAX_STEPS}"
    require_number("steps", steps, lambda x: (x.dtype.kind in "iu") & (x >= 0) & (x <= MAX_STEPS), words)


class _Pairs(NamedTuple):
    """Near pairs in flight: separations and relative laboratory velocities, (pairs,) each, x and y apart for speed."""

    x: Array
    y: Array
    ux: Array
    uy: Array

    def separations(self) -> Float[Array, "pairs 2"]:
        return jnp.stack([self.x, self.y], axis=-1)

    def velocities(self) -> Float[Array, "pairs 2"]:
        return jnp.stack([self.ux, self.uy], axis=-1)


Observe = Callable[[State, Contacts, Array], Any]  # of a time step: the state, its contacts and their impulses


class _Purpose(NamedTuple):
    """What an advance is made for besides its values: fewer contact buffers are compiled sooner."""

    rungs: int | None = None  # contact buffers, the largest; None for all of them
    moving_contacts: bool = False
    observe: Observe | None = None


class _Carry(NamedTuple):
    hood: Neighbourhood
    pairs: _Pairs
    slack: Array  # what is left of the skin of the near list
    velocities: Array
    step: Array  # steps flown
    solved: Array  # whether the contacts of the present step have been dealt with
    sums: Sums


def contact_capacities(grains: int) -> tuple[int, ...]:
    """Sizes of the contact buffers, smallest first. Contacts of discs form a planar graph: at most 3 N of them."""
    top = 3 * grains
    return tuple(sorted({1, *(max(4, top // share) for share in (96, 24, 6, 3, 1))}))


def advance(
    flow: ShearFlow,
    state: State,
    steps: Int[Array, ""],
    free_flight: bool = True,
    events: int | None = None,
    moving_contacts: bool = False,
) -> tuple[State, Tally]:
    """Advance one replica: the plain advance, which is differentiated and serves every backend.

    Arguments, derivatives and results are those of the public ``advance`` of ``native``.
    """
    rungs = None if events is None and not moving_contacts else _FEW_RUNGS
    how = _Purpose(rungs, moving_contacts)
    start, body, unfinished = _event_loop(flow, state, steps, free_flight, how)
    if events is None:
        end = lax.while_loop(lambda now: any_replica(unfinished(now)), body, start)
    else:
        require_whole("events", events, 1, MAX_STEPS, "the most steps of an advance")
        end = _scanned(start, body, unfinished, events)
    return _ended(state, end, unfinished)


def advance_observed(
    flow: ShearFlow, state: State, steps: Int[Array, ""], observe: Observe
) -> tuple[State, Tally, Any]:
    """``advance``, and the sum over all its time steps of what a function finds in them, see ``observer``."""
    start, body, unfinished = _event_loop(flow, state, steps, True, _Purpose(observe=observe))
    end = lax.while_loop(lambda now: any_replica(unfinished(now)), body, start)
    return *_ended(state, end, unfinished), end.sums.own.sums


def _ended(state: State, end: _Carry, unfinished: Callable) -> tuple[State, Tally]:
    """The state and the tally at the end of an advance from a state."""
    short = jnp.where(unfinished(end), Status.capacity, Status.ok).astype(jnp.int32)
    sums = end.sums._replace(status=jnp.maximum(end.sums.status, short))
    return ended(state, *present(end.hood, state.side), end.velocities, sums)


def ended(state: State, positions: Array, tilt: Array, velocities: Array, sums: Sums) -> tuple[State, Tally]:
    """The state and the tally of an advance that led from a state to these positions, tilt and velocities."""
    grains = state.grains
    tally = sums.tally(
        energy_change=_energy(grains, velocities) - _energy(grains, state.velocities),
        momentum_drift=_relative_momentum(grains, velocities),
    )
    status = jnp.maximum(sums.status, _status_if_finite(positions, velocities))
    return State(grains, positions, velocities, state.side, tilt), replace(tally, status=status)


def count_events(flow: ShearFlow, state: State, steps: Int[Array, ""], free_flight: bool = True) -> Int[Array, ""]:
    """Evaluations that an advance takes: the ``events`` that it needs in a loop of fixed length."""
    start, body, unfinished = _event_loop(flow, state, steps, free_flight, _Purpose())
    counted = jnp.int32(0), start
    return lax.while_loop(lambda at: any_replica(unfinished(at[1])), lambda at: (at[0] + 1, body(at[1])), counted)[0]


def _event_loop(flow: ShearFlow, state: State, steps: Array, free_flight: bool, how: _Purpose):
    """Start and body of the loop of an advance, and whether it has to go on."""
    require_advance(flow, state, steps)
    dt, shear_rate, grains, side = flow.timestep, flow.shear_rate, state.grains, state.side

    def look_at(hood: Neighbourhood, velocities: Array) -> Look | None:
        """The user's view of the flow as it is; None where nobody looks."""
        return None if how.observe is None else partial(_seen, how.observe, hood, grains, velocities, side)

    def unfinished(now: _Carry):
        return (now.step < steps) & (now.sums.status < Status.nonfinite)

    def body(now: _Carry) -> _Carry:
        go = unfinished(now)
        hood, pairs, slack, loss = _fresh_lists(now, flow, grains, side, go)

        least = now.solved.astype(jnp.int32)
        jump = _steps_to_contact(pairs, hood.near.reach, flow, least)
        jump = jnp.minimum(jump, jnp.floor(jnp.minimum(slack / loss, jnp.divide(_LONGEST_FLIGHT, shear_rate)) / dt))
        jump = jump if free_flight else jnp.zeros_like(jump)
        remaining = steps - now.step
        jump = jnp.clip(jnp.minimum(jump, remaining.astype(jump.dtype)).astype(jnp.int32), least, remaining)
        flight = jump.astype(slack.dtype) * dt

        sums = _add_flight(now.sums, now.velocities, grains, jump, flight, shear_rate)
        look = look_at(hood, now.velocities)
        sums = sums if look is None else sums._replace(own=with_flight(sums.own, look, jump))
        frame, velocities = _fly(hood.frame, now.velocities, flight, shear_rate)
        hood, slack = replace(hood, frame=frame), slack - loss * flight
        pairs = pairs._replace(x=pairs.x + flight * pairs.ux, y=pairs.y + flight * pairs.uy)
        step = now.step + jump
        meets = go & (step < steps)
        look = look_at(hood, velocities)
        velocities, pairs, sums, shift = _collide(flow, hood.near, grains, velocities, pairs, sums, meets, how, look)
        if shift is not None:
            frame, velocities, pairs = _shifted(shift, shear_rate, hood, velocities, pairs)
            hood = replace(hood, frame=frame)
        status = jnp.where(
            hood.near.overflow | (slack < -16 * jnp.finfo(slack.dtype).eps * hood.near.skin), Status.capacity, Status.ok
        )
        status = jnp.where(jnp.isfinite(loss), status, Status.nonfinite).astype(jnp.int32)
        sums = sums._replace(status=jnp.maximum(sums.status, status))
        return where_active(go, _Carry(hood, pairs, slack, velocities, step, meets, sums), now)

    hood = neighbourhood(state.positions, grains, side, state.tilt)
    pairs = _pairs_now(hood, state.velocities, shear_rate)
    sums = empty_sums(state.positions.dtype)
    sums = sums._replace(status=_status_if_finite(state.positions, state.velocities))
    look = look_at(hood, state.velocities)
    if look is not None:
        sums = sums._replace(own=nothing_observed(look, contact_capacities(flow.grains)[-1], state.positions.dtype))
    start = _Carry(hood, pairs, hood.near.skin, state.velocities, jnp.int32(0), jnp.bool_(False), sums)
    return start, body, unfinished


def _seen(
    observe: Observe, hood: Neighbourhood, grains: Grains, velocities: Array, side: Array, contacts: Contacts, p: Array
) -> Any:
    """What is observed of one time step with the given contacts and impulses p."""
    positions, tilt = present(hood, side)
    return observe(State(grains, positions, velocities, side, tilt), contacts, p)


def _scanned(start: _Carry, body: Callable, unfinished: Callable, events: int) -> _Carry:
    """The end of a loop of fixed length, of which reverse mode keeps what is carried and computes all else again."""

    def one(now: _Carry, _: None) -> tuple[_Carry, None]:
        return lax.cond(any_replica(unfinished(now)), body, lambda now: now, now), None

    return lax.scan(jax.checkpoint(one), start, length=events)[0]


def _energy(grains: Grains, velocities: Array) -> Float[Array, ""]:
    return jnp.sum(grains.masses * jnp.sum(velocities**2, axis=-1)) / 2


def _relative_momentum(grains: Grains, velocities: Array) -> Float[Array, ""]:
    """|Σ m c| over Σ m |c|, zero at rest."""
    momenta = grains.masses[:, None] * velocities
    momenta = lax.stop_gradient(momenta)  # a measure of rounding; at rest a norm has no derivative
    all_of_it = jnp.sum(jnp.linalg.norm(momenta, axis=-1))
    return jnp.linalg.norm(jnp.sum(momenta, axis=0)) / jnp.where(all_of_it > 0, all_of_it, 1)


def contacts_now(flow: ShearFlow, state: State) -> Contacts:
    """The contact network that the next time step of a flow would solve, in a buffer that holds any packing."""
    hood = neighbourhood(state.positions, state.grains, state.side, state.tilt)
    pairs = _pairs_now(hood, state.velocities, flow.shear_rate)
    separations, velocities = pairs.separations(), pairs.velocities()
    contact, _ = is_contact(separations, velocities, hood.near.reach, flow.activation_fraction * flow.timestep)
    index = set_bits(bit_words(contact), contact_capacities(state.grains.radii.size)[-1], contact.size)
    return contact_network(index, hood.near, separations, velocities, state.grains)


def _status_if_finite(*values: Array) -> Int[Array, ""]:
    finite = jnp.all(jnp.stack([jnp.all(jnp.isfinite(value)) for value in values]))
    return jnp.where(finite, Status.ok, Status.nonfinite).astype(jnp.int32)


def _pairs_now(hood: Neighbourhood, velocities: Array, shear_rate: float | Array) -> _Pairs:
    separations = separations_now(hood.near, hood.frame)
    u = relative_velocity(velocities, hood.near.i, hood.near.j, separations, shear_rate)
    return _Pairs(separations[:, 0], separations[:, 1], u[:, 0], u[:, 1])


def _fresh_lists(
    now: _Carry, flow: ShearFlow, grains: Grains, side: Array, go: Array
) -> tuple[Neighbourhood, _Pairs, Array, Array]:
    """Lists that stay valid for at least one more step, their pairs, the slack, and a bound on its loss per time.

    A gap closes no faster than 2 max|c| from the peculiar velocities and γ̇ Δx Δy / r ≤ γ̇ r / 2 from the shear, where
    r ≤ d + skin until a pair from outside the list touches. Within a flight |c| grows by a factor 1 + γ̇ t at most.
    """
    velocities = lax.stop_gradient(now.velocities)  # the lists decide what is looked at, not what it is
    cx, cy = velocities[:, 0], velocities[:, 1]
    longest = jnp.maximum(_LONGEST_FLIGHT, flow.shear_rate * flow.timestep)
    speed = jnp.sqrt(-_smallest(-(cx * cx + cy * cy))) * (1 + longest)
    diameter = 2 * jnp.max(lax.stop_gradient(grains.radii))

    def loss(skin: Array) -> Array:
        return 2 * speed + flow.shear_rate * (diameter + skin) / 2

    stale = go & ~(now.slack >= loss(now.hood.near.skin) * flow.timestep)

    def fresh():
        hood = refresh(now.hood, grains, side, stale)
        new = hood, _pairs_now(hood, now.velocities, flow.shear_rate), lax.stop_gradient(hood.near.skin)
        return where_active(stale, new, (now.hood, now.pairs, now.slack))

    hood, pairs, slack = lax.cond(any_replica(stale), fresh, lambda: (now.hood, now.pairs, now.slack))
    return hood, pairs, slack, loss(hood.near.skin)


def _steps_to_contact(pairs: _Pairs, reach: Array, flow: ShearFlow, least: Array) -> Float[Array, ""]:
    """Number of steps, at least ``least``, after which some pair first is an approaching contact; may be infinite."""
    time, closest = first_contact_time(pairs.separations(), pairs.velocities(), reach)
    steps = jnp.maximum(jnp.ceil(time / flow.timestep - flow.activation_fraction), least.astype(time.dtype))
    return _smallest(jnp.where(steps * flow.timestep < closest, steps, jnp.inf))


def _fly(frame: Frame, velocities: Array, flight: Array, shear_rate: float | Array) -> tuple[Frame, Array]:
    """Exact free flight (SLLOD) for a time: the laboratory velocities stay as they are."""
    cy = velocities[:, 1]
    dx, dy, cx = flight_of(velocities[:, 0], cy, frame.strain, flight, shear_rate)
    moved = frame.displacements + jnp.stack([dx, dy], axis=-1)
    return Frame(moved, frame.strain + shear_rate * flight), jnp.stack([cx, cy], axis=-1)


def flight_of(cx: Array, cy: Array, strain: Array, flight: Array, shear_rate: float | Array) -> tuple[Array, ...]:
    """Displacements of a free flight in the frame that shears with the flow, and the peculiar velocity c_x after it.

    Args:
      cx, cy: peculiar velocities before; c_y stays as it is.
      strain: that of the frame before.
      flight: time.
    """
    dx = (cx - strain * cy) * flight - shear_rate * cy * flight**2
    return dx, cy * flight, cx - shear_rate * flight * cy


def kinetic_means(xx: Array, xy: Array, yy: Array, turned: Array) -> tuple[Array, Array, Array]:
    """Means of c_x c_x, c_x c_y and c_y c_y over a flight of strain ``turned``, in which c_x falls by γ̇ c_y t."""
    return xx - turned * xy + turned**2 / 3 * yy, xy - turned / 2 * yy, yy


def _add_flight(
    sums: Sums, velocities: Array, grains: Grains, jump: Array, flight: Array, shear_rate: float | Array
) -> Sums:
    """The sums with the time of a flight and ∫ Σ m c ⊗ c dt along it, where c_x falls by γ̇ c_y t."""
    cx, cy = velocities[:, 0], velocities[:, 1]
    px, py = grains.masses * cx, grains.masses * cy
    xx, xy, yy = (jnp.dot(p, c, precision=lax.Precision.HIGHEST) for p, c in ((px, cx), (px, cy), (py, cy)))
    xx, xy, yy = kinetic_means(xx, xy, yy, shear_rate * flight)
    flown = jnp.stack([flight, jump.astype(flight.dtype), flight * xx, flight * xy, flight * yy])
    return sums._replace(flights=sums.flights + flown)


def _collide(
    flow: ShearFlow,
    near: PairList,
    grains: Grains,
    velocities: Array,
    pairs: _Pairs,
    sums: Sums,
    meets: Array,
    how: _Purpose,
    look: Look | None,
) -> tuple[Array, _Pairs, Sums, Array | None]:
    """Velocities, pairs and sums after the contacts of one step; unchanged where no contact approaches.

    The last result are displacements that are zero, and have the derivatives that come of contacts that move in time.
    """
    look_ahead = flow.activation_fraction * flow.timestep
    contact, approaching = is_contact(pairs.separations(), pairs.velocities(), near.reach, look_ahead)
    words = bit_words(contact)
    count = jnp.sum(lax.population_count(words).astype(jnp.int32), dtype=jnp.int32)
    meets = meets & jnp.any(bit_words(approaching) > 0)
    # A lone contact has a closed form, which differs in the last bits: never chosen by what else is in a batch.
    capacities = contact_capacities(grains.radii.size)[1 if in_batch() else 0 :]
    capacities = capacities if how.rungs is None else capacities[-how.rungs :]
    separations, delays, still = pairs.separations(), None, None
    if how.moving_contacts:
        delays = _delays(pairs, near.reach, approaching, flow.timestep)
        apart = jnp.where(_alone(near, contact, grains), delays, 0)
        separations, still = separations + apart[:, None] * pairs.velocities(), jnp.zeros_like(velocities)
    rung = jnp.sum(count > jnp.asarray(capacities[:-1], jnp.int32), dtype=jnp.int32) + 1
    rung = largest_replica(jnp.where(meets, rung, 0))

    def with_capacity(capacity: int):
        def collided():
            index = set_bits(words, capacity, contact.size)
            network = contact_network(index, near, separations, pairs.velocities(), grains)
            impulses, new = _impulses(flow, network, count > capacity, sums, grains, meets)
            new = new if look is None else new._replace(own=with_contacts(sums.own, look, network, impulses))
            change = _velocity_changes(network, impulses, grains)
            (xi, yi), (xj, yj) = change(near.i), change(near.j)
            kicked = pairs._replace(ux=pairs.ux + xi - xj, uy=pairs.uy + yi - yj)
            moved = velocities + jnp.stack(change(jnp.arange(grains.radii.size, dtype=near.i.dtype)), axis=-1)
            shift = None
            if delays is not None:
                own = jnp.minimum(impulses, _binary_impulses(network, 1 + flow.restitution))
                delayed = own * jnp.where(network.used, delays[jnp.where(network.used, index, 0)], 0)
                shift = -grain_impulses(network, delayed, grains.radii.size) / grains.masses[:, None]
            return where_active(meets, (moved, kicked, new, shift), (velocities, pairs, sums, still))

        return collided

    return lax.switch(rung, [lambda: (velocities, pairs, sums, still), *map(with_capacity, capacities)])


def _delays(pairs: _Pairs, reach: Array, approaching: Array, timestep: float | Array) -> Float[Array, " pairs"]:
    """Zero, with the derivative of the time at which each contact of this step began.

    Contacts that began long before are those of clusters: theirs is not a moment, and moves nothing.
    """
    time, _ = first_contact_time(pairs.separations(), pairs.velocities(), reach)
    begins = approaching & (jnp.abs(time) <= timestep)
    time = jnp.where(begins, time, 0)
    return time - lax.stop_gradient(time)


def _alone(near: PairList, contact: Array, grains: Grains) -> Array:
    """Which pairs are contacts of two grains that have no other one."""
    met = contact.astype(jnp.int32)
    degree = jnp.zeros(grains.radii.size, jnp.int32).at[near.i].add(met).at[near.j].add(met)
    return contact & (degree[near.i] == 1) & (degree[near.j] == 1)


def _binary_impulses(network: Contacts, bounce: Array | float) -> Float[Array, " contacts"]:
    """The impulses if every collision were binary, (1 + α) μ₁₂ max(0, −u⁻)."""
    reduced_mass = 1 / jnp.where(network.used, network.inverse_mass_i + network.inverse_mass_j, jnp.inf)
    return bounce * reduced_mass * jnp.maximum(0, -network.approach)


def _shifted(
    shift: Array, shear_rate: float | Array, hood: Neighbourhood, velocities: Array, pairs: _Pairs
) -> tuple[Frame, Array, _Pairs]:
    """Frame, velocities and pairs with the grains displaced, at the same velocities in the laboratory."""
    x, y = shift[:, 0], shift[:, 1]
    frame, near = hood.frame, hood.near
    moved = frame.displacements + jnp.stack([x - frame.strain * y, y], axis=-1)
    apart = shift[near.i] - shift[near.j]
    pairs = pairs._replace(x=pairs.x + apart[:, 0], y=pairs.y + apart[:, 1])
    return Frame(moved, frame.strain), velocities - shear_rate * jnp.stack([y, jnp.zeros_like(y)], axis=-1), pairs


def _velocity_changes(network: Contacts, impulses: Array, grains: Grains):
    """A function that gives the changes of velocity, x and y, of the grains with the given numbers."""
    if impulses.size == 1:
        along = network.normals * impulses[:, None]
        of_i, of_j = along * network.inverse_mass_i[:, None], -along * network.inverse_mass_j[:, None]

        def change(grain: Array) -> tuple[Array, ...]:
            is_i, is_j = grain == network.i, grain == network.j
            return tuple(jnp.where(is_i, of_i[:, a], jnp.where(is_j, of_j[:, a], 0)) for a in (0, 1))
    else:
        table = grain_impulses(network, impulses, grains.radii.size) / grains.masses[:, None]

        def change(grain: Array) -> tuple[Array, ...]:
            return table[:, 0][grain], table[:, 1][grain]

    return change


def _impulses(
    flow: ShearFlow, network: Contacts, overflow: Array, sums: Sums, grains: Grains, meets: Array
) -> tuple[Array, Sums]:
    """Impulses of a network, and the sums with its contribution."""
    count = grains.radii.size
    solution = solve(
        network, count, flow.shear_rate, flow.tolerance, flow.max_iterations, flow.relaxation, flow.solver, meets
    )
    bounce = 1 + flow.restitution
    impulses = bounce * solution.impulses
    approach, (nx, ny), length = network.approach, network.normals.T, network.distances
    binary = _binary_impulses(network, bounce)
    loss = -(approach + bounce / 2 * solution.response)
    overlaps = jnp.where(network.used, jnp.maximum(grains.radii[network.i] + grains.radii[network.j] - length, 0), 0)
    deepest = jnp.max(overlaps)
    slip = bounce / 2 * (approach + solution.response)
    features = jnp.stack(
        [jnp.ones_like(nx), nx * nx * length, nx * ny * length, ny * ny * length, loss, overlaps, slip]
    )
    loaded = impulses > 0
    clustered = in_clusters(network, impulses, count) if impulses.size > 1 else jnp.zeros_like(loaded)
    flags = jnp.stack([network.used, loaded, network.used & (approach < 0)]).astype(nx.dtype)
    weights = jnp.concatenate([jnp.stack([impulses, binary]), flags])
    in_cluster = jnp.where(clustered, impulses, 0)
    status = jnp.where(deepest > DEEP_OVERLAP, Status.deep_overlap, Status.ok)
    status = jnp.maximum(jnp.where(overflow, Status.capacity, status), solution.status).astype(jnp.int32)
    unconverged = solution.status != Status.ok
    counts = jnp.stack([jnp.asarray(x, nx.dtype) for x in (jnp.ones_like(bounce), solution.iterations, unconverged)])
    edges = jnp.asarray(RESIDUAL_EDGES[1:-1], nx.dtype)
    above = jnp.concatenate([jnp.ones(1, bool), solution.residual > edges])
    by_residual = above & ~jnp.append(above[1:], False)
    return impulses, Sums(
        flights=sums.flights,
        contacts=sums.contacts + jnp.matmul(features, weights.T, precision=lax.Precision.HIGHEST),
        clusters=sums.clusters + jnp.sum(features[1:4] * in_cluster[None, :], axis=1),
        solves=sums.solves + jnp.concatenate([counts, by_residual.astype(nx.dtype)]),
        largest=jnp.maximum(sums.largest, jnp.stack([deepest, solution.residual])),
        status=jnp.maximum(sums.status, status),
    )


def _smallest(values: Float[Array, " n"]) -> Float[Array, ""]:
    """Smallest entry of a vector.

    XLA's CPU backend runs a minimum over one long axis as a serial chain of comparisons; folded into rows of 32 it
    is a vector operation. The halves are folded apart so that the entries are computed once, in a loop of their own.
    """
    lanes = 32
    rows = 2 * -(-values.size // (2 * lanes))
    folded = jnp.pad(values, (0, rows * lanes - values.size), constant_values=jnp.inf).reshape(rows, lanes)
    columns = jnp.minimum(jnp.min(folded[: rows // 2], axis=0), jnp.min(folded[rows // 2 :], axis=0))
    return jnp.min(jnp.minimum(columns[: lanes // 2], columns[lanes // 2 :]))
