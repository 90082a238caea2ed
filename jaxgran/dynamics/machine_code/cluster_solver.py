"""The impulses of one cluster of contacts, at restitution zero.

Contacts are solved one after the other by projected Gauss–Seidel sweeps. Where these are slow (long chains, grains of
very different mass, flows about to jam) the guarded method of Barzilai and Borwein goes on from where they stand.

Source: the sweeps are those of C. W. Cryer, SIAM J. Control 9, 385 (1971), and converge for semidefinite W by
O. L. Mangasarian, J. Optim. Theory Appl. 22, 465 (1977). The other method: ``contact.projected_methods``.
"""

import math

import numpy as np

from jaxgran.contact.law import JAMMED_RESPONSE, LONGEST_STRIDE, PROGRESS, WINDOW
from jaxgran.dynamics.machine_code.compiled import LAW, compiled
from jaxgran.dynamics.machine_code.layout import (
    APPROACH,
    BEST,
    BOUND,
    CHANGE,
    DRIVE,
    FIRST,
    IMPULSE,
    INFEASIBLE,
    INVERSE_MASS,
    ITERATION_LIMIT,
    IX,
    IY,
    JX,
    JY,
    MOBILITY,
    NONFINITE,
    NX,
    NY,
    OK,
    PULL_X,
    PULL_Y,
    RESPONSE,
    SECOND,
    STEP,
    P,
)

largest_eigenvalue = LAW["largest_eigenvalue"]

_RELAXATION, _RELAXATION_OF_FEW, _FEW = 1.45, 1.2, 32  # over-relaxation, and that of clusters of up to 32 contacts
SWEEPS = 200  # after which a cluster is taken for a stiff one


@compiled
def solve_cluster(m, target, most_iterations, grains, network, clusters):
    """Write the impulses p₀ of cluster m at restitution zero.

    ``target`` is the squared residual to reach. Returns the iterations, the squared residual, and ok, iteration_limit,
    infeasible or nonfinite.
    """
    rows, stiff, source = clusters.rows, clusters.stiff, clusters.source
    start = clusters.starts[m]
    size = np.uint64(clusters.starts[m + 1] - start)
    sweeps = min(most_iterations, SWEEPS)
    iterations, squared = _sweep(start, size, target, sweeps, grains, network, clusters)
    jammed = _is_jammed(size, clusters)
    if squared > target and squared < math.inf and iterations < most_iterations:
        needed, squared = _descend(size, target, most_iterations - iterations, clusters)
        jammed = _is_jammed(size, clusters)  # the last iterate: impulses of the best may not have grown yet
        iterations += needed
        for c in range(size):
            rows[c, P] = stiff[c, BEST]
    for c in range(size):
        network.rows[IMPULSE, source[start + c]] = rows[c, P]
    if squared <= target:
        return iterations, squared, OK
    if not squared < math.inf:
        return iterations, squared, NONFINITE
    return iterations, squared, INFEASIBLE if jammed else ITERATION_LIMIT


@compiled
def _is_jammed(size, clusters):
    """Whether impulses have grown without moving anything: pᵀWp is far below −pᵀu⁻, which it is at a solution."""
    rows, scratch, turns = clusters.rows, clusters.scratch, clusters.turns
    moved = felt = 0.0
    for c in range(size):
        i, j = scratch[FIRST, c], scratch[SECOND, c]
        fall = rows[c, PULL_X] * (turns[j, 0] - turns[i, 0]) + rows[c, PULL_Y] * (turns[j, 1] - turns[i, 1])
        moved -= rows[c, P] * fall * rows[c, MOBILITY]
        felt -= rows[c, P] * rows[c, DRIVE] * rows[c, MOBILITY]
    return moved < JAMMED_RESPONSE * felt


