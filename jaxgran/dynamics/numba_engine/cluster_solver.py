"""The impulses of one cluster of contacts, at restitution zero.

Contacts are solved one after the other by projected Gauss–Seidel sweeps. Where these are slow (long
chains, grains of very different mass, flows about to jam) the guarded method of Barzilai and
Borwein continues from their result.

Source: the sweeps are those of C. W. Cryer, SIAM J. Control 9, 385 (1971), and converge for
semidefinite W by O. L. Mangasarian, J. Optim. Theory Appl. 22, 465 (1977). The other method:
``contact.projected_methods``.
"""

import math

import numpy as np

from jaxgran.contact.law import JAMMED_RESPONSE, LONGEST_STRIDE, PROGRESS, WINDOW
from jaxgran.dynamics.numba_engine.compilation import LAW, inline_njit, njit
from jaxgran.dynamics.numba_engine.layout import (
    APPROACH,
    BEST,
    BOUND,
    CHANGE,
    FIRST,
    IMPULSE,
    INFEASIBLE,
    INVERSE_MASS,
    INVERSE_MU,
    INVERSE_MU_MI,
    INVERSE_MU_MJ,
    ITERATION_LIMIT,
    MU_NX,
    MU_NY,
    MU_U,
    NONFINITE,
    NX,
    NY,
    OK,
    RESPONSE,
    SECOND,
    STEP,
    P,
)

largest_eigenvalue = LAW["largest_eigenvalue"]

SWEEPS = 200  # after which a cluster counts as stiff
# Contacts are taken from so many parts of a cluster in turn: those that follow each other share no
# grain, so that no update waits for the one before it.
_PARTS = 8
# Over-relaxation by the number of contacts: within 0.05 of what needs fewest updates in clusters of
# 2 to 400 contacts.
_RELAXATION = np.minimum(1 + 0.075 * np.log2(np.maximum(np.arange(641), 1)), 1.7)


@inline_njit
def solve_cluster(m, target, most_iterations, grains, network, clusters):
    """Write the impulses p₀ of cluster m at restitution zero.

    ``target`` is the squared residual to reach. Returns the iterations, the squared residual, and
    ok, iteration_limit, infeasible or nonfinite.
    """
    rows, stiff, places, impulses = clusters.rows, clusters.stiff, clusters.places, network.rows
    start = clusters.starts[m]
    size = np.uint64(clusters.starts[m + 1] - start)
    _take_contacts(start, size, grains, network, clusters)
    iterations, squared = _sweep(size, target, min(most_iterations, SWEEPS), clusters)
    outcome = OK if squared <= target else ITERATION_LIMIT
    if outcome != OK:
        jammed = _is_jammed(size, clusters)
        if squared < math.inf and iterations < most_iterations:
            needed, squared = _descend(size, target, most_iterations - iterations, clusters)
            jammed = _is_jammed(
                size, clusters
            )  # the last iterate: impulses of the best may not have grown yet
            iterations += needed
            for c in range(size):
                rows[c, P] = stiff[c, BEST]
        outcome = OK if squared <= target else INFEASIBLE if jammed else ITERATION_LIMIT
        if not squared < math.inf:
            outcome = NONFINITE
    for c in range(size):
        impulses[IMPULSE, places[c]] = rows[c, P]
    return iterations, squared, outcome


@inline_njit
def _take_contacts(start, size, grains, network, clusters):
    """Copy the contacts of a cluster for the solver, one from each part of the cluster in turn."""
    source, places, ends, rows, dv = (
        clusters.source,
        clusters.places,
        clusters.ends,
        clusters.rows,
        clusters.dv,
    )
    contacts, constants = network.rows, grains.constants
    one, last = np.uint64(1), np.uint64(start) + size
    length = size // np.uint64(_PARTS) + one if size >= 2 * _PARTS else one  # of a part
    c = begin = np.uint64(0)
    n = np.uint64(start)
    while c < size:
        place = source[n]
        i, j = network.ends[FIRST, place], network.ends[SECOND, place]
        mi, mj = constants[i, INVERSE_MASS], constants[j, INVERSE_MASS]
        mobility = mi + mj
        reduced_mass = 1 / mobility
        places[c], ends[c, FIRST], ends[c, SECOND] = place, i, j
        rows[c, MU_NX], rows[c, MU_NY] = (
            contacts[NX, place] * reduced_mass,
            contacts[NY, place] * reduced_mass,
        )
        rows[c, MU_U], rows[c, INVERSE_MU] = contacts[APPROACH, place] * reduced_mass, mobility
        rows[c, INVERSE_MU_MI], rows[c, INVERSE_MU_MJ], rows[c, P] = (
            mobility * mi,
            mobility * mj,
            0.0,
        )
        dv[i, 0] = dv[i, 1] = dv[j, 0] = dv[j, 1] = 0.0
        c += one
        n += length
        if n >= last:
            begin += one
            n = np.uint64(start) + begin


