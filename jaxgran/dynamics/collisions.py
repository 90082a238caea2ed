"""The contacts of one step: the near list becomes a buffer of ``ContactPairs``, these a network of
``Contacts``, and their solution a ``Collision``, which changes the velocities and the sums.
"""

from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxgran.contact.compaction import count_bits, pack_bits
from jaxgran.contact.delassus import NetworkOperator, loads_of_grains
from jaxgran.contact.law import SolvedContact, contact_terms
from jaxgran.contact.network import ContactPairs, Contacts, is_contact
from jaxgran.contact.solver import Solution, single_contact, solve
from jaxgran.dynamics.carry import Carry, Constants, observer_of
from jaxgran.dynamics.moving_contacts import contact_delays, delayed_shift, displaced, is_binary
from jaxgran.dynamics.observer import with_contacts
from jaxgran.dynamics.tally import CONTACT, RunningSums
from jaxgran.model.control_flow import switch_replica
from jaxgran.model.flow import ShearFlow
from jaxgran.model.grains import Grains
from jaxgran.model.indexing import taken
from jaxgran.model.reductions import sums_of
from jaxgran.model.status import Status

_SINGLE_SLOTS = 4  # for one contact: in one slot XLA would compute the terms once for each sum


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


def solved_contacts(
    flow: ShearFlow,
    reach: Float[Array, " contacts"],
    network: Contacts,
    grains: Grains,
    solution: Solution,
) -> tuple[SolvedContact, Float[Array, "grains 2"]]:
    """The contacts of a network, from its solution at restitution zero, and the total impulse of
    each grain.

    An impulse is J = (1 + α) J₀; if every collision were binary, it would be
    (1 + α) m_ij max(0, −u⁻).
    """
    one_plus_alpha, count = 1 + flow.restitution, grains.radii.size
    impulse = one_plus_alpha * solution.impulses
    stopping = one_plus_alpha * jnp.maximum(0, -network.approach)
    binary_impulse = stopping / NetworkOperator(network, count).diagonal()
    change = one_plus_alpha * solution.response
    momenta, loaded_contacts = loads_of_grains(network, impulse, count)
    overlap = jnp.where(network.used, jnp.maximum(reach - network.distances, 0), 0)
    loaded = impulse > 0
    loads = taken(loaded_contacts, network.i) + taken(loaded_contacts, network.j)
    contacts = SolvedContact(
        nx=network.normals[:, 0],
        ny=network.normals[:, 1],
        distance=network.distances,
        overlap=overlap,
        approach=network.approach,
        half_change=change / 2,
        one_plus_alpha=one_plus_alpha,
        impulse=impulse,
        binary_impulse=binary_impulse,
        clustered=jnp.where(loaded & (loads > 2), impulse, 0),
        used=network.used.astype(impulse.dtype),
        loaded=loaded.astype(impulse.dtype),
        approaching=(network.approach < 0).astype(impulse.dtype),
    )
    return contacts, momenta


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
