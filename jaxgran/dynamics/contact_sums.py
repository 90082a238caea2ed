"""The contacts of one step with their impulses, of which ``contact.law`` says what they add to the
running sums.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxgran.contact.delassus import NetworkOperator, loads_of_grains
from jaxgran.contact.law import SolvedContact
from jaxgran.contact.network import Contacts
from jaxgran.contact.solver import Solution
from jaxgran.model.flow import ShearFlow
from jaxgran.model.grains import Grains
from jaxgran.model.indexing import taken


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
