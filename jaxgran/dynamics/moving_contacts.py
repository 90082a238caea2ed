"""The derivative of a contact that moves in time, for ``moving_contacts``; see ``jax_engine``.

Everything here has the value zero and a derivative. A contact that begins in a step is moved along
the free flight of its pair to the moment at which the grains touch. Its impulse acts from there, so
the grains are displaced by what they would have flown differently.
"""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxgran.contact.delassus import grain_impulses
from jaxgran.contact.law import SolvedContact
from jaxgran.contact.near_pairs import Frame, PairList, PairLists
from jaxgran.contact.network import Contacts, PairMotion, first_contact_time
from jaxgran.model.grains import Grains
from jaxgran.model.indexing import added_at, taken


def contact_delays(
    pairs: PairMotion, reach: Array, approaching: Array, timestep: float | Array
) -> Float[Array, " pairs"]:
    """Zero, with the derivative of the time at which each contact of this step began.

    Contacts that began long before belong to clusters. They have no moment of contact that could
    move.
    """
    time, _ = first_contact_time(pairs, reach)
    begins = approaching & (jnp.abs(time) <= timestep)
    began = jnp.where(begins, time, 0)
    return began - lax.stop_gradient(began)


def is_binary(near: PairList, contact: Array, grains: Grains) -> Bool[Array, " pairs"]:
    """Which pairs are contacts of two grains that have no other one."""
    counted = contact.astype(jnp.int32)
    zeros = jnp.zeros(grains.radii.size, jnp.int32)
    degree = added_at(added_at(zeros, near.i, counted), near.j, counted)
    return contact & (taken(degree, near.i) == 1) & (taken(degree, near.j) == 1)


def delayed_shift(
    delays: Array, network: Contacts, grains: Grains, contacts: SolvedContact
) -> Float[Array, "grains 2"]:
    """Displacements of the grains, as the impulse of each contact's own approach acts later by its
    delay.
    """
    moving = jnp.minimum(contacts.impulse, contacts.binary_impulse)
    delayed = moving * jnp.where(network.used, delays, 0)
    return -grain_impulses(network, delayed, grains.radii.size) / grains.masses[:, None]


def displaced(
    shift: Array, shear_rate: float | Array, lists: PairLists, velocities: Array, pairs: PairMotion
) -> tuple[Frame, Array, PairMotion]:
    """Frame, velocities and pairs with the grains displaced, at the same velocities in the
    laboratory.
    """
    x, y = shift[:, 0], shift[:, 1]
    frame, near = lists.frame, lists.near
    displacements = frame.displacements + jnp.stack([x - frame.strain * y, y], axis=-1)
    apart = taken(shift, near.i) - taken(shift, near.j)
    pairs_after = pairs._replace(x=pairs.x + apart[:, 0], y=pairs.y + apart[:, 1])
    velocities_after = velocities - shear_rate * jnp.stack([y, jnp.zeros_like(y)], axis=-1)
    return Frame(displacements, frame.strain), velocities_after, pairs_after
