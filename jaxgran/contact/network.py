"""Contacts: the compact contact network of one step, and the rule that makes a pair a contact."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxgran.contact.law import gap_coefficients, overlaps_within, time_to_touch
from jaxgran.model.batches import equal_values
from jaxgran.model.grains import Grains
from jaxgran.model.indexing import taken


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Contacts:
    """The contact network of one step; unused slots have zero normals and zero inverse masses.

    ==============  =============  ====  ====================================================================
    field           shape          unit  meaning
    ==============  =============  ====  ====================================================================
    i, j            (contacts,)    –     grains in contact
    normals         (contacts, 2)  –     unit vectors n from grain j to grain i
    distances       (contacts,)    σ     distance of the centres
    approach        (contacts,)    σγ̇    relative normal velocity u⁻ before the step, negative if approaching
    inverse_mass_i  (contacts,)    1/m   1/m of grain i
    inverse_mass_j  (contacts,)    1/m   1/m of grain j
    used            (contacts,)    –     True where the slot holds a contact
    ==============  =============  ====  ====================================================================
    """

    i: Int[Array, " contacts"]
    j: Int[Array, " contacts"]
    normals: Float[Array, "contacts 2"]
    distances: Float[Array, " contacts"]
    approach: Float[Array, " contacts"]
    inverse_mass_i: Float[Array, " contacts"]
    inverse_mass_j: Float[Array, " contacts"]
    used: Bool[Array, " contacts"]

    __eq__ = equal_values


def is_contact(
    separations: Float[Array, "pairs 2"],
    velocities: Float[Array, "pairs 2"],
    reach: Float[Array, " pairs"],
    look_ahead: float | Array,
) -> tuple[Bool[Array, " pairs"], Bool[Array, " pairs"]]:
    """Which pairs are contacts, and which of them approach.

    A pair is a contact when free flight over the look-ahead time θ·dt makes it overlap. Along the flight
    f(t) = |s + u t|² − d² falls until the closest approach, so f is read at θ·dt or at the closest approach,
    whichever comes first; a receding pair is judged at θ·dt.

    Args:
      separations: (pairs, 2) in σ.
      velocities: relative velocities in the laboratory frame, (pairs, 2) in σγ̇.
      reach: sums of the radii, (pairs,).
      look_ahead: θ·dt.

    Examples:
      Discs of diameter one, a diameter apart, that close at unit speed:

      >>> apart, closing, reach = jnp.array([[2.0, 0.0]]), jnp.array([[-1.0, 0.0]]), jnp.array([1.0])
      >>> [bool(is_contact(apart, closing, reach, time)[0][0]) for time in (0.9, 1.1)]
      [False, True]
    """
    contact, approaching = overlaps_within(*_gaps(separations, velocities, reach), look_ahead)
    contact = contact & (reach > 0)
    return contact, contact & approaching


def first_contact_time(
    separations: Float[Array, "pairs 2"], velocities: Float[Array, "pairs 2"], reach: Float[Array, " pairs"]
) -> tuple[Float[Array, " pairs"], Float[Array, " pairs"]]:
    """Time at which free flight makes a pair touch, and time of its closest approach.

    The time is negative for an approaching pair that overlaps already and infinite for a pair that never touches.

    Examples:
      >>> time, closest = first_contact_time(jnp.array([[2.0, 0.0]]), jnp.array([[-1.0, 0.0]]), jnp.array([1.0]))
      >>> float(time[0]), float(closest[0])
      (1.0, 2.0)
    """
    return time_to_touch(*_gaps(separations, velocities, reach))


def _gaps(separations: Array, velocities: Array, reach: Array) -> tuple[Array, Array, Array]:
    return gap_coefficients(separations[:, 0], separations[:, 1], velocities[:, 0], velocities[:, 1], reach)


def contact_network(
    used: Bool[Array, " contacts"],
    i: Int[Array, " contacts"],
    j: Int[Array, " contacts"],
    separations: Float[Array, "contacts 2"],
    velocities: Float[Array, "contacts 2"],
    grains: Grains,
) -> Contacts:
    """The network of the pairs of grains i and j that are contacts (``used``), a slot for each pair."""
    distances = jnp.sqrt(_dot(separations, separations))
    normals = jnp.where(used, 1 / distances, 0)[:, None] * separations
    inverse_masses = 1 / grains.masses
    return Contacts(
        i=i,
        j=j,
        normals=normals,
        distances=distances,
        approach=_dot(normals, velocities),
        inverse_mass_i=jnp.where(used, taken(inverse_masses, i), 0),
        inverse_mass_j=jnp.where(used, taken(inverse_masses, j), 0),
        used=used,
    )


def _dot(a: Float[Array, "n 2"], b: Float[Array, "n 2"]) -> Float[Array, " n"]:
    """Scalar products, written out so that they fuse with what surrounds them."""
    return a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1]
