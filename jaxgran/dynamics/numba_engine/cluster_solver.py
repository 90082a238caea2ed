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
from jaxgran.dynamics.numba_engine.compilation import LAW, njit
from jaxgran.dynamics.numba_engine.layout import (
    APPROACH,
    FIRST,
    IMPULSE,
    INFEASIBLE,
    ITERATION_LIMIT,
    NONFINITE,
    NX,
    NY,
    OK,
    SECOND,
)

largest_eigenvalue = LAW["largest_eigenvalue"]

SWEEPS = 200  # after which a cluster counts as stiff
# Contacts are taken from so many parts of a cluster in turn: those that follow each other share no
# grain, so that no update waits for the one before it.
_PARTS = 8
# Over-relaxation by the number of contacts: within 0.05 of what needs fewest updates in clusters of
# 2 to 400 contacts.
RELAXATION = np.minimum(1 + 0.075 * np.log2(np.maximum(np.arange(641), 1)), 1.7)


@njit
def solve_cluster(m, target, max_steps, grains, network, clusters):
    """Write the impulses J₀ of cluster m at restitution zero.

    ``target`` is the squared residual to reach. Returns the iterations, the squared residual, and
    ok, iteration_limit, infeasible or nonfinite.
    """
    rows, iterate, places, impulses = clusters.rows, clusters.iterate, clusters.places, network.rows
    start = clusters.starts[m]
    size = np.uint64(clusters.starts[m + 1] - start)
    _take_contacts(start, size, grains, network, clusters)
    iterations, squared_residual = _sweep(size, target, min(max_steps, SWEEPS), clusters)
    status = OK if squared_residual <= target else ITERATION_LIMIT
    if status != OK:
        jammed = is_jammed(size, clusters)
        if squared_residual < math.inf and iterations < max_steps:
            more, squared_residual = descend(size, target, max_steps - iterations, clusters)
            # of the last iterate: impulses of the best may not have grown yet
            jammed = is_jammed(size, clusters)
            iterations += more
            for c in range(size):
                rows[c].impulse = iterate[c].best
        status = status_of(squared_residual, target, jammed)
    for c in range(size):
        impulses[IMPULSE, places[c]] = rows[c].impulse
    return iterations, squared_residual, status


@njit
def _take_contacts(start, size, grains, network, clusters):
    """Copy the contacts of a cluster for the solver, one from each part of the cluster in turn."""
    source, places, dv = clusters.source, clusters.places, clusters.dv
    one, last = np.uint64(1), np.uint64(start) + size
    length = size // np.uint64(_PARTS) + one if size >= 2 * _PARTS else one  # of a part
    c = begin = np.uint64(0)
    n = np.uint64(start)
    while c < size:
        place = source[n]
        places[c] = place
        i, j = take_contact(c, place, grains, network, clusters)
        dv[i, 0] = dv[i, 1] = dv[j, 0] = dv[j, 1] = 0.0
        c += one
        n += length
        if n >= last:
            begin += one
            n = np.uint64(start) + begin


@njit
def status_of(squared_residual, target, jammed):
    """The status of a solve that ends with a squared residual."""
    if not squared_residual < math.inf:
        return NONFINITE
    return OK if squared_residual <= target else INFEASIBLE if jammed else ITERATION_LIMIT


@njit
def take_contact(c, place, grains, network, clusters):
    """Copy a contact of the network for the solver, without an impulse; returns its grains."""
    rows, ends, contacts, constants = clusters.rows, clusters.ends, network.rows, grains.constants
    i, j = network.ends[FIRST, place], network.ends[SECOND, place]
    mi, mj = constants[i].inverse_mass, constants[j].inverse_mass
    mobility = mi + mj
    reduced_mass = 1 / mobility
    ends[c, FIRST], ends[c, SECOND] = i, j
    rows[c].mu_nx = contacts[NX, place] * reduced_mass
    rows[c].mu_ny = contacts[NY, place] * reduced_mass
    rows[c].mu_u, rows[c].inverse_mu = contacts[APPROACH, place] * reduced_mass, mobility
    rows[c].inverse_mu_mi, rows[c].inverse_mu_mj = mobility * mi, mobility * mj
    rows[c].impulse = 0.0
    return i, j


