"""The contact solve of the engine ``numba``, called alone: isolated pairs, then cluster by
cluster.
"""

import math

import numpy as np
from numba import njit

from benchmarks.collection import Entry
from benchmarks.collection.compare import CAP, Answer, Solve
from jaxgran.dynamics.numba_engine.arrays import arrays_of
from jaxgran.dynamics.numba_engine.collisions import residual_target, solve_network
from jaxgran.dynamics.numba_engine.layout import (
    APPROACH,
    EPSILON,
    FIRST,
    IMPULSE,
    INFEASIBLE,
    NX,
    NY,
    SECOND,
)


def by_cluster(entry: Entry, tolerance: float) -> Solve:
    """The impulses as a step of the engine computes them; counts the most iterations of a
    cluster.
    """
    problem = entry.problem
    ends = np.ascontiguousarray(problem.ends.T, np.uint32)
    normals, inverse_masses = np.ascontiguousarray(problem.normals.T), 1 / problem.masses

    def solve() -> Answer | None:
        impulses = np.empty_like(problem.approach)
        iterations, status = _solve(
            ends, normals, inverse_masses, problem.approach, impulses, float(tolerance), CAP
        )
        return None if status == INFEASIBLE else Answer(impulses, iterations)

    return solve


@njit(error_model="numpy")
def _solve(ends, normals, inverse_masses, approach, impulses, tolerance, max_steps):
    """As ``collide`` of the engine, for a given network."""
    count, contacts = inverse_masses.size, approach.size
    arrays = arrays_of(count)
    grains, network, clusters = arrays.grains, arrays.network, arrays.clusters
    for g in range(count):
        grains.constants[g].inverse_mass = inverse_masses[g]
    scale, touched_count = 0.0, 0
    for c in range(contacts):
        for end in (FIRST, SECOND):
            g = network.ends[end, c] = ends[end, c]
            if network.degree[g] == 0:
                network.touched[touched_count] = g
                touched_count += 1
            network.degree[g] += 1
        network.rows[NX, c], network.rows[NY, c] = normals[0, c], normals[1, c]
        network.rows[APPROACH, c], network.rows[IMPULSE, c] = approach[c], 0.0
        scale += min(approach[c], 0.0) ** 2
    target = residual_target(math.sqrt(scale), tolerance, 1.0, EPSILON)
    iterations, _, status = solve_network(
        contacts, touched_count, target, max_steps, grains, network, clusters
    )
    for c in range(contacts):
        impulses[c] = network.rows[IMPULSE, c]
    return iterations, status
