"""The contacts of one time step: their impulses, what these do to the grains, and what they add to the sums."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from jaxgran.contact.delassus import diagonal, grain_impulses, loads_of_grains
from jaxgran.contact.law import contact_terms
from jaxgran.contact.near_pairs import Frame, PairList, PairLists, bit_words, pair_lists, set_bits
from jaxgran.contact.network import Contacts, PairMotion, contact_network, first_contact_time, is_contact
from jaxgran.contact.projected_methods import ProjectedMethod
from jaxgran.contact.solver import Solution, solve
from jaxgran.dynamics.flight import closing_speed, pairs_now
from jaxgran.dynamics.observer import ObserveNow, with_contacts
from jaxgran.dynamics.tally import RunningSums
from jaxgran.model.control_flow import switch_replica
from jaxgran.model.flow import ShearFlow
from jaxgran.model.grains import Grains
from jaxgran.model.indexing import added_at, taken
from jaxgran.model.state import State
from jaxgran.model.status import Status

Observe = Callable[[ShearFlow, State, Contacts, Array], Any]  # of a time step: the state, its contacts, their impulses
MOST_CONTACTS = 3  # of a grain: the contacts of discs form a planar graph


class AdvanceOptions(NamedTuple):
    """How the engine ``Jax`` advances a flow.

    solver: solves the contacts. buffers: numbers of contacts for which a solve is compiled, smallest first, beside that
    of all near pairs. moving_contacts: whether derivatives include that a contact moves in time. observe: a function of
    the user's, or None. All but the numbers of the solver are static.
    """

    solver: ProjectedMethod
    buffers: tuple[int, ...] = ()
    moving_contacts: bool = False
    observe: Observe | None = None


def contact_buffers(grains: int) -> tuple[int, ...]:
    """Sizes of the buffers for the contacts of dilute and of dense flows, smallest first."""
    return tuple(sorted({max(4, grains // 3), max(4, grains)}))


class Touching(NamedTuple):
    """The pairs of the near list, or those picked from it, (pairs,) each, and which of them are contacts."""

    i: Array
    j: Array
    reach: Array
    motion: PairMotion
    contact: Array

    def picked(self, size: int, words: Array) -> "Touching":
        """The first contacts in a buffer of a size; ``words`` are those of ``bit_words(contact)``."""
        pairs = self.contact.size
        index = set_bits(words, size, pairs)
        used = index < pairs
        index = jnp.where(used, index, 0)
        i, j, reach, motion = jax.tree.map(lambda x: taken(x, index), self[:-1])
        return Touching(i, j, reach, motion, used)

    def network(self, grains: Grains) -> Contacts:
        """The contact network."""
        return contact_network(self.contact, self.i, self.j, self.motion, grains)


def contacts_now(flow: ShearFlow, state: State) -> tuple[Contacts, Int[Array, ""]]:
    """The contact network that the next time step of a flow would solve, in a buffer that holds any packing.

    The status is ``capacity`` where contacts may be missing: a step looks further ahead than the list of pairs, or has
    more contacts than discs that hardly overlap.
    """
    grains, listed = state.grains, pair_lists(state.positions, state.grains, state.side, state.tilt)
    lists = replace(listed, near=listed.outer)
    pairs = pairs_now(lists, state.velocities, flow.shear_rate)
    look_ahead = flow.activation_fraction * flow.timestep
    contact, _ = is_contact(pairs, lists.near.reach, look_ahead)
    touching = Touching(lists.near.i, lists.near.j, lists.near.reach, pairs, contact)
    room = MOST_CONTACTS * grains.radii.size
    loss = closing_speed(flow, grains, state.velocities, lists.near.skin)
    suffices = lists.near.skin >= loss * look_ahead
    missing = ~suffices | lists.near.overflow | (jnp.sum(contact, dtype=jnp.int32) > room)
    status = jnp.where(missing, Status.capacity, Status.ok).astype(jnp.int32)
    return touching.picked(room, bit_words(contact)).network(grains), status


class Impulses(NamedTuple):
    """Impulses of the contacts, those if every collision were binary, (1 + α) μ₁₂ max(0, −u⁻), the change of their
    velocities u⁺ − u⁻, impulses of the grains, and contacts with an impulse of each grain."""

    contacts: Float[Array, " contacts"]
    binary: Float[Array, " contacts"]
    changes: Float[Array, " contacts"]
    grains: Float[Array, "grains 2"]
    loaded: Float[Array, " grains"]


class Collision(NamedTuple):
    """What the contacts of one step do: momenta and displacements of the grains, and what they add to the sums."""

    momenta: Float[Array, "grains 2"]
    contact_sums: Array
    deepest: Array
    iterations: Array
    residual: Array
    status: Array
    user_sums: Any
    shift: Float[Array, "grains 2"] | None


def collide(
    flow: ShearFlow,
    near: PairList,
    grains: Grains,
    velocities: Array,
    pairs: PairMotion,
    sums: RunningSums,
    meets: Array,
    options: AdvanceOptions,
    observe_now: ObserveNow | None,
) -> tuple[Array, PairMotion, RunningSums, Array | None]:
    """Velocities, pairs and sums after the contacts of one step; unchanged where no contact approaches.

    The contacts are picked from the near list into the smallest buffer that holds them, and solved and summed there;
    more than the largest buffer holds are solved and summed on the list.

    Args:
      meets: whether this replica has a step to solve; others of its batch stay as they are.

    The last result is a displacement of the grains. Its value is zero; its derivative is that of contacts that move
    in time (see ``jax_engine``). None where this derivative is not asked for.
    """
    look_ahead, zero = flow.activation_fraction * flow.timestep, jnp.zeros_like(sums.largest[0])
    contact, approaching = is_contact(pairs, near.reach, look_ahead)
    meets = meets & jnp.any(bit_words(approaching) > 0)
    contact, moved, delays = contact & meets, pairs, None
    if options.moving_contacts:
        delays = _delays(pairs, near.reach, approaching, flow.timestep)
        apart = jnp.where(_alone(near, contact, grains), delays, 0)
        moved = pairs.moved(apart)
    touching = Touching(near.i, near.j, near.reach, moved, contact)
    words = bit_words(contact)
    contacts = jnp.sum(lax.population_count(words).astype(jnp.int32), dtype=jnp.int32)

    def acted(touching: Touching, solved: Callable[[Contacts], Solution], delays: Array | None = None) -> Collision:
        """What the contacts do, from the network of those that touch and its solution."""
        network = touching.network(grains)
        solution = solved(network)
        found = _impulses(flow, network, grains, solution)
        added, deepest = _contact_sums(flow, touching, network, found)
        user_sums, shift = sums.user_sums, None
        if observe_now is not None:
            user_sums = with_contacts(user_sums, observe_now, network, found.contacts)
        if delays is not None:
            own = jnp.minimum(found.contacts, found.binary)
            delayed = grain_impulses(network, own * jnp.where(network.used, delays, 0), grains.radii.size)
            shift = -delayed / grains.masses[:, None]
        outcome = solution.iterations, solution.residual, solution.status
        return Collision(found.grains, added, deepest, *outcome, user_sums, shift)

    def by_iteration(active: Array, network: Contacts) -> Solution:
        return solve(network, grains.radii.size, flow.shear_rate, options.solver, active)

    def single(active: Array) -> Collision:
        # in one slot XLA would add up nothing, and then compute the terms once for each sum
        return acted(touching.picked(4, words), partial(_of_single, grains))

    def in_buffer(size: int, active: Array) -> Collision:
        return acted(touching.picked(size, words), partial(by_iteration, active))

    def on_list(active: Array) -> Collision:
        return acted(touching, partial(by_iteration, active), delays)

    still = jnp.zeros_like(velocities)
    shift = None if delays is None else still
    unchanged = Collision(
        still, jnp.zeros_like(sums.contact), zero, jnp.int32(0), zero, jnp.int32(0), sums.user_sums, shift
    )
    sizes = options.buffers
    programs = [single, *(partial(in_buffer, size) for size in sizes), on_list] if sizes else [on_list]
    limits = jnp.asarray([0, 1, *sizes] if sizes else [0], jnp.int32)
    collision = switch_replica(jnp.sum(contacts > limits, dtype=jnp.int32), unchanged, programs)
    kicks = collision.momenta / grains.masses[:, None]
    x, y = kicks.T
    felt_x, felt_y = (taken(a, near.i) - taken(a, near.j) for a in (x, y))
    pairs = pairs._replace(ux=pairs.ux + felt_x, uy=pairs.uy + felt_y)
    return velocities + kicks, pairs, _with_collision(sums, collision, meets), collision.shift


def _of_single(grains: Grains, network: Contacts) -> Solution:
    """The closed form of a single contact, for which the iteration would need one product."""
    own = diagonal(network, grains.radii.size)
    impulses = jnp.maximum(0, -network.approach / own)
    status = jnp.where(jnp.any(jnp.isnan(impulses)), Status.nonfinite, Status.ok).astype(jnp.int32)
    return Solution(impulses, own * impulses, jnp.zeros((), impulses.dtype), jnp.int32(1), status)


def _impulses(flow: ShearFlow, network: Contacts, grains: Grains, solution: Solution) -> Impulses:
    """The impulses of a network, from its solution at restitution zero."""
    one_plus_alpha = 1 + flow.restitution
    impulses = one_plus_alpha * solution.impulses
    binary = one_plus_alpha * jnp.maximum(0, -network.approach) / diagonal(network, grains.radii.size)
    changes = one_plus_alpha * solution.response
    return Impulses(impulses, binary, changes, *loads_of_grains(network, impulses, grains.radii.size))


def _contact_sums(flow: ShearFlow, touching: Touching, network: Contacts, found: Impulses) -> tuple[Array, Array]:
    """What the contacts of one step add to the sums, and the largest overlap."""
    nx, ny = network.normals[:, 0], network.normals[:, 1]
    impulses, dtype = found.contacts, found.contacts.dtype
    overlap = jnp.where(network.used, jnp.maximum(touching.reach - network.distances, 0), 0)
    loaded = impulses > 0
    clustered = loaded & (taken(found.loaded, network.i) + taken(found.loaded, network.j) > 2)
    flags = (flag.astype(dtype) for flag in (network.used, loaded, network.approach < 0))
    terms = contact_terms(
        nx,
        ny,
        network.distances,
        overlap,
        network.approach,
        found.changes / 2,
        1 + flow.restitution,
        impulses,
        found.binary,
        jnp.where(clustered, impulses, 0),
        *flags,
    )
    return jnp.stack(_sums_of(terms)), jnp.max(overlap)


def _with_collision(sums: RunningSums, collision: Collision, meets: Array) -> RunningSums:
    """The sums with what the contacts of one step add."""
    dtype = sums.contact.dtype
    solve_counts = [meets, collision.iterations, collision.status != Status.ok]
    return sums._replace(
        contact=sums.contact + collision.contact_sums,
        solve=sums.solve + jnp.stack([x.astype(dtype) for x in solve_counts]),
        largest=jnp.maximum(sums.largest, jnp.stack([collision.deepest, collision.residual])),
        status=jnp.maximum(sums.status, collision.status),
        user_sums=collision.user_sums,
    )


@jax.custom_jvp
def _sums_of(terms: tuple[Array, ...]) -> list[Array]:
    """The sum of each vector, in one pass over all of them: a reduction of each takes XLA two to four times as long."""
    zeros = [jnp.zeros((), terms[0].dtype)] * len(terms)
    return lax.reduce(list(terms), zeros, lambda a, b: [x + y for x, y in zip(a, b, strict=True)], (0,))


@_sums_of.defjvp
def _sums_of_jvp(primals: tuple, tangents: tuple) -> tuple[list[Array], list[Array]]:
    return _sums_of(*primals), [jnp.sum(tangent) for tangent in tangents[0]]


def _delays(pairs: PairMotion, reach: Array, approaching: Array, timestep: float | Array) -> Float[Array, " pairs"]:
    """Zero, with the derivative of the time at which each contact of this step began.

    Contacts that began long before belong to clusters. They have no moment of contact that could move.
    """
    time, _ = first_contact_time(pairs, reach)
    begins = approaching & (jnp.abs(time) <= timestep)
    time = jnp.where(begins, time, 0)
    return time - lax.stop_gradient(time)


def _alone(near: PairList, contact: Array, grains: Grains) -> Array:
    """Which pairs are contacts of two grains that have no other one."""
    met = contact.astype(jnp.int32)
    degree = added_at(added_at(jnp.zeros(grains.radii.size, jnp.int32), near.i, met), near.j, met)
    return contact & (taken(degree, near.i) == 1) & (taken(degree, near.j) == 1)


def shifted(
    shift: Array, shear_rate: float | Array, lists: PairLists, velocities: Array, pairs: PairMotion
) -> tuple[Frame, Array, PairMotion]:
    """Frame, velocities and pairs with the grains displaced, at the same velocities in the laboratory."""
    x, y = shift[:, 0], shift[:, 1]
    frame, near = lists.frame, lists.near
    moved = frame.displacements + jnp.stack([x - frame.strain * y, y], axis=-1)
    apart = taken(shift, near.i) - taken(shift, near.j)
    pairs = pairs._replace(x=pairs.x + apart[:, 0], y=pairs.y + apart[:, 1])
    return Frame(moved, frame.strain), velocities - shear_rate * jnp.stack([y, jnp.zeros_like(y)], axis=-1), pairs