@njit
def _is_jammed(size, clusters):
    """Whether impulses have grown without moving anything: pᵀWp is far below −pᵀu⁻, which it is at
    a solution.
    """
    rows, ends, dv = clusters.rows, clusters.ends, clusters.dv
    moved = felt = 0.0
    for c in range(size):
        i, j = ends[c, FIRST], ends[c, SECOND]
        fall = rows[c, MU_NX] * (dv[j, 0] - dv[i, 0]) + rows[c, MU_NY] * (dv[j, 1] - dv[i, 1])
        moved -= rows[c, P] * fall * rows[c, INVERSE_MU]
        felt -= rows[c, P] * rows[c, MU_U] * rows[c, INVERSE_MU]
    return moved < JAMMED_RESPONSE * felt


@inline_njit
def _sweep(size, target, most_sweeps, clusters):
    """Projected Gauss–Seidel sweeps with over-relaxation; returns their number and the squared
    residual.

    The update of a contact, without relaxation and over its reduced mass, is its residual min(W_cc
    p, u), so a sweep estimates the norm at no cost; the norm of a single state decides. ``dv`` are
    the changes of the grains' velocities.
    """
    rows, ends, dv = clusters.rows, clusters.ends, clusters.dv
    relaxation = _RELAXATION[min(size, np.uint64(_RELAXATION.size - 1))]
    sweeps, squared, going = 0, math.inf, True
    while going:
        seen = 0.0
        for c in range(size):  # without a branch, which would be mispredicted
            i, j = ends[c, FIRST], ends[c, SECOND]
            ix, iy, jx, jy = dv[i, 0], dv[i, 1], dv[j, 0], dv[j, 1]
            mu_nx, mu_ny, old = rows[c, MU_NX], rows[c, MU_NY], rows[c, P]
            change = max(relaxation * (mu_nx * (jx - ix) + mu_ny * (jy - iy) - rows[c, MU_U]), -old)
            rows[c, P] = old + change
            push_i, push_j = change * rows[c, INVERSE_MU_MI], change * rows[c, INVERSE_MU_MJ]
            dv[i, 0], dv[i, 1] = ix + push_i * mu_nx, iy + push_i * mu_ny
            dv[j, 0], dv[j, 1] = jx - push_j * mu_nx, jy - push_j * mu_ny
            error = change * rows[c, INVERSE_MU]
            seen += error * error
        sweeps += 1
        going = sweeps < most_sweeps and seen < math.inf
        if seen <= target * relaxation * relaxation or not going:
            squared = 0.0
            for c in range(size):
                i, j = ends[c, FIRST], ends[c, SECOND]
                fall = rows[c, MU_NX] * (dv[j, 0] - dv[i, 0]) + rows[c, MU_NY] * (
                    dv[j, 1] - dv[i, 1]
                )
                error = min(rows[c, P], rows[c, MU_U] - fall) * rows[c, INVERSE_MU]
                squared += error * error
            going &= not squared <= target
    return sweeps, squared


