"""Contact problems of any origin, which ``solve_contacts`` takes: a network of discs, or a Delassus
matrix.

They are checked where they are used, not when they are made, so that JAX may fill them with
whatever it needs. Shapes are checked even where JAX traces the values. Values that are traced pass,
and end in a status: "ok" then still means that the residual is small, whatever the matrix is.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy  # its parts are loaded when they are used
from jax import lax
from jaxtyping import Array, Float, Int

from jaxgran.contact.delassus import NetworkOperator
from jaxgran.contact.network import Contacts
from jaxgran.model.checks import (
    InputError,
    as_array,
    concrete_or_none,
    refused,
    require,
    short_repr,
)
from jaxgran.model.values import Value

LARGEST_FACTORED = 2048  # contacts of a matrix whose eigenvalues are checked, which takes 0.1 s
_UNIT_LENGTH = 1e-5  # error of the length of a normal; float32 and typed digits pass
_BATCH = "jax.vmap applies to a batch of problems, as jax.vmap(jaxgran.solve_contacts)"


@dataclass(frozen=True, eq=False, repr=False)
class ContactNetwork(Value):
    """A contact problem given by its geometry: frictionless contacts of grains that do not rotate.

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

    def __post_init__(self) -> None:
        listed = isinstance(self.ends, (list, tuple))  # whose numbers stay whole
        object.__setattr__(self, "ends", as_array(np.asarray(self.ends) if listed else self.ends))
        _lists_as_arrays(self, "normals", "masses", "approach")

    def operator(self) -> NetworkOperator:
        """The Delassus operator of the network, with u⁻; distances, which no impulse depends on,
        are one.
        """
        used = jnp.any(self.normals != 0, axis=-1)
        (i, j), inverse = jnp.asarray(self.ends, jnp.int32).T, 1 / self.masses
        contacts = Contacts(
            i=i,
            j=j,
            normals=self.normals,
            distances=jnp.ones_like(self.approach),
            approach=jnp.where(used, self.approach, 0),
            inverse_mass_i=jnp.where(used, inverse[i], 0),
            inverse_mass_j=jnp.where(used, inverse[j], 0),
            used=used,
        )
        return NetworkOperator(contacts, self.masses.size)


@dataclass(frozen=True, eq=False, repr=False)
class DelassusProblem(Value):
    """A contact problem given by its Delassus matrix, for any mechanical system without friction.

    ========  ====================  ====  ==========================================================
    field     shape                 unit  meaning
    ========  ====================  ====  ==========================================================
    matrix    (contacts, contacts)  1/m   W = H M⁻¹ Hᵀ, symmetric, without negative eigenvalues; a
                                          dense array, a matrix of ``scipy.sparse`` or a ``BCOO`` of
                                          ``jax.experimental.sparse``
    approach  (contacts,)           σγ̇    relative normal velocity u⁻ before, negative if
                                          approaching
    ========  ====================  ====  ==========================================================

    A matrix of ``scipy.sparse`` becomes a ``BCOO``. Rows of the unit matrix with u⁻ = 0 fill up
    problems to a common size. A batch has a leading axis, which is a batch dimension of a ``BCOO``,
    and is solved by ``jax.vmap``. Derivatives are those along symmetric changes of the matrix.

    The bound D of W knows no grains, only the entries of W. For any s > 0, 2 |x_c x_d| ≤ x_c²
    s_d/s_c + x_d² s_c/s_d, so the diagonal Σ_d |W_cd| s_d/s_c bounds W (Gershgorin). With s_c =
    W_cc^-½ it is ``spectral_bound``.
    """

    matrix: Any
    approach: Float[Array, " contacts"]

    def __post_init__(self) -> None:
        if hasattr(self.matrix, "tocoo"):  # a matrix of SciPy is no array for JAX
            from jax.experimental.sparse import BCOO

            object.__setattr__(self, "matrix", BCOO.from_scipy_sparse(self.matrix))
        _lists_as_arrays(self, "matrix", "approach")

    def operator(self) -> "DelassusProblem":
        """Itself: it has the methods of a ``DelassusOperator``."""
        return self

    def product(self, impulses: Float[Array, " contacts"]) -> Float[Array, " contacts"]:
        """W J, in full precision on every backend."""
        matrix = self.matrix
        if _is_sparse(matrix):
            return self._row_sums(matrix.data * impulses[matrix.indices[:, 1]])
        return jnp.matmul(matrix, impulses, precision=lax.Precision.HIGHEST)

    def diagonal(self) -> Float[Array, " contacts"]:
        """Diagonal of W; one where it is not positive."""
        matrix = self.matrix
        if _is_sparse(matrix):
            rows, columns = matrix.indices[:, 0], matrix.indices[:, 1]
            entries = self._row_sums(jnp.where(rows == columns, matrix.data, 0))
        else:
            entries = jnp.diagonal(matrix)
        return jnp.where(entries > 0, entries, 1)

    def spectral_bound(self) -> Float[Array, " contacts"]:
        """Diagonal D with W ⪯ D."""
        root = jnp.sqrt(self.diagonal())
        bound = root * replace(self, matrix=abs(self.matrix)).product(1 / root)
        return jnp.where(bound > 0, bound, 1)

    def _row_sums(self, values: Array) -> Float[Array, " contacts"]:
        """Sums over the stored entries of each row of a sparse matrix, of one value an entry."""
        zeros = jnp.zeros(self.matrix.shape[0], values.dtype)
        return zeros.at[self.matrix.indices[:, 0]].add(values)


