"""The contacts of one time step: their impulses, what these do to the grains, and what they add to the sums."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxgran.contact.delassus import grain_impulses
from jaxgran.contact.law import contact_terms
from jaxgran.contact.near_pairs import Frame, PairList, PairLists, bit_words, pair_lists, set_bits
from jaxgran.contact.network import Contacts, contact_network, first_contact_time, is_contact
from jaxgran.contact.projected_methods import ProjectedMethod
from jaxgran.contact.solver import solve
from jaxgran.dynamics.flight import PairMotion, pairs_now
from jaxgran.dynamics.observer import ObserveNow, with_contacts
from jaxgran.dynamics.tally import RESIDUAL_EDGES, RunningSums
from jaxgran.model.control_flow import switch_replica
from jaxgran.model.flow import ShearFlow
from jaxgran.model.grains import Grains
from jaxgran.model.state import State
from jaxgran.model.status import Status

T = TypeVar("T")
Observe = Callable[[ShearFlow, State, Contacts, Array], Any]  # of a time step: the state, its contacts, their impulses


class AdvanceOptions(NamedTuple):
    """How the engine ``Jax`` advances a flow.

    solver: solves the contacts. capacities: sizes of the contact buffers that are compiled, smallest first.
    moving_contacts: whether derivatives include that a contact moves in time. observe: a function of the user's, or
    None. All but the numbers of the solver are static.
    """

    solver: ProjectedMethod
    capacities: tuple[int, ...]
    moving_contacts: bool = False
    observe: Observe | None = None


def contact_capacities(grains: int) -> tuple[int, ...]:
    """Sizes of the contact buffers, smallest first: for dilute and for dense flows, and for any packing.

    The contacts of discs form a planar graph, so there are at most 3 N of them.
    """
    return tuple(sorted({max(4, grains // 12), grains // 3, grains, 3 * grains}))


def contacts_now(flow: ShearFlow, state: State) -> Contacts:
    """The contact network that the next time step of a flow would solve, in a buffer that holds any packing."""
    lists = pair_lists(state.positions, state.grains, state.side, state.tilt)
    pairs = pairs_now(lists, state.velocities, flow.shear_rate)
    separations, velocities = pairs.separations(), pairs.velocities()
    contact, _ = is_contact(separations, velocities, lists.near.reach, flow.activation_fraction * flow.timestep)
    index = set_bits(bit_words(contact), contact_capacities(state.grains.radii.size)[-1], contact.size)
    return contact_network(index, lists.near, separations, velocities, state.grains)


class Touching(NamedTuple):
    """The contacts of one step among the near pairs, (pairs,) each; normals and approach are zero elsewhere."""

    i: Array
    j: Array
    reach: Array
    contact: Array
    nx: Array
    ny: Array
    distance: Array
    approach: Array
    inverse_mass_i: Array
    inverse_mass_j: Array


class Solved(NamedTuple):
    """What the solve of a network gives: impulses of the near pairs and of the grains, and how it went."""

    impulses: Float[Array, " pairs"]
    momenta: Float[Array, "grains 2"]
    iterations: Array
    residual: Array
    status: Array


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

    Args:
      meets: whether this replica has a step to solve; others of its batch stay as they are.

    The last result is a displacement of the grains. Its value is zero; its derivative is that of contacts that move
    in time (see ``jax_engine``). None where this derivative is not asked for.
    """
    look_ahead = flow.activation_fraction * flow.timestep
    contact, approaching = is_contact(pairs.separations(), pairs.velocities(), near.reach, look_ahead)
    meets = meets & jnp.any(bit_words(approaching) > 0)
    contact = contact & meets
    x, y, delays = pairs.x, pairs.y, None
    if options.moving_contacts:
        delays = _delays(pairs, near.reach, approaching, flow.timestep)
        apart = jnp.where(_alone(near, contact, grains), delays, 0)
        x, y = x + apart * pairs.ux, y + apart * pairs.uy
    distance = jnp.sqrt(x * x + y * y)
    over = jnp.where(contact, 1 / distance, 0)
    nx, ny = over * x, over * y
    inverse_masses = 1 / grains.masses
    masses = inverse_masses[near.i], inverse_masses[near.j]
    touching = Touching(near.i, near.j, near.reach, contact, nx, ny, distance, nx * pairs.ux + ny * pairs.uy, *masses)
    contacts = jnp.sum(lax.population_count(bit_words(contact)).astype(jnp.int32), dtype=jnp.int32)
    solved = _solved(flow, touching, contacts, grains.radii.size, options)
    kicks = solved.momenta * inverse_masses[:, None]
    felt_x, felt_y = (kicks[:, a][near.i] - kicks[:, a][near.j] for a in (0, 1))
    binary = _binary_impulses(touching, 1 + flow.restitution)
    half_change = (nx * felt_x + ny * felt_y) / 2
    added, deepest = _contact_sums(flow, touching, contacts, solved, binary, half_change, options)
    sums = _with_solve(sums._replace(contact=sums.contact + added), solved, deepest, meets)
    if observe_now is not None:
        network, index = _network(touching, contact_capacities(grains.radii.size)[-1])
        impulses = jnp.where(network.used, solved.impulses[index], 0)
        user_sums = with_contacts(sums.user_sums, observe_now, network, impulses)
        sums = sums._replace(user_sums=jax.tree.map(partial(jnp.where, meets), user_sums, sums.user_sums))
    shift = None
    if delays is not None:
        delayed = jnp.minimum(solved.impulses, binary) * jnp.where(contact, delays, 0)
        along = jnp.stack([nx * delayed, ny * delayed], axis=-1)
        shift = -jnp.zeros_like(velocities).at[near.i].add(along).at[near.j].add(-along) * inverse_masses[:, None]
    return velocities + kicks, pairs._replace(ux=pairs.ux + felt_x, uy=pairs.uy + felt_y), sums, shift


