"""The contact problem as others pose it: a quadratic program.

0 ≤ J ⟂ W J + u⁻ ≥ 0 with W = G Gᵀ and G = H M^-½ is the condition of optimality of

    minimise ½ Jᵀ W J + J·u⁻ subject to J ≥ 0.

All speeds are divided by ‖min(u⁻, 0)‖, since the tolerances of the packages are absolute.
"""

from typing import NamedTuple

import numpy as np
from scipy.sparse import csc_matrix, diags_array, sparray

from benchmarks.collection import Entry
from benchmarks.collection.certificates import incidence


class Program(NamedTuple):
    """minimise ½ xᵀ P x + q·x subject to x ≥ 0, ``count`` unknowns; impulses are ``scale`` times
    the unknowns.
    """

    p: csc_matrix
    q: np.ndarray
    scale: float
    count: int


def program_of(entry: Entry) -> Program:
    """The quadratic program of a contact problem."""
    rates, scale = scaled(entry)
    return Program(columns(entry.matrix), rates, scale, len(rates))


def scaled(entry: Entry) -> tuple[np.ndarray, float]:
    """u⁻ / ‖min(u⁻, 0)‖, and this norm."""
    scale = float(np.linalg.norm(np.minimum(entry.problem.approach, 0)))
    return entry.problem.approach / scale, scale


def weighted(entry: Entry) -> sparray:
    """G = H M^-½, (contacts, 2 grains)."""
    return incidence(entry.problem) @ diags_array(np.repeat(entry.problem.masses**-0.5, 2))


def columns(matrix: sparray) -> csc_matrix:
    """Compressed columns in order, with indices of 32 bits, which is what the packages take."""
    made = matrix.tocsc()
    made.sort_indices()
    return csc_matrix(
        (made.data, made.indices.astype(np.int32), made.indptr.astype(np.int32)), shape=made.shape
    )
