"""The contacts of one step, their clusters, and the total impulses on the grains."""

import math

from jaxgran.dynamics.numba_engine.calendar import pair_motion
from jaxgran.dynamics.numba_engine.compilation import inline_njit
from jaxgran.dynamics.numba_engine.layout import (
    APPROACH,
    DISTANCE,
    DONE,
    FIRST,
    IMPULSE,
    INVERSE_MASS,
    NX,
    NY,
    RADIUS,
    SECOND,
    WAITING,
)


@inline_njit
def make_network(contacts, t, flow, grains, pairs, network):
    """Write the contacts of a step and their grains; returns their number, Σ min(0, u⁻)² and the
    deepest overlap.
    """
    met, ends, rows, degree, touched = (
        network.met,
        network.ends,
        network.rows,
        network.degree,
        network.touched,
    )
    constants = grains.constants
    hits, scale, deepest = 0, 0.0, 0.0
    for c in range(contacts):
        i, j, dx, dy, ux, uy = pair_motion(met[c], t, flow, grains, pairs)
        distance = math.sqrt(dx * dx + dy * dy)
        dx, dy = dx / distance, dy / distance
        approach = ux * dx + uy * dy
        ends[FIRST, c], ends[SECOND, c] = i, j
        rows[NX, c], rows[NY, c], rows[APPROACH, c] = dx, dy, approach
        rows[DISTANCE, c], rows[IMPULSE, c] = distance, 0.0
        deepest = max(deepest, constants[i, RADIUS] + constants[j, RADIUS] - distance)
        scale += min(approach, 0.0) * approach
        for end in range(2):
            g = ends[end, c]
            if degree[g] == 0:
                touched[hits] = g
                hits += 1
            degree[g] += 1
    return hits, scale, deepest


@inline_njit
def solve_isolated(contacts, grains, network):
    """Write the impulses of isolated pairs; returns the number of the other contacts."""
    ends, rows, degree, constants = network.ends, network.rows, network.degree, grains.constants
    coupled = 0
    for c in range(contacts):
        i, j = ends[FIRST, c], ends[SECOND, c]
        if degree[i] == 1 and degree[j] == 1:
            mobility = constants[i, INVERSE_MASS] + constants[j, INVERSE_MASS]
            rows[IMPULSE, c] = max(0.0, -rows[APPROACH, c]) / mobility
        else:
            coupled += 1
    return coupled


@inline_njit
def find_clusters(contacts, hits, network, clusters):
    """Find the clusters in which a contact approaches, each by a breadth-first search from such a
    contact.

    Returns their number; the contacts of cluster m are ``source[starts[m] : starts[m + 1]]``.
    """
    ends, rows, degree, touched = network.ends, network.rows, network.degree, network.touched
    source, starts, queue, reached = (
        clusters.source,
        clusters.starts,
        clusters.queue,
        clusters.reached,
    )
    of_grain, offsets = clusters.of_grain, clusters.offsets
    total = 0
    for h in range(hits):
        total += degree[touched[h]]
        offsets[touched[h]] = total
    for c in range(contacts):
        for end in range(2):
            g = ends[end, c]
            offsets[g] -= 1
            of_grain[offsets[g]] = c
    found = size = 0
    for c in range(contacts):
        i, j = ends[FIRST, c], ends[SECOND, c]
        if rows[APPROACH, c] < 0.0 and reached[i] == 0 and (degree[i] > 1 or degree[j] > 1):
            starts[found] = size
            found += 1
            first, last = 0, 1  # of the grains that wait in the queue
            queue[0] = i
            reached[i] = WAITING
            while first < last:
                g = queue[first]
                first += 1
                reached[g] = DONE
                for q in range(offsets[g], offsets[g] + degree[g]):
                    n = of_grain[q]
                    other = ends[SECOND, n] if ends[FIRST, n] == g else ends[FIRST, n]
                    if reached[other] != DONE:
                        source[size] = n
                        size += 1
                    if reached[other] == 0:
                        reached[other] = WAITING
                        queue[last] = other
                        last += 1
    starts[found] = size
    return found


@inline_njit
def gather_kicks(contacts, hits, one_plus_alpha, network):
    """Add up the impulses on every grain, and its contacts that carry one."""
    ends, rows, touched, kicks, loaded = (
        network.ends,
        network.rows,
        network.touched,
        network.kicks,
        network.loaded,
    )
    for h in range(hits):
        kicks[touched[h], 0] = kicks[touched[h], 1] = 0.0
    for c in range(contacts):
        push = one_plus_alpha * rows[IMPULSE, c]
        if push > 0.0:
            i, j = ends[FIRST, c], ends[SECOND, c]
            kicks[i, 0] += push * rows[NX, c]
            kicks[i, 1] += push * rows[NY, c]
            kicks[j, 0] -= push * rows[NX, c]
            kicks[j, 1] -= push * rows[NY, c]
            loaded[i] += 1
            loaded[j] += 1