def _network(touching: Touching, capacity: int) -> tuple[Contacts, Array]:
    """The contacts in a buffer, and the number of the pair of each slot; unused slots have that of the first pair."""
    picked, used, index = _picked(touching, touching.contact, capacity)
    network = Contacts(
        i=touching.i[index],
        j=touching.j[index],
        normals=jnp.stack([picked.nx, picked.ny], axis=-1),
        distances=touching.distance[index],
        approach=picked.approach,
        inverse_mass_i=picked.inverse_mass_i,
        inverse_mass_j=picked.inverse_mass_j,
        used=used,
    )
    return network, index


def _picked(values: T, contact: Array, capacity: int) -> tuple[T, Array, Array]:
    """Values of the contacts in a buffer, zero in unused slots; which slots are used, and the pairs they are of."""
    index = set_bits(bit_words(contact), capacity, contact.size)
    used = index < contact.size
    index = jnp.where(used, index, 0)
    return jax.tree.map(lambda x: jnp.where(used, x[index], jnp.zeros((), x.dtype)), values), used, index


def _solved(flow: ShearFlow, touching: Touching, contacts: Array, grains: int, options: AdvanceOptions) -> Solved:
    """The impulses of one step with so many contacts, by a program for the smallest buffer that holds them."""
    slots, dtype = touching.contact.size, touching.approach.dtype
    zero, none = jnp.zeros((), dtype), jnp.int32(0)
    nothing = Solved(jnp.zeros(slots, dtype), jnp.zeros((grains, 2), dtype), none, zero, none)

    def single(_: Array) -> Solved:
        """The closed form of a single contact, for which the iteration would need one product."""
        at = jnp.argmax(touching.contact)
        response = touching.inverse_mass_i[at] + touching.inverse_mass_j[at]
        impulse = (1 + flow.restitution) * jnp.maximum(0, -touching.approach[at] / response)
        along = impulse * jnp.stack([touching.nx[at], touching.ny[at]])
        grain = jnp.arange(grains, dtype=touching.i.dtype)[:, None]
        momenta = jnp.where(grain == touching.i[at], along, jnp.where(grain == touching.j[at], -along, 0))
        status = jnp.where(jnp.isnan(impulse), Status.nonfinite, Status.ok).astype(jnp.int32)
        return Solved(jnp.where(touching.contact, impulse, 0), momenta, jnp.int32(1), zero, status)

    def with_capacity(capacity: int):
        def solved(active: Array) -> Solved:
            network, index = _network(touching, capacity)
            solution = solve(network, grains, flow.shear_rate, options.solver, active)
            impulses = (1 + flow.restitution) * solution.impulses
            placed = nothing.impulses.at[jnp.where(network.used, index, slots)].set(impulses, mode="drop")
            status = jnp.maximum(jnp.where(contacts > capacity, Status.capacity, Status.ok), solution.status)
            momenta = grain_impulses(network, impulses, grains)
            return Solved(placed, momenta, solution.iterations, solution.residual, status.astype(jnp.int32))

        return solved

    programs = [single, *map(with_capacity, options.capacities)]
    return switch_replica(_above(contacts, 0, 1, *options.capacities[:-1]), nothing, programs)


def _above(contacts: Array, *limits: int) -> Array:
    """How many of the limits a number of contacts exceeds."""
    return jnp.sum(contacts > jnp.asarray(limits, jnp.int32), dtype=jnp.int32)


