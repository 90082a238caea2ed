"""What a contact problem must be, judged where it is used; values that JAX traces pass, their
shapes do not.

Shapes are known even inside of ``jit``. Values are judged outside of it, where a mistake can be
said in a sentence. Inside, a solve ends with a status. "ok" then still means that the residual is
small, whatever the matrix is.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy  # its parts are loaded when they are used

from jaxgran.contact.problem import (
    ContactNetwork,
    ContactProblem,
    DelassusProblem,
    entries,
    is_sparse,
)
from jaxgran.model.checks import InputError, as_array, concrete_or_none, require, short_repr

LARGEST_FACTORED = (
    2048  # contacts of a matrix whose eigenvalues are judged; Cholesky's factor of it takes 0.1 s
)
_UNIT_LENGTH = (
    1e-5  # by which the length of a normal may differ from one; float32 and typed digits pass
)
_BATCH = "a batch of problems is solved by jax.vmap(jaxgran.solve_contacts)"
_FINITE = "finite numbers"


def check_problem(problem: Any) -> None:
    """Raise an InputError unless this is a contact problem whose shapes fit and whose values can
    be.

    See ``solve_contacts`` for what is checked.
    """
    if not isinstance(problem, ContactNetwork | DelassusProblem):
        raise InputError(
            f"problem must be a ContactNetwork or a DelassusProblem, not {short_repr(problem)}."
        )
    arrays = _as_arrays(problem)
    _require_network(arrays) if isinstance(arrays, ContactNetwork) else _require_delassus(arrays)


def as_problem(problem: ContactProblem) -> ContactProblem:
    """A contact problem that was checked, with all its numbers in one precision."""
    arrays = _as_arrays(problem)
    if isinstance(arrays, ContactNetwork):
        numbers = arrays.normals, arrays.masses, arrays.approach
        kind = _precision(*numbers)
        return ContactNetwork(
            jnp.asarray(arrays.ends, jnp.int32), *(jnp.asarray(x, kind) for x in numbers)
        )
    matrix, kind = arrays.matrix, _precision(arrays.matrix, arrays.approach)
    matrix_of_kind = matrix.astype(kind) if is_sparse(matrix) else jnp.asarray(matrix, kind)
    return DelassusProblem(matrix_of_kind, jnp.asarray(arrays.approach, kind))


def _as_arrays(problem: ContactProblem) -> ContactProblem:
    """The problem with arrays in place of lists."""
    if isinstance(problem, DelassusProblem):
        return DelassusProblem(as_array(problem.matrix), as_array(problem.approach))
    ends: Any = (
        np.asarray(problem.ends) if isinstance(problem.ends, (list, tuple)) else problem.ends
    )
    return ContactNetwork(ends, *map(as_array, (problem.normals, problem.masses, problem.approach)))


def require_impulses(problem: ContactProblem, impulses: Any) -> jax.Array:
    """The impulses in the precision of the problem; an InputError unless there is one for each
    contact.
    """
    impulses = as_array(impulses)
    _require_shape("impulses", impulses, problem.approach.shape, "a number for each contact")
    return jnp.asarray(impulses, problem.approach.dtype)


def _require_network(network: ContactNetwork) -> None:
    count = _contacts(network)
    _require_shape("ends", network.ends, (count, 2), "two grains for each contact")
    _require_shape("normals", network.normals, (count, 2), "a unit vector for each contact")
    if np.ndim(network.masses) != 1 or np.size(network.masses) == 0:
        raise InputError(
            f"masses must be an array (grains,), not of the shape {np.shape(network.masses)}; "
            f"{_BATCH}."
        )
    grains = np.shape(network.masses)[0]
    if not np.issubdtype(network.ends.dtype, np.integer):
        raise InputError(f"ends must be whole numbers, not of the type {network.ends.dtype}.")
    require(
        "ends",
        network.ends,
        lambda x: (x >= 0) & (x < grains),
        f"numbers of grains, 0 to {grains - 1}",
    )
    require("masses", network.masses, lambda x: x > 0, "positive, or infinite for a wall")
    require("approach", network.approach, np.isfinite, _FINITE)
    require("normals", network.normals, np.isfinite, _FINITE)
    ends, normals, masses = (
        concrete_or_none(network.ends),
        concrete_or_none(network.normals),
        concrete_or_none(network.masses),
    )
    if normals is None:
        return
    lengths = np.linalg.norm(normals, axis=1)
    wrong = (lengths != 0) & (np.abs(lengths - 1) > _UNIT_LENGTH)
    if np.any(wrong):
        raise InputError(
            f"normals must be unit vectors, and that of contact {np.argmax(wrong)} has the length "
            f"{lengths[np.argmax(wrong)]:.6g}: divide it by its length."
        )
    if ends is None:
        return
    same_grain = (lengths > 0) & (ends[:, 0] == ends[:, 1])
    if np.any(same_grain):
        raise InputError(
            f"ends must be two different grains, and contact {np.argmax(same_grain)} has one grain "
            "twice."
        )
    if masses is not None and np.any(
        held := (lengths > 0) & np.all(np.isinf(masses[ends]), axis=1)
    ):
        raise InputError(
            f"contact {np.argmax(held)} joins two walls, which no impulse moves: leave it out."
        )


def _require_delassus(problem: DelassusProblem) -> None:
    count, matrix = _contacts(problem), problem.matrix
    _require_shape("matrix", matrix, (count, count), "a row and a column for each contact")
    if is_sparse(matrix):
        if matrix.n_batch or matrix.n_dense:
            raise InputError(
                "a sparse matrix must have neither batch nor dense dimensions: use "
                "BCOO.fromdense(matrix)."
            )
        if matrix.nse == 0:
            raise InputError(
                "matrix must have entries: a contact has a positive one on the diagonal."
            )
        require("matrix", matrix.data, np.isfinite, _FINITE)
    else:
        require("matrix", matrix, np.isfinite, _FINITE)
    require("approach", problem.approach, np.isfinite, _FINITE)
    values = _known_matrix(matrix)
    if values is not None:
        _require_definite(values)


def _require_definite(matrix: Any) -> None:
    """Symmetric, with a positive diagonal and no negative eigenvalue, all to rounding."""
    epsilon = float(np.finfo(matrix.dtype).eps) if matrix.dtype.kind == "f" else 0.0
    on_diagonal = matrix.diagonal()
    if not np.all(on_diagonal > 0):
        at = int(np.argmin(on_diagonal))
        raise InputError(
            f"matrix must have a positive diagonal, and entry {at} of it is {on_diagonal[at]:.6g}."
        )
    root = np.sqrt(on_diagonal.astype(float))
    scaled = (
        matrix / root[:, None] / root
        if isinstance(matrix, np.ndarray)
        else _scaled(matrix, 1 / root)
    )
    uneven, largest = abs(scaled - scaled.T).max(), abs(scaled).max()
    if uneven > np.sqrt(epsilon):
        raise InputError(
            "matrix must be symmetric, and entries differ from their mirror images by up to "
            f"{uneven:.2g} of the "
            "diagonal: give (W + W.T) / 2 if that is rounding."
        )
    slack = 16 * len(on_diagonal) * epsilon
    if largest > 1 + slack or (
        len(on_diagonal) <= LARGEST_FACTORED and not _is_definite(scaled, slack)
    ):
        raise InputError(
            "matrix must have no negative eigenvalue, as W = H M⁻¹ Hᵀ has none, and this one has."
        )


def _is_definite(scaled: Any, slack: float) -> bool:
    dense = scaled if isinstance(scaled, np.ndarray) else scaled.toarray()
    try:
        np.linalg.cholesky(np.asarray(dense, float) + slack * np.eye(len(dense)))
    except np.linalg.LinAlgError:
        return False
    return True


def _scaled(matrix: Any, factors: np.ndarray) -> Any:
    diagonal = scipy.sparse.diags_array(factors)
    return (diagonal @ matrix @ diagonal).tocsr()


def _known_matrix(matrix: Any) -> Any:
    """The matrix as an array of NumPy or a sparse one of SciPy; None while JAX traces it."""
    if not is_sparse(matrix):
        return concrete_or_none(matrix)
    rows, columns, values = (concrete_or_none(x) for x in entries(matrix))
    if rows is None or columns is None or values is None:
        return None
    inside = (rows < matrix.shape[0]) & (
        columns < matrix.shape[1]
    )  # a BCOO is padded with indices outside of it
    return scipy.sparse.coo_array(
        (values[inside], (rows[inside], columns[inside])), shape=matrix.shape
    ).tocsr()


def _contacts(problem: ContactProblem) -> int:
    shape = np.shape(problem.approach) if hasattr(problem.approach, "dtype") else None
    if shape is None or len(shape) != 1:
        raise InputError(
            f"approach must be an array (contacts,), not {_described(problem.approach)}; {_BATCH}."
        )
    if shape == (0,):
        raise InputError(
            "approach must have a number for at least one contact: this problem has none to solve."
        )
    return shape[0]


def _require_shape(name: str, value: Any, shape: tuple[int, ...], words: str) -> None:
    if not hasattr(value, "dtype") or np.shape(value) != shape:
        raise InputError(
            f"{name} must be an array {shape}, {words}, not {_described(value)}; {_BATCH}."
        )


def _described(value: Any) -> str:
    return (
        f"of the shape {tuple(np.shape(value))}" if hasattr(value, "dtype") else short_repr(value)
    )


def _precision(*values: Any) -> Any:
    """The widest type of the values that is one of floating point."""
    kind = np.result_type(*(value.dtype for value in values))
    return jax.dtypes.canonicalize_dtype(kind if jnp.issubdtype(kind, jnp.floating) else np.float64)
