"""The impulses of a solved contact network, and what its contacts add to the running sums."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxgran.contact.delassus import NetworkOperator, loads_of_grains
from jaxgran.contact.law import SolvedContact, contact_terms
from jaxgran.contact.network import Contacts
from jaxgran.contact.solver import Solution
from jaxgran.model.flow import ShearFlow
from jaxgran.model.grains import Grains
from jaxgran.model.indexing import taken
from jaxgran.model.reductions import sums_of


class Impulses(NamedTuple):
    """Impulses of contacts and of grains.

    ========  ===========  ====  ==========================================================
    field     shape        unit  meaning
    ========  ===========  ====  ==========================================================
    contacts  (contacts,)  mσγ̇   J = (1 + α) J₀
    binary    (contacts,)  mσγ̇   (1 + α) m_ij max(0, −u⁻), if every collision were binary
    changes   (contacts,)  σγ̇    u⁺ − u⁻, change of the relative normal velocities
    grains    (grains, 2)  mσγ̇   total impulse of each grain
    loaded    (grains,)    –     contacts with an impulse of each grain
    ========  ===========  ====  ==========================================================
    """

    contacts: Float[Array, " contacts"]
    binary: Float[Array, " contacts"]
    changes: Float[Array, " contacts"]
    grains: Float[Array, "grains 2"]
    loaded: Float[Array, " grains"]


def impulses_of(flow: ShearFlow, network: Contacts, grains: Grains, solution: Solution) -> Impulses:
    """The impulses of a network, from its solution at restitution zero."""
    one_plus_alpha, count = 1 + flow.restitution, grains.radii.size
    impulses = one_plus_alpha * solution.impulses
    stopping = one_plus_alpha * jnp.maximum(0, -network.approach)
    binary = stopping / NetworkOperator(network, count).diagonal()
    changes = one_plus_alpha * solution.response
    return Impulses(impulses, binary, changes, *loads_of_grains(network, impulses, count))


def sums_of_contacts(
    flow: ShearFlow, reach: Float[Array, " contacts"], network: Contacts, impulses: Impulses
) -> tuple[Float[Array, " contact"], Float[Array, ""]]:
    """What the contacts of one step add to the sums, and the largest overlap."""
    p = impulses.contacts
    overlap = jnp.where(network.used, jnp.maximum(reach - network.distances, 0), 0)
    loaded = p > 0
    loads = taken(impulses.loaded, network.i) + taken(impulses.loaded, network.j)
    contact = SolvedContact(
        nx=network.normals[:, 0],
        ny=network.normals[:, 1],
        distance=network.distances,
        overlap=overlap,
        approach=network.approach,
        half_change=impulses.changes / 2,
        one_plus_alpha=1 + flow.restitution,
        impulse=p,
        binary_impulse=impulses.binary,
        clustered=jnp.where(loaded & (loads > 2), p, 0),
        used=network.used.astype(p.dtype),
        loaded=loaded.astype(p.dtype),
        approaching=(network.approach < 0).astype(p.dtype),
    )
    return jnp.stack(sums_of(contact_terms(contact))), jnp.max(overlap)