ContactProblem = ContactNetwork | DelassusProblem


def _lists_as_arrays(problem: Any, *names: str) -> None:
    for name in names:
        object.__setattr__(problem, name, as_array(getattr(problem, name)))


def _is_sparse(matrix: Any) -> bool:
    """Whether this is a ``BCOO``, told without importing what is slow to import."""
    return hasattr(matrix, "indices") and hasattr(matrix, "data")


def as_problem(problem: ContactProblem) -> ContactProblem:
    """A contact problem that was checked, with all its numbers in one precision."""
    names = ("normals", "masses") if isinstance(problem, ContactNetwork) else ("matrix",)
    numbers = {name: getattr(problem, name) for name in (*names, "approach")}
    common = np.result_type(*(x.dtype for x in numbers.values()))
    if common.itemsize < 4 and jnp.issubdtype(common, jnp.floating):  # half precision
        common = np.dtype(np.float32)
    dtype = jax.dtypes.canonicalize_dtype(common if common == np.float32 else np.float64)
    return replace(problem, **{name: x.astype(dtype) for name, x in numbers.items()})


def check_problem(problem: Any) -> None:
    """Raise an InputError unless this is a contact problem whose shapes and values can be.

    See ``solve_contacts`` for what is checked.
    """
    if not isinstance(problem, ContactNetwork | DelassusProblem):
        raise refused("problem", problem, "must be a ContactNetwork or a DelassusProblem")
    if np.shape(problem.approach) == (0,):
        raise InputError(
            "approach must have a number for at least one contact: this problem has none to solve."
        )
    contacts = _length("approach", problem.approach, "contacts")
    if isinstance(problem, ContactNetwork):
        _check_network(problem, contacts)
    else:
        _check_delassus(problem, contacts)
    require("approach", problem.approach, np.isfinite, "finite numbers")


def _check_network(network: ContactNetwork, contacts: int) -> None:
    require_shape("ends", network.ends, (contacts, 2), "two grains for each contact")
    require_shape("normals", network.normals, (contacts, 2), "a unit vector for each contact")
    grains = _length("masses", network.masses, "grains")
    if not np.issubdtype(network.ends.dtype, np.integer):
        raise InputError(f"ends must be whole numbers, not of the type {network.ends.dtype}.")
    numbers = f"numbers of grains, 0 to {grains - 1}"
    require("ends", network.ends, lambda x: (x >= 0) & (x < grains), numbers)
    require("masses", network.masses, lambda x: x > 0, "positive, or infinite for a wall")
    require("normals", network.normals, np.isfinite, "finite numbers")

    ends, normals, masses = map(concrete_or_none, (network.ends, network.normals, network.masses))
    if normals is None:
        return
    lengths = np.linalg.norm(normals, axis=1)
    used = lengths > 0
    _refuse_contact(
        used & (np.abs(lengths - 1) > _UNIT_LENGTH),
        lambda k: (
            f"normals must be unit vectors, and that of contact {k} has the length "
            f"{lengths[k]:.6g}: divide it by its length."
        ),
    )
    if ends is None:
        return
    _refuse_contact(
        used & (ends[:, 0] == ends[:, 1]),
        lambda k: f"ends must be two different grains, and contact {k} has one grain twice.",
    )
    if masses is None:
        return
    _refuse_contact(
        used & np.all(np.isinf(masses[ends]), axis=1),
        lambda k: f"contact {k} joins two walls, which no impulse moves: leave it out.",
    )


