"""Contact problems of any origin: a network of discs, or a Delassus matrix.

Both are what ``solve_contacts`` takes. Neither is checked when it is made, so that JAX may fill
them with whatever it needs; ``problem_checks`` judges them where they are used.
"""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxgran.contact.network import Contacts
from jaxgran.model.batches import equal_values


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ContactNetwork:
    """Frictionless contacts of grains that do not rotate: a contact problem by its geometry.

    ========  =============  ====  =================================================================
    field     shape          unit  meaning
    ========  =============  ====  =================================================================
    ends      (contacts, 2)  –     numbers i and j of the two grains
    normals   (contacts, 2)  –     unit vectors n from grain j to grain i; zero in a slot that is
                                   not used
    masses    (grains,)      m     masses of the grains, infinite for a wall
    approach  (contacts,)    σγ̇    relative normal velocity u⁻ = n·(v_i − v_j) before, negative if
                                   approaching
    ========  =============  ====  =================================================================

    A batch has a leading axis in every field and is solved by ``jax.vmap``. Slots with zero normals
    fill up networks to a common size; their impulses are zero.

    Examples:
      A disc hits a row of two that touch:

      >>> network = ContactNetwork(
      ...     ends=jnp.array([[1, 0], [2, 1]]),
      ...     normals=jnp.array([[1.0, 0.0], [1.0, 0.0]]),
      ...     masses=jnp.ones(3),
      ...     approach=jnp.array([-1.0, 0.0]),
      ... )
    """

    ends: Int[Array, "contacts 2"]
    normals: Float[Array, "contacts 2"]
    masses: Float[Array, " grains"]
    approach: Float[Array, " contacts"]

    __eq__ = equal_values


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class DelassusProblem:
    """A contact problem by its Delassus matrix, which any mechanical system without friction has.

    ========  ====================  ====  ==========================================================
    field     shape                 unit  meaning
    ========  ====================  ====  ==========================================================
    matrix    (contacts, contacts)  1/m   W = H M⁻¹ Hᵀ, symmetric, without negative eigenvalues; a
                                          dense array, a
                                          matrix of ``scipy.sparse`` or a ``BCOO`` of
                                          ``jax.experimental.sparse``
    approach  (contacts,)           σγ̇    relative normal velocity u⁻ before, negative if
                                          approaching
    ========  ====================  ====  ==========================================================

    A matrix of ``scipy.sparse`` becomes a ``BCOO``. Rows of the unit matrix with u⁻ = 0 fill up
    problems to a common size. A batch has a leading axis, which is a batch dimension of a ``BCOO``,
    and is solved by ``jax.vmap``. Derivatives are those along symmetric changes of the matrix.
    """

    matrix: Any
    approach: Float[Array, " contacts"]

    __eq__ = equal_values

    def __post_init__(self) -> None:
        if hasattr(self.matrix, "tocoo"):  # a matrix of SciPy is no array for JAX
            from jax.experimental.sparse import BCOO

            object.__setattr__(self, "matrix", BCOO.from_scipy_sparse(self.matrix))


ContactProblem = ContactNetwork | DelassusProblem


def entries(matrix: Any) -> tuple[Array, Array, Array]:
    """Rows, columns and values of the stored entries of a sparse matrix."""
    return matrix.indices[:, 0], matrix.indices[:, 1], matrix.data


def is_sparse(matrix: Any) -> bool:
    """Whether this is a ``BCOO``, told without importing what is slow to import."""
    return hasattr(matrix, "indices") and hasattr(matrix, "data")


def as_contacts(network: ContactNetwork) -> Contacts:
    """The same network as the engines hold it; distances, which no impulse depends on, are one."""
    used = jnp.any(network.normals != 0, axis=-1)
    (i, j), inverse = jnp.asarray(network.ends, jnp.int32).T, 1 / network.masses
    return Contacts(
        i=i,
        j=j,
        normals=network.normals,
        distances=jnp.ones_like(network.approach),
        approach=jnp.where(used, network.approach, 0),
        inverse_mass_i=jnp.where(used, inverse[i], 0),
        inverse_mass_j=jnp.where(used, inverse[j], 0),
        used=used,
    )