@compiled
def _sweep(start, size, target, most_sweeps, grains, network, clusters):
    """Projected Gauss–Seidel sweeps with over-relaxation; returns their number and the squared residual.

    The update of a contact, without relaxation and over its reduced mass, is its residual min(W_cc p, u), so a sweep
    estimates the norm for nothing; that of one state decides. ``turns`` are the changes of the grains' velocities.
    """
    source, rows, scratch, turns = clusters.source, clusters.rows, clusters.scratch, clusters.turns
    ends, contacts, constants = network.ends, network.rows, grains.constants
    relaxation = _RELAXATION if size > _FEW else _RELAXATION_OF_FEW
    for c in range(size):
        s = source[start + c]
        i, j = ends[FIRST, s], ends[SECOND, s]
        scratch[FIRST, c], scratch[SECOND, c] = i, j
        nx, ny, mi, mj = contacts[NX, s], contacts[NY, s], constants[i, INVERSE_MASS], constants[j, INVERSE_MASS]
        reduced_mass = 1 / (mi + mj)
        rows[c, PULL_X], rows[c, PULL_Y] = nx * reduced_mass, ny * reduced_mass
        rows[c, DRIVE] = contacts[APPROACH, s] * reduced_mass
        rows[c, IX], rows[c, IY], rows[c, JX], rows[c, JY] = nx * mi, ny * mi, nx * mj, ny * mj
        rows[c, MOBILITY], rows[c, P] = mi + mj, 0.0
        turns[i, 0] = turns[i, 1] = turns[j, 0] = turns[j, 1] = 0.0
    sweeps, squared, going = 0, math.inf, True
    while going:
        seen = 0.0
        for c in range(size):
            i, j = scratch[FIRST, c], scratch[SECOND, c]
            fall = rows[c, PULL_X] * (turns[j, 0] - turns[i, 0]) + rows[c, PULL_Y] * (turns[j, 1] - turns[i, 1])
            old = rows[c, P]
            change = max(relaxation * (fall - rows[c, DRIVE]), -old)
            if change != 0.0:
                rows[c, P] = old + change
                turns[i, 0] += change * rows[c, IX]
                turns[i, 1] += change * rows[c, IY]
                turns[j, 0] -= change * rows[c, JX]
                turns[j, 1] -= change * rows[c, JY]
                error = change * rows[c, MOBILITY]
                seen += error * error
        sweeps += 1
        going = sweeps < most_sweeps and seen < math.inf
        if seen <= target * relaxation * relaxation or not going:
            squared = 0.0
            for c in range(size):
                i, j = scratch[FIRST, c], scratch[SECOND, c]
                fall = rows[c, PULL_X] * (turns[j, 0] - turns[i, 0]) + rows[c, PULL_Y] * (turns[j, 1] - turns[i, 1])
                error = min(rows[c, P], rows[c, DRIVE] - fall) * rows[c, MOBILITY]
                squared += error * error
            going &= not squared <= target
    return sweeps, squared


@compiled
def _descend(size, target, most_iterations, clusters):
    """The guarded method of Barzilai and Borwein, from the impulses where the sweeps ended.

    Returns the products with W and the squared residual of the best iterate, whose impulses are in ``stiff``.
    """
    rows, stiff, scratch = clusters.rows, clusters.stiff, clusters.scratch
    turns, matrices = clusters.turns, clusters.matrices
    for c in range(size):
        for end in range(2):
            matrices[scratch[end, c], 0] = matrices[scratch[end, c], 1] = matrices[scratch[end, c], 2] = 0.0
    for c in range(size):
        nx, ny = rows[c, PULL_X] * rows[c, MOBILITY], rows[c, PULL_Y] * rows[c, MOBILITY]
        for end in range(2):
            g = scratch[end, c]
            matrices[g, 0] += nx * nx
            matrices[g, 1] += nx * ny
            matrices[g, 2] += ny * ny
    for c in range(size):
        nx, ny = rows[c, PULL_X] * rows[c, MOBILITY], rows[c, PULL_Y] * rows[c, MOBILITY]
        i, j = scratch[FIRST, c], scratch[SECOND, c]
        inverse_mass_i = nx * rows[c, IX] + ny * rows[c, IY]
        inverse_mass_j = nx * rows[c, JX] + ny * rows[c, JY]
        width_i = largest_eigenvalue(matrices[i, 0], matrices[i, 1], matrices[i, 2])
        width_j = largest_eigenvalue(matrices[j, 0], matrices[j, 1], matrices[j, 2])
        bound = width_i * inverse_mass_i + width_j * inverse_mass_j
        stiff[c, BOUND], stiff[c, STEP], stiff[c, CHANGE], stiff[c, BEST] = bound, 0.0, 0.0, rows[c, P]
        stiff[c, RESPONSE] = nx * (turns[i, 0] - turns[j, 0]) + ny * (turns[i, 1] - turns[j, 1])
    stride, momentum, before, best, squared = 1.0, -1, math.inf, math.inf, math.inf
    iterations = 0
    while iterations == 0 or (iterations < most_iterations and not squared <= target and squared < math.inf):
        push, descent = max(momentum, 0) / (max(momentum, 0) + 3.0), 0.0
        for c in range(size):
            i, j = scratch[FIRST, c], scratch[SECOND, c]
            old, bound = rows[c, P], stiff[c, BOUND]
            at = old + push * stiff[c, STEP]
            slope = stiff[c, RESPONSE] + push * stiff[c, CHANGE] + rows[c, DRIVE] * rows[c, MOBILITY]
            new = max(0.0, at - stride * slope / bound)
            descent += (at - new) * (new - old) * bound
            stiff[c, STEP] = new - old
            rows[c, P] = new
            turns[i, 0] = turns[i, 1] = turns[j, 0] = turns[j, 1] = 0.0
        for c in range(size):
            i, j, press = scratch[FIRST, c], scratch[SECOND, c], rows[c, P]
            turns[i, 0] += press * rows[c, IX]
            turns[i, 1] += press * rows[c, IY]
            turns[j, 0] -= press * rows[c, JX]
            turns[j, 1] -= press * rows[c, JY]
        squared = mixed = long = short = 0.0
        for c in range(size):
            i, j, bound = scratch[FIRST, c], scratch[SECOND, c], stiff[c, BOUND]
            pull = rows[c, PULL_X] * (turns[i, 0] - turns[j, 0]) + rows[c, PULL_Y] * (turns[i, 1] - turns[j, 1])
            response = pull * rows[c, MOBILITY]
            error = min(rows[c, P], pull + rows[c, DRIVE]) * rows[c, MOBILITY]
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