@njit
def _descend(size, target, most_iterations, clusters):
    """The guarded method of Barzilai and Borwein, from the impulses where the sweeps ended.

    Returns the products with W and the squared residual of the best iterate, whose impulses are in
    ``stiff``.
    """
    rows, stiff, ends, dv, matrices = (
        clusters.rows,
        clusters.stiff,
        clusters.ends,
        clusters.dv,
        clusters.matrices,
    )
    for c in range(size):
        for end in range(2):
            matrices[ends[c, end], 0] = matrices[ends[c, end], 1] = matrices[ends[c, end], 2] = 0.0
    for c in range(size):
        nx, ny = rows[c, MU_NX] * rows[c, INVERSE_MU], rows[c, MU_NY] * rows[c, INVERSE_MU]
        for end in range(2):
            g = ends[c, end]
            matrices[g, 0] += nx * nx
            matrices[g, 1] += nx * ny
            matrices[g, 2] += ny * ny
    for c in range(size):
        nx, ny = rows[c, MU_NX] * rows[c, INVERSE_MU], rows[c, MU_NY] * rows[c, INVERSE_MU]
        i, j = ends[c, FIRST], ends[c, SECOND]
        inverse_mass_i = rows[c, INVERSE_MU_MI] / rows[c, INVERSE_MU]
        inverse_mass_j = rows[c, INVERSE_MU_MJ] / rows[c, INVERSE_MU]
        width_i = largest_eigenvalue(matrices[i, 0], matrices[i, 1], matrices[i, 2])
        width_j = largest_eigenvalue(matrices[j, 0], matrices[j, 1], matrices[j, 2])
        bound = width_i * inverse_mass_i + width_j * inverse_mass_j
        stiff[c, BOUND], stiff[c, STEP], stiff[c, CHANGE], stiff[c, BEST] = (
            bound,
            0.0,
            0.0,
            rows[c, P],
        )
        stiff[c, RESPONSE] = nx * (dv[i, 0] - dv[j, 0]) + ny * (dv[i, 1] - dv[j, 1])
    stride, momentum, before, best, squared = 1.0, -1, math.inf, math.inf, math.inf
    iterations = 0
    while iterations == 0 or (
        iterations < most_iterations and not squared <= target and squared < math.inf
    ):
        push, descent = max(momentum, 0) / (max(momentum, 0) + 3.0), 0.0
        for c in range(size):
            i, j = ends[c, FIRST], ends[c, SECOND]
            old, bound = rows[c, P], stiff[c, BOUND]
            at = old + push * stiff[c, STEP]
            slope = (
                stiff[c, RESPONSE] + push * stiff[c, CHANGE] + rows[c, MU_U] * rows[c, INVERSE_MU]
            )
            new = max(0.0, at - stride * slope / bound)
            descent += (at - new) * (new - old) * bound
            stiff[c, STEP] = new - old
            rows[c, P] = new
            dv[i, 0] = dv[i, 1] = dv[j, 0] = dv[j, 1] = 0.0
        for c in range(size):
            i, j, press = ends[c, FIRST], ends[c, SECOND], rows[c, P]
            push_i, push_j = press * rows[c, INVERSE_MU_MI], press * rows[c, INVERSE_MU_MJ]
            dv[i, 0] += push_i * rows[c, MU_NX]
            dv[i, 1] += push_i * rows[c, MU_NY]
            dv[j, 0] -= push_j * rows[c, MU_NX]
            dv[j, 1] -= push_j * rows[c, MU_NY]
        squared = mixed = long = short = 0.0
        for c in range(size):
            i, j, bound = ends[c, FIRST], ends[c, SECOND], stiff[c, BOUND]
            pull = rows[c, MU_NX] * (dv[i, 0] - dv[j, 0]) + rows[c, MU_NY] * (dv[i, 1] - dv[j, 1])
            response = pull * rows[c, INVERSE_MU]
            error = min(rows[c, P], pull + rows[c, MU_U]) * rows[c, INVERSE_MU]
            step, change = stiff[c, STEP], response - stiff[c, RESPONSE]
            stiff[c, CHANGE], stiff[c, RESPONSE] = change, response
            squared += error * error
            mixed += step * change
            long += step * step * bound
            short += change * change / bound
        if squared < best:
            best = squared
            for c in range(size):
                stiff[c, BEST] = rows[c, P]
        judged = iterations % WINDOW == WINDOW - 1
        if momentum >= 0 or (judged and not math.sqrt(best) < PROGRESS * before):
            momentum, stride = 0 if descent > 0.0 else max(momentum, -1) + 1, 1.0
        else:
            over, under = (mixed, short) if iterations % 2 == 0 else (long, mixed)
            stride = min(over / under, LONGEST_STRIDE) if under > 0.0 else LONGEST_STRIDE
        before = math.sqrt(best) if judged else before
        iterations += 1
    return iterations, best