def _refuse_contact(wrong: np.ndarray, message: Callable[[int], str]) -> None:
    """Raise an InputError about the first contact with which something is wrong."""
    if np.any(wrong):
        raise InputError(message(int(np.argmax(wrong))))


def _check_delassus(problem: DelassusProblem, contacts: int) -> None:
    matrix: Any = problem.matrix
    require_shape("matrix", matrix, (contacts, contacts), "a row and a column for each contact")
    sparse = _is_sparse(matrix)
    if sparse and (matrix.n_batch or matrix.n_dense):
        raise InputError(
            "a sparse matrix must have neither batch nor dense dimensions: use "
            "BCOO.fromdense(matrix)."
        )
    if sparse and matrix.nse == 0:
        raise InputError("matrix must have entries: a contact has a positive one on the diagonal.")
    require("matrix", matrix.data if sparse else matrix, np.isfinite, "finite numbers")
    known = _known_sparse(matrix) if sparse else concrete_or_none(matrix)
    if known is not None:
        _check_definite(known)


def _known_sparse(matrix: Any) -> Any:
    """A ``BCOO`` as a matrix of SciPy; None while JAX traces it."""
    values, indices = concrete_or_none(matrix.data), concrete_or_none(matrix.indices)
    if values is None or indices is None:
        return None
    inside = np.all(indices < matrix.shape, axis=1)  # a BCOO is padded with indices outside of it
    coordinates = tuple(indices[inside].T)
    return scipy.sparse.coo_array((values[inside], coordinates), shape=matrix.shape).tocsr()


def _check_definite(matrix: Any) -> None:
    """Symmetric, with a positive diagonal and no negative eigenvalue, all to rounding; the matrix
    is one of NumPy or SciPy.
    """
    diagonal = matrix.diagonal()
    if not np.all(diagonal > 0):
        at = int(np.argmin(diagonal))
        raise InputError(
            f"matrix must have a positive diagonal, and entry {at} of it is {diagonal[at]:.6g}."
        )
    epsilon = float(np.finfo(matrix.dtype).eps) if matrix.dtype.kind == "f" else 0.0
    root = np.sqrt(diagonal.astype(float))
    scaled = matrix / root[:, None] / root
    uneven = abs(scaled - scaled.T).max()
    if uneven > np.sqrt(epsilon):
        raise InputError(
            "matrix must be symmetric, and entries differ from their mirror images by up to "
            f"{uneven:.2g} of the diagonal: give (W + W.T) / 2 if that is rounding."
        )
    slack = 16 * len(diagonal) * epsilon
    small = len(diagonal) <= LARGEST_FACTORED
    if abs(scaled).max() > 1 + slack or (small and not _is_definite(scaled, slack)):
        raise InputError(
            "matrix must have no negative eigenvalue, as W = H M⁻¹ Hᵀ has none, and this one has."
        )


def _is_definite(scaled: Any, slack: float) -> bool:
    dense = scaled.toarray() if scipy.sparse.issparse(scaled) else scaled
    try:
        np.linalg.cholesky(dense + slack * np.eye(len(dense)))
    except np.linalg.LinAlgError:
        return False
    return True


def _length(name: str, value: Any, axis: str) -> int:
    shape = np.shape(value) if hasattr(value, "dtype") else ()
    if len(shape) != 1 or shape == (0,):
        raise InputError(f"{name} must be an array ({axis},), not {_described(value)}; {_BATCH}.")
    return shape[0]


def require_shape(name: str, value: Any, shape: tuple[int, ...], words: str) -> None:
    """Raise an InputError unless the value is an array of this shape, which holds ``words``."""
    if not hasattr(value, "dtype") or np.shape(value) != shape:
        raise InputError(
            f"{name} must be an array {shape}, {words}, not {_described(value)}; {_BATCH}."
        )


def _described(value: Any) -> str:
    return f"of the shape {np.shape(value)}" if hasattr(value, "dtype") else short_repr(value)
