"""Contacts: the compact contact network of one step, and the rule that makes a pair a contact."""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxgran.contact.compaction import bit_positions
from jaxgran.contact.law import gap_coefficients, gap_discriminant, touching_time
from jaxgran.model.cell import relative_velocity
from jaxgran.model.grains import Grains
from jaxgran.model.indexing import taken
from jaxgran.model.values import Value

# In all over the number of grains: contacts of discs in a periodic cell form a graph on a torus
MOST_CONTACTS = 3


@dataclass(frozen=True, eq=False, repr=False)
class Contacts(Value):
    """The contact network of one step; unused slots have zero normals and zero inverse masses.

    ==============  =============  ====  ===========================================================
    field           shape          unit  meaning
    ==============  =============  ====  ===========================================================
    i, j            (contacts,)    –     grains in contact
    normals         (contacts, 2)  –     unit vectors n from grain j to grain i
    distances       (contacts,)    σ     distance of the centres
    approach        (contacts,)    σγ̇    relative normal velocity u⁻ before the step, negative if
                                         approaching
    inverse_mass_i  (contacts,)    1/m   1/m of grain i
    inverse_mass_j  (contacts,)    1/m   1/m of grain j
    used            (contacts,)    –     True where the slot holds a contact
    ==============  =============  ====  ===========================================================
    """

    i: Int[Array, " contacts"]
    j: Int[Array, " contacts"]
    normals: Float[Array, "contacts 2"]
    distances: Float[Array, " contacts"]
    approach: Float[Array, " contacts"]
    inverse_mass_i: Float[Array, " contacts"]
    inverse_mass_j: Float[Array, " contacts"]
    used: Bool[Array, " contacts"]


class PairMotion(NamedTuple):
    """Separations r_i − r_j of pairs in σ, and relative velocities in the laboratory frame in σγ̇,
    (pairs,) each.

    Each component is an array of its own, which XLA vectorises.
    """

    x: Float[Array, " pairs"]
    y: Float[Array, " pairs"]
    ux: Float[Array, " pairs"]
    uy: Float[Array, " pairs"]

    def moved(self, time: Array) -> "PairMotion":
        """The pairs after free flight for a time."""
        return self._replace(x=self.x + time * self.ux, y=self.y + time * self.uy)


def pair_motion(
    i: Int[Array, " pairs"],
    j: Int[Array, " pairs"],
    separations: Float[Array, "pairs 2"],
    velocities: Float[Array, "grains 2"],
    shear_rate: float | Array,
) -> PairMotion:
    """How pairs of grains i and j with these separations move, from the peculiar velocities of the
    grains.
    """
    u = relative_velocity(velocities, i, j, separations, shear_rate)
    return PairMotion(separations[:, 0], separations[:, 1], u[:, 0], u[:, 1])


def is_contact(
    pairs: PairMotion, reach: Float[Array, " pairs"], look_ahead: float | Array
) -> tuple[Bool[Array, " pairs"], Bool[Array, " pairs"]]:
    """The activation rule: which pairs are contacts, and which of them approach.

    A pair is a contact when free flight over the look-ahead time θ·dt makes it overlap. Along the
    flight f(t) = |s + u t|² − d² falls until the closest approach, so f is read at θ·dt or at the
    closest approach, whichever comes first; a receding pair is judged at θ·dt.

    Args:
      pairs: how the pairs move.
      reach: sums of the radii, (pairs,) in σ; 0 in an empty slot.
      look_ahead: θ·dt.

    Examples:
      Discs of diameter one, a diameter apart, that close at unit speed:

      >>> pairs = PairMotion(jnp.array([2.0]), jnp.zeros(1), jnp.array([-1.0]), jnp.zeros(1))
      >>> [bool(is_contact(pairs, jnp.array([1.0]), time)[0][0]) for time in (0.9, 1.1)]
      [False, True]
    """
    squared_speed, closing, excess = gap_coefficients(*pairs, reach)
    approaching = closing < 0
    closest = -closing / jnp.where(approaching, squared_speed, 1)
    is_sooner = approaching & (-closing < squared_speed * look_ahead)
    time = jnp.where(is_sooner, closest, look_ahead)
    overlaps = excess + time * (2 * closing + time * squared_speed) <= 0
    contact = overlaps & (reach > 0)
    return contact, contact & approaching


def first_contact_time(
    pairs: PairMotion, reach: Float[Array, " pairs"]
) -> tuple[Float[Array, " pairs"], Float[Array, " pairs"]]:
    """Time at which free flight makes a pair touch, and time of its closest approach.

    The time is negative for an approaching pair that overlaps already and infinite for a pair that
    never touches.

    Examples:
      >>> pairs = PairMotion(jnp.array([2.0]), jnp.zeros(1), jnp.array([-1.0]), jnp.zeros(1))
      >>> time, closest = first_contact_time(pairs, jnp.array([1.0]))
      >>> float(time[0]), float(closest[0])
      (1.0, 2.0)
    """
    squared_speed, closing, excess = gap_coefficients(*pairs, reach)
    discriminant = gap_discriminant(squared_speed, closing, excess)
    touches = (closing < 0) & (discriminant >= 0)
    root = jnp.sqrt(jnp.where(touches, discriminant, 1))
    time = touching_time(jnp.where(touches, closing, 0), excess, root)
    closest = -closing / jnp.where(closing < 0, squared_speed, 1)
    return jnp.where(touches, time, jnp.inf), closest


class ContactPairs(NamedTuple):
    """The pairs of a list, (pairs,) each, and which of them are contacts; or a buffer of contacts
    that are compacted from such a list.

    ======  ==========  ====  ===============================
    field   shape       unit  meaning
    ======  ==========  ====  ===============================
    i, j    (pairs,)    –     grains of the pair
    reach   (pairs,)    σ     sum of the radii
    motion  PairMotion  –     how the pairs move
    used    (pairs,)    –     True where the pair is a contact
    ======  ==========  ====  ===============================
    """

    i: Int[Array, " pairs"]
    j: Int[Array, " pairs"]
    reach: Float[Array, " pairs"]
    motion: PairMotion
    used: Bool[Array, " pairs"]

    def compacted(self, size: int, words: Array) -> "ContactPairs":
        """The first contacts in a buffer of a size; ``words`` is ``pack_bits(used)``."""
        pairs = self.used.size
        position = bit_positions(words, size, pairs)
        used = position < pairs
        index = jnp.where(used, position, 0)
        i, j, reach, motion = jax.tree.map(lambda x: taken(x, index), self[:-1])
        return ContactPairs(i, j, reach, motion, used)

    def network(self, grains: Grains) -> Contacts:
        """The contact network, with a slot for each pair."""
        pairs, used = self.motion, self.used
        distances = jnp.sqrt(pairs.x * pairs.x + pairs.y * pairs.y)
        inverse_distances, inverse_masses = jnp.where(used, 1 / distances, 0), 1 / grains.masses
        nx, ny = inverse_distances * pairs.x, inverse_distances * pairs.y
        return Contacts(
            i=self.i,
            j=self.j,
            normals=jnp.stack([nx, ny], axis=-1),
            distances=distances,
            approach=nx * pairs.ux + ny * pairs.uy,
            inverse_mass_i=jnp.where(used, taken(inverse_masses, self.i), 0),
            inverse_mass_j=jnp.where(used, taken(inverse_masses, self.j), 0),
            used=used,
        )