@njit
def mu_response_of(c, rows, ends, dv):
    """μ (W J) of a contact, from the changes of the grains' velocities."""
    i, j = ends[c, FIRST], ends[c, SECOND]
    return rows[c].mu_nx * (dv[i, 0] - dv[j, 0]) + rows[c].mu_ny * (dv[i, 1] - dv[j, 1])


@njit
def is_jammed(size, clusters):
    """Whether impulses have grown without moving anything: JᵀWJ is far below −Jᵀu⁻, which it is at
    a solution.
    """
    rows, ends, dv = clusters.rows, clusters.ends, clusters.dv
    j_w_j = minus_j_u = 0.0
    for c in range(size):
        j_w_j += rows[c].impulse * mu_response_of(c, rows, ends, dv) * rows[c].inverse_mu
        minus_j_u -= rows[c].impulse * rows[c].mu_u * rows[c].inverse_mu
    return j_w_j < JAMMED_RESPONSE * minus_j_u


@njit
def _sweep(size, target, max_sweeps, clusters):
    """Projected Gauss–Seidel sweeps with over-relaxation; returns their number and the squared
    residual.

    The update of a contact, without relaxation and over its reduced mass, is its residual min(W_cc
    J, u), so a sweep estimates the norm at no cost; the norm of a single state decides. ``dv`` are
    the changes of the grains' velocities.
    """
    rows, ends, dv = clusters.rows, clusters.ends, clusters.dv
    relaxation = RELAXATION[min(size, np.uint64(RELAXATION.size - 1))]
    sweeps, squared_residual, keep_going = 0, math.inf, True
    while keep_going:
        estimate = 0.0
        for c in range(size):
            change = relax(c, relaxation, rows, ends, dv)
            estimate += change * change
        sweeps += 1
        keep_going = sweeps < max_sweeps and estimate < math.inf
        if estimate <= target * relaxation * relaxation or not keep_going:
            squared_residual = 0.0
            for c in range(size):
                error = error_of(c, rows, ends, dv)
                squared_residual += error * error
            keep_going &= not squared_residual <= target
    return sweeps, squared_residual


@njit
def relax(c, relaxation, rows, ends, dv):
    """One update of a contact, without a branch, which would be mispredicted; returns the change of
    its impulse over its reduced mass.
    """
    i, j = ends[c, FIRST], ends[c, SECOND]
    ix, iy, jx, jy = dv[i, 0], dv[i, 1], dv[j, 0], dv[j, 1]
    mu_nx, mu_ny, impulse = rows[c].mu_nx, rows[c].mu_ny, rows[c].impulse
    change = max(relaxation * (mu_nx * (jx - ix) + mu_ny * (jy - iy) - rows[c].mu_u), -impulse)
    rows[c].impulse = impulse + change
    per_mass_i = change * rows[c].inverse_mu_mi
    per_mass_j = change * rows[c].inverse_mu_mj
    dv[i, 0], dv[i, 1] = ix + per_mass_i * mu_nx, iy + per_mass_i * mu_ny
    dv[j, 0], dv[j, 1] = jx - per_mass_j * mu_nx, jy - per_mass_j * mu_ny
    return change * rows[c].inverse_mu


@njit
def add_impulse(c, rows, ends, dv):
    """Add the changes of velocity by the impulse of a contact."""
    i, j, impulse = ends[c, FIRST], ends[c, SECOND], rows[c].impulse
    per_mass_i = impulse * rows[c].inverse_mu_mi
    per_mass_j = impulse * rows[c].inverse_mu_mj
    dv[i, 0] += per_mass_i * rows[c].mu_nx
    dv[i, 1] += per_mass_i * rows[c].mu_ny
    dv[j, 0] -= per_mass_j * rows[c].mu_nx
    dv[j, 1] -= per_mass_j * rows[c].mu_ny


@njit
def error_of(c, rows, ends, dv):
    """The part of a contact in the residual."""
    mu_velocity = mu_response_of(c, rows, ends, dv) + rows[c].mu_u
    return min(rows[c].impulse, mu_velocity) * rows[c].inverse_mu


