"""The contacts of one time step: their impulses, what these do to the grains, and what they add to the sums."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxgran.contact.delassus import grain_impulses, in_clusters
from jaxgran.contact.law import contact_terms
from jaxgran.contact.near_pairs import Frame, PairList, PairLists, bit_words, pair_lists, set_bits
from jaxgran.contact.network import Contacts, contact_network, first_contact_time, is_contact
from jaxgran.contact.projected_methods import ProjectedMethod
from jaxgran.contact.solver import solve
from jaxgran.dynamics.flight import PairMotion, pairs_now
from jaxgran.dynamics.observer import ObserveNow, with_contacts
from jaxgran.dynamics.tally import RESIDUAL_EDGES, RunningSums
from jaxgran.model.control_flow import in_batch, largest_replica, where_active
from jaxgran.model.flow import ShearFlow
from jaxgran.model.grains import Grains
from jaxgran.model.state import State
from jaxgran.model.status import Status

Observe = Callable[[ShearFlow, State, Contacts, Array], Any]  # of a time step: the state, its contacts, their impulses


class AdvanceOptions(NamedTuple):
    """How the engine ``Jax`` advances a flow.

    solver: solves the contacts. buffers: how many of the contact buffers are compiled, the largest ones; None for all
    of them. moving_contacts: whether derivatives include that a contact moves in time. observe: a function of the
    user's, or None. All but the numbers of the solver are static.
    """

    solver: ProjectedMethod
    buffers: int | None = None
    moving_contacts: bool = False
    observe: Observe | None = None


def contact_capacities(grains: int) -> tuple[int, ...]:
    """Sizes of the contact buffers, smallest first. Contacts of discs form a planar graph: at most 3 N of them."""
    top = 3 * grains
    return tuple(sorted({1, *(max(4, top // share) for share in (96, 24, 6, 3, 1))}))


def contacts_now(flow: ShearFlow, state: State) -> Contacts:
    """The contact network that the next time step of a flow would solve, in a buffer that holds any packing."""
    lists = pair_lists(state.positions, state.grains, state.side, state.tilt)
    pairs = pairs_now(lists, state.velocities, flow.shear_rate)
    separations, velocities = pairs.separations(), pairs.velocities()
    contact, _ = is_contact(separations, velocities, lists.near.reach, flow.activation_fraction * flow.timestep)
    index = set_bits(bit_words(contact), contact_capacities(state.grains.radii.size)[-1], contact.size)
    return contact_network(index, lists.near, separations, velocities, state.grains)


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
    in time (see ``plain``). None where this derivative is not asked for.
    """
    look_ahead = flow.activation_fraction * flow.timestep
    contact, approaching = is_contact(pairs.separations(), pairs.velocities(), near.reach, look_ahead)
    words = bit_words(contact)
    count = jnp.sum(lax.population_count(words).astype(jnp.int32), dtype=jnp.int32)
    meets = meets & jnp.any(bit_words(approaching) > 0)
    # A single contact has a closed form, whose last bits differ. In a batch it is left out, so that the result of a
    # replica does not depend on the others.
    first = 1 if in_batch() else 0
    capacities = contact_capacities(grains.radii.size)[first:]
    capacities = capacities if options.buffers is None else capacities[-options.buffers :]
    separations, delays, zero_shift = pairs.separations(), None, None
    if options.moving_contacts:
        delays = _delays(pairs, near.reach, approaching, flow.timestep)
        apart = jnp.where(_alone(near, contact, grains), delays, 0)
        separations, zero_shift = separations + apart[:, None] * pairs.velocities(), jnp.zeros_like(velocities)
    buffer = jnp.sum(count > jnp.asarray(capacities[:-1], jnp.int32), dtype=jnp.int32) + 1
    buffer = largest_replica(jnp.where(meets, buffer, 0))  # 0: nothing to solve

    def with_capacity(capacity: int):
        def collided():
            index = set_bits(words, capacity, contact.size)
            network = contact_network(index, near, separations, pairs.velocities(), grains)
            impulses, new = _impulses(flow, options.solver, network, count > capacity, sums, grains, meets)
            if observe_now is not None:
                new = new._replace(user_sums=with_contacts(sums.user_sums, observe_now, network, impulses))
            change = _velocity_changes(network, impulses, grains)
            (xi, yi), (xj, yj) = change(near.i), change(near.j)
            kicked = pairs._replace(ux=pairs.ux + xi - xj, uy=pairs.uy + yi - yj)
            moved = velocities + jnp.stack(change(jnp.arange(grains.radii.size, dtype=near.i.dtype)), axis=-1)
            shift = None
            if delays is not None:
                own_approach = jnp.minimum(impulses, _binary_impulses(network, 1 + flow.restitution))
                delayed = own_approach * jnp.where(network.used, delays[jnp.where(network.used, index, 0)], 0)
                shift = -grain_impulses(network, delayed, grains.radii.size) / grains.masses[:, None]
            return where_active(meets, (moved, kicked, new, shift), (velocities, pairs, sums, zero_shift))

        return collided

    return lax.switch(buffer, [lambda: (velocities, pairs, sums, zero_shift), *map(with_capacity, capacities)])


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


