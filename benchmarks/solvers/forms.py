"""The contact problem as others pose it: a quadratic program in impulses, or in velocities.

0 ≤ p ⟂ W p + u⁻ ≥ 0 with W = G Gᵀ and G = H M^-½ are the conditions of optimality of both

    in impulses    minimise ½ pᵀ W p + p·u⁻    subject to p ≥ 0,
    in velocities  minimise ½ ‖x‖²             subject to G x ≥ −u⁻,

where x = M^½ Δv are velocity changes in the norm of the kinetic energy, and p the multipliers of the constraints. All
speeds are divided by ‖min(u⁻, 0)‖, since tolerances of others are absolute.
"""

from typing import NamedTuple

import numpy as np
from scipy.sparse import csc_matrix, diags_array, eye_array, sparray

from benchmarks.collection import Entry
from benchmarks.collection.certificates import incidence


class Program(NamedTuple):
    """minimise ½ xᵀ P x + q·x subject to G x ≥ h; impulses are ``scale`` times the unknowns or the multipliers."""

    p: csc_matrix
    q: np.ndarray
    g: csc_matrix
    h: np.ndarray
    scale: float


def in_impulses(entry: Entry) -> Program:
    """The unknowns are impulses."""
    rates, scale = scaled(entry)
    return Program(columns(entry.matrix), rates, columns(eye_array(len(rates))), np.zeros_like(rates), scale)


def in_velocities(entry: Entry) -> Program:
    """The unknowns are velocity changes; multipliers are the impulses."""
    rates, scale = scaled(entry)
    g = columns(weighted(entry))
    return Program(columns(eye_array(g.shape[1])), np.zeros(g.shape[1]), g, -rates, scale)


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
    return csc_matrix((made.data, made.indices.astype(np.int32), made.indptr.astype(np.int32)), shape=made.shape)
