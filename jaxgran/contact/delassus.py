"""The Delassus operator W = H M⁻¹ Hᵀ of a contact problem: its products, and diagonals to scale an
iteration by.

W of a network is never stored: Hᵀ gathers the impulses of the contacts on their grains, H reads the
relative normal velocities that follow. Two diagonals:

- ``diagonal``: W_cc = 1/m_i + 1/m_j, which scales residuals. As D of a projected method it is the
  classical choice; nothing bounds W by it, and the iteration diverges in networks.
- ``spectral_bound``, the D of the ``projected_methods``: λ(A_i)/m_i + λ(A_j)/m_j with λ(A_b) the
  largest eigenvalue of A_b = Σ n nᵀ over the contacts of grain b, a 2×2 matrix. For any vector x,
  xᵀWx = Σ_b |Σ_c ±n x_c|²/m_b ≤ Σ_b λ(A_b)/m_b Σ_{c∋b} x_c² = xᵀDx, so W ⪯ D.

An isolated pair has D = W in both. A problem given by its matrix has the same methods, see
``problem.DelassusProblem``.
"""

from dataclasses import dataclass, field
from typing import Protocol

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxgran.contact.law import largest_eigenvalue
from jaxgran.contact.network import Contacts
from jaxgran.model.indexing import added_at, taken


class DelassusOperator(Protocol):
    """What a solver knows of a contact problem: W by its products and diagonals, and u⁻."""

    @property
    def approach(self) -> Float[Array, " contacts"]:
        """Relative normal velocities u⁻ before the impulses."""
        ...

    def product(self, impulses: Float[Array, " contacts"]) -> Float[Array, " contacts"]:
        """Change W J of the relative normal velocities that the impulses cause."""
        ...

    def diagonal(self) -> Float[Array, " contacts"]:
        """Diagonal of W; one where it is zero, so that it can be divided by."""
        ...

    def spectral_bound(self) -> Float[Array, " contacts"]:
        """Diagonal D of positive numbers with W ⪯ D."""
        ...


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class NetworkOperator:
    """The Delassus operator of a contact network between a number of grains, which is static."""

    contacts: Contacts
    grains: int = field(metadata={"static": True})

    @property
    def approach(self) -> Float[Array, " contacts"]:
        return self.contacts.approach

    def product(self, impulses: Float[Array, " contacts"]) -> Float[Array, " contacts"]:
        contacts = self.contacts
        total = grain_impulses(contacts, impulses, self.grains)
        change = taken(total, contacts.i) * contacts.inverse_mass_i[:, None]
        change -= taken(total, contacts.j) * contacts.inverse_mass_j[:, None]
        return jnp.sum(contacts.normals * change, axis=-1)

    def diagonal(self) -> Float[Array, " contacts"]:
        inverse_mass = self.contacts.inverse_mass_i + self.contacts.inverse_mass_j
        return jnp.where(self.contacts.used, inverse_mass, 1)

    def spectral_bound(self) -> Float[Array, " contacts"]:
        contacts = self.contacts
        nx, ny = contacts.normals[:, 0], contacts.normals[:, 1]
        outer = jnp.stack([nx * nx, nx * ny, ny * ny], axis=-1)
        total = _sums_of_grains(contacts, outer, outer, self.grains)
        largest = largest_eigenvalue(total[:, 0], total[:, 1], total[:, 2])
        at_i = taken(largest, contacts.i) * contacts.inverse_mass_i
        at_j = taken(largest, contacts.j) * contacts.inverse_mass_j
        return jnp.where(contacts.used, at_i + at_j, 1)


def grain_impulses(
    contacts: Contacts, impulses: Float[Array, " contacts"], grains: int
) -> Float[Array, "grains 2"]:
    """Total impulse Hᵀ J on every grain."""
    along = contacts.normals * impulses[:, None]
    return _sums_of_grains(contacts, along, -along, grains)


def loads_of_grains(
    contacts: Contacts, impulses: Float[Array, " contacts"], grains: int
) -> tuple[Float[Array, "grains 2"], Float[Array, " grains"]]:
    """Total impulse on every grain, and how many of its contacts have one; one scatter costs less
    than two.
    """
    along = contacts.normals * impulses[:, None]
    loaded = (impulses > 0).astype(impulses.dtype)[:, None]
    # a product, not a negation: XLA compiles it to code that takes 0.65 to 0.8 of the time of a
    # step on a processor
    at_i, at_j = (jnp.concatenate([sign * along, loaded], axis=1) for sign in (1, -1))
    total = _sums_of_grains(contacts, at_i, at_j, grains)
    return total[:, :2], total[:, 2]


def _sums_of_grains(
    contacts: Contacts,
    at_i: Float[Array, "contacts k"],
    at_j: Float[Array, "contacts k"],
    grains: int,
) -> Float[Array, "grains k"]:
    """Sums over the contacts of every grain: one scatter over all ends costs less than one for
    each.
    """
    ends: Int[Array, " two_contacts"] = jnp.concatenate([contacts.i, contacts.j])
    total = jnp.zeros((grains, at_i.shape[1]), at_i.dtype)
    return added_at(total, ends, jnp.concatenate([at_i, at_j]))
