"""The impulses of a solved contact network, and what its contacts add to the running sums."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxgran.contact.delassus import NetworkOperator, loads_of_grains
from jaxgran.contact.law import contact_terms
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
    flags = (network.used, loaded, network.approach < 0)
    terms = contact_terms(
        network.normals[:, 0],
        network.normals[:, 1],
        network.distances,
        overlap,
        network.approach,
        impulses.changes / 2,
        1 + flow.restitution,
        p,
        impulses.binary,
        jnp.where(loaded & (loads > 2), p, 0),
        *(flag.astype(p.dtype) for flag in flags),
    )
    return jnp.stack(sums_of(terms)), jnp.max(overlap)