@njit
def descend(size, target, max_iterations, clusters):
    """The guarded method of Barzilai and Borwein, from the impulses where the sweeps ended.

    Returns the products with W and the squared residual of the best iterate, whose impulses are in
    ``iterate``. Names are those of ``contact.projected_methods.BarzilaiBorwein``.
    """
    rows, iterate, ends, dv = clusters.rows, clusters.iterate, clusters.ends, clusters.dv
    _start_descent(size, clusters)
    stride, guarded, k = 1.0, False, 0
    iterations, best, squared_residual, last_residual = 0, math.inf, math.inf, math.inf
    while iterations == 0 or (
        iterations < max_iterations
        and not squared_residual <= target
        and squared_residual < math.inf
    ):
        momentum, descent = k / (k + 3.0), 0.0
        for c in range(size):
            i, j = ends[c, FIRST], ends[c, SECOND]
            impulse, bound = rows[c].impulse, iterate[c].bound
            start = impulse + momentum * iterate[c].step
            response = iterate[c].response + momentum * iterate[c].response_change
            velocity = response + rows[c].mu_u * rows[c].inverse_mu
            new_impulse = max(0.0, start - stride * velocity / bound)
            descent += (start - new_impulse) * (new_impulse - impulse) * bound
            iterate[c].step = new_impulse - impulse
            rows[c].impulse = new_impulse
            dv[i, 0] = dv[i, 1] = dv[j, 0] = dv[j, 1] = 0.0
        for c in range(size):
            add_impulse(c, rows, ends, dv)
        # with the last step s: sᵀWs, sᵀDs and (Ws)ᵀD⁻¹(Ws)
        squared_residual = curvature = squared_step = squared_response = 0.0
        for c in range(size):
            bound, mu_response = iterate[c].bound, mu_response_of(c, rows, ends, dv)
            response = mu_response * rows[c].inverse_mu
            error = min(rows[c].impulse, mu_response + rows[c].mu_u) * rows[c].inverse_mu
            step, change = iterate[c].step, response - iterate[c].response
            iterate[c].response_change, iterate[c].response = change, response
            squared_residual += error * error
            curvature += step * change
            squared_step += step * step * bound
            squared_response += change * change / bound
        if squared_residual < best:
            best = squared_residual
            for c in range(size):
                iterate[c].best = rows[c].impulse
        window_ends = iterations % WINDOW == WINDOW - 1
        if guarded or (window_ends and not math.sqrt(best) < PROGRESS * last_residual):
            stride, k = 1.0, k + 1 if guarded and not descent > 0.0 else 0
            guarded = True
        else:
            is_long = iterations % 2 == 1
            numerator = squared_step if is_long else curvature
            denominator = curvature if is_long else squared_response
            stride = LONGEST_STRIDE
            if denominator > 0.0:
                stride = min(numerator / denominator, LONGEST_STRIDE)
        last_residual = math.sqrt(best) if window_ends else last_residual
        iterations += 1
    return iterations, best


@njit
def _start_descent(size, clusters):
    """Write the diagonal D and the response W J of the contacts of a cluster."""
    rows, iterate, ends = clusters.rows, clusters.iterate, clusters.ends
    dv, matrices = clusters.dv, clusters.matrices
    for c in range(size):
        for end in range(2):
            matrices[ends[c, end], 0] = matrices[ends[c, end], 1] = matrices[ends[c, end], 2] = 0.0
    for c in range(size):
        nx, ny = rows[c].mu_nx * rows[c].inverse_mu, rows[c].mu_ny * rows[c].inverse_mu
        for end in range(2):
            g = ends[c, end]
            matrices[g, 0] += nx * nx
            matrices[g, 1] += nx * ny
            matrices[g, 2] += ny * ny
    for c in range(size):
        nx, ny = rows[c].mu_nx * rows[c].inverse_mu, rows[c].mu_ny * rows[c].inverse_mu
        i, j = ends[c, FIRST], ends[c, SECOND]
        inverse_mass_i = rows[c].inverse_mu_mi / rows[c].inverse_mu
        inverse_mass_j = rows[c].inverse_mu_mj / rows[c].inverse_mu
        width_i = largest_eigenvalue(matrices[i, 0], matrices[i, 1], matrices[i, 2])
        width_j = largest_eigenvalue(matrices[j, 0], matrices[j, 1], matrices[j, 2])
        bound = width_i * inverse_mass_i + width_j * inverse_mass_j
        iterate[c].bound, iterate[c].best = bound, rows[c].impulse
        iterate[c].step = iterate[c].response_change = 0.0
        iterate[c].response = nx * (dv[i, 0] - dv[j, 0]) + ny * (dv[i, 1] - dv[j, 1])