def _binary_impulses(touching: Touching, one_plus_alpha: Array | float) -> Float[Array, " pairs"]:
    """The impulses if every collision were binary, (1 + α) μ₁₂ max(0, −u⁻)."""
    response = touching.inverse_mass_i + touching.inverse_mass_j
    return one_plus_alpha / response * jnp.maximum(0, -touching.approach)


def _contact_sums(
    flow: ShearFlow,
    touching: Touching,
    contacts: Array,
    solved: Solved,
    binary: Array,
    half_change: Array,
    options: AdvanceOptions,
) -> tuple[Array, Array]:
    """What the contacts of one step add to the sums, and the largest overlap; the few of a dilute flow apart."""
    few, values = options.capacities[0], (touching, solved.impulses, binary, half_change)

    def total(touching: Touching, impulses: Array, binary: Array, half_change: Array) -> tuple[Array, Array]:
        nx, ny, dtype = touching.nx, touching.ny, touching.nx.dtype
        overlap = jnp.where(touching.contact, jnp.maximum(touching.reach - touching.distance, 0), 0)
        loaded = impulses > 0
        # Where neither grain of a contact feels another one, the momentum of both is the contact's to the bit.
        px, py, (x, y) = nx * impulses, ny * impulses, solved.momenta.T
        others_of_i = (x[touching.i] != px) | (y[touching.i] != py)
        clustered = loaded & (others_of_i | (x[touching.j] != -px) | (y[touching.j] != -py))
        flags = (flag.astype(dtype) for flag in (touching.contact, loaded, touching.approach < 0))
        terms = contact_terms(
            nx,
            ny,
            touching.distance,
            overlap,
            touching.approach,
            half_change,
            1 + flow.restitution,
            impulses,
            binary,
            jnp.where(clustered, impulses, 0),
            *flags,
        )
        return jnp.stack(_sums_of(terms)), jnp.max(overlap)

    def of_few(_: Array) -> tuple[Array, Array]:
        return total(*_picked(values, touching.contact, few)[0])

    def of_all(_: Array) -> tuple[Array, Array]:
        return total(*values)

    programs = [of_few, of_all] if few < options.capacities[-1] else [of_all]
    none = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(total, *values))
    return switch_replica(_above(contacts, *[0, few][: len(programs)]), none, programs)


def _with_solve(sums: RunningSums, solved: Solved, deepest: Array, meets: Array) -> RunningSums:
    """The sums with what the solve of one step contributes, beside its contacts."""
    dtype = deepest.dtype
    solve_counts = [meets, solved.iterations, solved.status != Status.ok]
    above = jnp.append(jnp.ones(1, bool), solved.residual > jnp.asarray(RESIDUAL_EDGES[1:-1], dtype)) & meets
    by_residual = above & ~jnp.append(above[1:], False)
    return sums._replace(
        solve=sums.solve
        + jnp.concatenate([jnp.stack([x.astype(dtype) for x in solve_counts]), by_residual.astype(dtype)]),
        largest=jnp.maximum(sums.largest, jnp.stack([deepest, solved.residual])),
        status=jnp.maximum(sums.status, solved.status),
    )


@jax.custom_jvp
def _sums_of(terms: tuple[Array, ...]) -> list[Array]:
    """The sum of each vector, in one pass over all of them: a reduction of each takes XLA two to four times as long."""
    zeros = [jnp.zeros((), term.dtype) for term in terms]
    return lax.reduce(list(terms), zeros, lambda a, b: [x + y for x, y in zip(a, b, strict=True)], (0,))


@_sums_of.defjvp
def _sums_of_jvp(primals: tuple, tangents: tuple) -> tuple[list[Array], list[Array]]:
    return _sums_of(*primals), [jnp.sum(tangent) for tangent in tangents[0]]


def _delays(pairs: PairMotion, reach: Array, approaching: Array, timestep: float | Array) -> Float[Array, " pairs"]:
    """Zero, with the derivative of the time at which each contact of this step began.

    Contacts that began long before belong to clusters. They have no moment of contact that could move.
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


def shifted(
    shift: Array, shear_rate: float | Array, lists: PairLists, velocities: Array, pairs: PairMotion
) -> tuple[Frame, Array, PairMotion]:
    """Frame, velocities and pairs with the grains displaced, at the same velocities in the laboratory."""
    x, y = shift[:, 0], shift[:, 1]
    frame, near = lists.frame, lists.near
    moved = frame.displacements + jnp.stack([x - frame.strain * y, y], axis=-1)
    apart = shift[near.i] - shift[near.j]
    pairs = pairs._replace(x=pairs.x + apart[:, 0], y=pairs.y + apart[:, 1])
    return Frame(moved, frame.strain), velocities - shear_rate * jnp.stack([y, jnp.zeros_like(y)], axis=-1), pairs