def _binary_impulses(network: Contacts, one_plus_alpha: Array | float) -> Float[Array, " contacts"]:
    """The impulses if every collision were binary, (1 + α) μ₁₂ max(0, −u⁻)."""
    reduced_mass = 1 / jnp.where(network.used, network.inverse_mass_i + network.inverse_mass_j, jnp.inf)
    return one_plus_alpha * reduced_mass * jnp.maximum(0, -network.approach)


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
    flow: ShearFlow,
    solver: ProjectedMethod,
    network: Contacts,
    overflow: Array,
    sums: RunningSums,
    grains: Grains,
    meets: Array,
) -> tuple[Array, RunningSums]:
    """Impulses of a network, and the sums with its contribution."""
    count = grains.radii.size
    solution = solve(network, count, flow.shear_rate, solver, meets)
    one_plus_alpha = 1 + flow.restitution
    impulses = one_plus_alpha * solution.impulses
    approach, (nx, ny), distance = network.approach, network.normals.T, network.distances
    reach = grains.radii[network.i] + grains.radii[network.j]
    overlap = jnp.where(network.used, jnp.maximum(reach - distance, 0), 0)
    deepest = jnp.max(overlap)
    loaded = impulses > 0
    clustered = in_clusters(network, impulses, count) if impulses.size > 1 else jnp.zeros_like(loaded)
    flags = (flag.astype(nx.dtype) for flag in (network.used, loaded, network.used & (approach < 0)))
    terms = contact_terms(
        nx,
        ny,
        distance,
        overlap,
        approach,
        one_plus_alpha / 2 * solution.response,
        one_plus_alpha,
        impulses,
        _binary_impulses(network, one_plus_alpha),
        jnp.where(clustered, impulses, 0),
        *flags,
    )
    status = jnp.where(overflow, Status.capacity, Status.ok)
    status = jnp.maximum(status, solution.status).astype(jnp.int32)
    unconverged = solution.status != Status.ok
    counts = jnp.stack(
        [jnp.asarray(x, nx.dtype) for x in (jnp.ones_like(one_plus_alpha), solution.iterations, unconverged)]
    )
    edges = jnp.asarray(RESIDUAL_EDGES[1:-1], nx.dtype)
    above = jnp.concatenate([jnp.ones(1, bool), solution.residual > edges])
    by_residual = above & ~jnp.append(above[1:], False)
    return impulses, sums._replace(
        contact=sums.contact + jnp.sum(jnp.stack(terms), axis=1),
        solve=sums.solve + jnp.concatenate([counts, by_residual.astype(nx.dtype)]),
        largest=jnp.maximum(sums.largest, jnp.stack([deepest, solution.residual])),
        status=jnp.maximum(sums.status, status),
    )
