"""The Delassus operator W = H M⁻¹ Hᵀ of a contact network: its products, and diagonals to scale an
iteration by.

W of a network is never stored: Hᵀ gathers the impulses of the contacts on their grains, H reads the
relative normal velocities that follow. Two diagonals:

- ``diagonal``: W_cc = 1/m_i + 1/m_j, which scales residuals. As D of a projected method it is the
  classical choice; nothing bounds W by it, and the iteration diverges in networks.
- ``spectral_bound``, the D of the ``projected_methods``: λ(A_i)/m_i + λ(A_j)/m_j with λ(A_b) the
  largest eigenvalue of A_b = Σ n nᵀ over the contacts of grain b, a 2×2 matrix. For any vector x,
  xᵀWx = Σ_b |Σ_c ±n x_c|²/m_b ≤ Σ_b λ(A_b)/m_b Σ_{c∋b} x_c² = xᵀDx, so W ⪯ D.

An isolated pair has D = W in both.

A problem given by its matrix has the same functions. Its bounds know no grains, only the entries of
W. For any s > 0, 2 |x_c x_d| ≤ x_c² s_d/s_c + x_d² s_c/s_d, so the diagonal Σ_d |W_cd| s_d/s_c
bounds W (Gershgorin). With s_c = W_cc^-½ it is ``spectral_bound``.
"""

from collections.abc import Callable
from functools import singledispatch
from typing import Any

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from jaxgran.contact.law import largest_eigenvalue
from jaxgran.contact.network import Contacts
from jaxgran.contact.problem import DelassusProblem, is_sparse
from jaxgran.model.indexing import added_at, taken

Operator = Contacts | DelassusProblem  # what has the functions product, diagonal and bound


def grain_impulses(
    contacts: Contacts, impulses: Float[Array, " contacts"], grains: int
) -> Float[Array, "grains 2"]:
    """Total impulse Hᵀp on every grain."""
    along = contacts.normals * impulses[:, None]
    return _gathered(contacts, along, -along, grains)


def loads_of_grains(
    contacts: Contacts, impulses: Float[Array, " contacts"], grains: int
) -> tuple[Float[Array, "grains 2"], Float[Array, " grains"]]:
    """Total impulse on every grain, and how many of its contacts have one; one scatter costs less
    than two.
    """
    along, loaded = (
        contacts.normals * impulses[:, None],
        (impulses > 0).astype(impulses.dtype)[:, None],
    )
    # a product, not a negation: XLA compiles it to code that takes 0.65 to 0.8 of the time of a
    # step on a processor
    first, second = (jnp.concatenate([sign * along, loaded], axis=1) for sign in (1, -1))
    total = _gathered(contacts, first, second, grains)
    return total[:, :2], total[:, 2]


@singledispatch
def delassus_product(
    contacts: Contacts, impulses: Float[Array, " contacts"], grains: int
) -> Float[Array, " contacts"]:
    """Change W J of the relative normal velocities that the impulses cause."""
    total = grain_impulses(contacts, impulses, grains)
    change = taken(total, contacts.i) * contacts.inverse_mass_i[:, None]
    change -= taken(total, contacts.j) * contacts.inverse_mass_j[:, None]
    return jnp.sum(contacts.normals * change, axis=-1)


@singledispatch
def diagonal(contacts: Contacts, grains: int) -> Float[Array, " contacts"]:
    """Diagonal of W; one in unused slots, so that it can be divided by."""
    return jnp.where(contacts.used, contacts.inverse_mass_i + contacts.inverse_mass_j, 1)


@singledispatch
def spectral_bound(contacts: Contacts, grains: int) -> Float[Array, " contacts"]:
    """Diagonal D with W ⪯ D from the 2×2 matrices of the grains."""
    nx, ny = contacts.normals[:, 0], contacts.normals[:, 1]
    outer = jnp.stack([nx * nx, nx * ny, ny * ny], axis=-1)
    total = _gathered(contacts, outer, outer, grains)
    xx, xy, yy = total[:, 0], total[:, 1], total[:, 2]
    largest = largest_eigenvalue(xx, xy, yy)
    bound = (
        taken(largest, contacts.i) * contacts.inverse_mass_i
        + taken(largest, contacts.j) * contacts.inverse_mass_j
    )
    return jnp.where(contacts.used, bound, 1)


@delassus_product.register
def _(problem: DelassusProblem, impulses: Array, grains: int) -> Array:
    return _times(problem.matrix, impulses)


@diagonal.register
def _(problem: DelassusProblem, grains: int) -> Array:
    matrix = problem.matrix
    if is_sparse(matrix):
        rows, columns, values = _entries(matrix)
        entries_on_diagonal = _row_sums(matrix, jnp.where(rows == columns, values, 0))
    else:
        entries_on_diagonal = jnp.diagonal(matrix)
    return jnp.where(entries_on_diagonal > 0, entries_on_diagonal, 1)


@spectral_bound.register
def _(problem: DelassusProblem, grains: int) -> Array:
    root = jnp.sqrt(diagonal(problem, grains))
    bound = root * _times(_each(problem.matrix, jnp.abs), 1 / root)
    return jnp.where(bound > 0, bound, 1)


def _times(matrix: Any, vector: Array) -> Array:
    """Product with a dense or sparse matrix, in full precision on every backend."""
    if is_sparse(matrix):
        _, columns, values = _entries(matrix)
        return _row_sums(matrix, values * vector[columns])
    return jnp.matmul(matrix, vector, precision=lax.Precision.HIGHEST)


def _entries(matrix: Any) -> tuple[Array, Array, Array]:
    """Rows, columns and values of the stored entries of a sparse matrix."""
    return matrix.indices[:, 0], matrix.indices[:, 1], matrix.data


def _row_sums(matrix: Any, values: Array) -> Array:
    """Sums over the stored entries of each row, of one value for each entry."""
    return jnp.zeros(matrix.shape[0], values.dtype).at[matrix.indices[:, 0]].add(values)


def _each(matrix: Any, function: Callable[[Array], Array]) -> Any:
    """The matrix with a function of its entries in their place."""
    return (
        type(matrix)((function(matrix.data), matrix.indices), shape=matrix.shape)
        if is_sparse(matrix)
        else function(matrix)
    )


def _gathered(
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
