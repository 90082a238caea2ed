"""The contacts of one step, their clusters, and the total impulses on the grains."""

import math

from jaxgran.dynamics.numba_engine.calendar import pair_motion
from jaxgran.dynamics.numba_engine.compilation import njit
from jaxgran.dynamics.numba_engine.layout import (
    APPROACH,
    DISTANCE,
    DONE,
    FIRST,
    IMPULSE,
    NX,
    NY,
    SECOND,
    WAITING,
)


@njit
def make_network(contacts, t, flow, grains, pairs, network):
    """Write the contacts of a step and their grains; returns the number of the grains, Σ min(0,
    u⁻)² and the largest overlap.
    """
    ends, degree, touched = network.ends, network.degree, network.touched
    touched_count, scale, largest_overlap = 0, 0.0, 0.0
    for c in range(contacts):
        overlap, squared_approach = write_contact(c, t, flow, grains, pairs, network)
        largest_overlap = max(largest_overlap, overlap)
        scale += squared_approach
        for end in range(2):
            g = ends[end, c]
            if degree[g] == 0:
                touched[touched_count] = g
                touched_count += 1
            degree[g] += 1
    return touched_count, scale, largest_overlap


@njit
def write_contact(c, t, flow, grains, pairs, network):
    """Write a contact of the network; returns its overlap and min(0, u⁻)²."""
    ends, rows, constants = network.ends, network.rows, grains.constants
    i, j, dx, dy, ux, uy = pair_motion(network.near_pair[c], t, flow, grains, pairs)
    distance = math.sqrt(dx * dx + dy * dy)
    dx, dy = dx / distance, dy / distance
    approach = ux * dx + uy * dy
    ends[FIRST, c], ends[SECOND, c] = i, j
    rows[NX, c], rows[NY, c], rows[APPROACH, c] = dx, dy, approach
    rows[DISTANCE, c], rows[IMPULSE, c] = distance, 0.0
    overlap = constants[i].radius + constants[j].radius - distance
    return overlap, min(approach, 0.0) * approach


@njit
def solve_isolated(contacts, grains, network):
    """Write the impulses of isolated pairs; returns the number of the other contacts."""
    ends, rows, degree, constants = network.ends, network.rows, network.degree, grains.constants
    coupled = 0
    for c in range(contacts):
        i, j = ends[FIRST, c], ends[SECOND, c]
        if degree[i] == 1 and degree[j] == 1:
            mobility = constants[i].inverse_mass + constants[j].inverse_mass
            rows[IMPULSE, c] = max(0.0, -rows[APPROACH, c]) / mobility
        else:
            coupled += 1
    return coupled


@njit
def find_clusters(contacts, touched_count, network, clusters):
    """Find the clusters in which a contact approaches, each by a breadth-first search from such a
    contact.

    Returns their number; the contacts of cluster m are ``source[starts[m] : starts[m + 1]]``.
    """
    ends, rows, degree, touched = network.ends, network.rows, network.degree, network.touched
    source, starts, queue = clusters.source, clusters.starts, clusters.queue
    of_grain, offsets, reached = clusters.of_grain, clusters.offsets, clusters.reached
    total = 0
    for n in range(touched_count):
        total += degree[touched[n]]
        offsets[touched[n]] = total
    for c in range(contacts):
        for end in range(2):
            g = ends[end, c]
            offsets[g] -= 1
            of_grain[offsets[g]] = c
    count = size = 0
    for c in range(contacts):
        i, j = ends[FIRST, c], ends[SECOND, c]
        if rows[APPROACH, c] < 0.0 and reached[i] == 0 and (degree[i] > 1 or degree[j] > 1):
            starts[count] = size
            count += 1
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
    starts[count] = size
    return count


@njit
def sum_impulses(contacts, touched_count, one_plus_alpha, network):
    """Add up the impulses on every grain, and its contacts that carry one."""
    ends, rows, touched = network.ends, network.rows, network.touched
    impulses, loaded = network.impulses, network.loaded
    for n in range(touched_count):
        impulses[touched[n], 0] = impulses[touched[n], 1] = 0.0
    for c in range(contacts):
        impulse = one_plus_alpha * rows[IMPULSE, c]
        if impulse > 0.0:
            i, j = ends[FIRST, c], ends[SECOND, c]
            impulses[i, 0] += impulse * rows[NX, c]
            impulses[i, 1] += impulse * rows[NY, c]
            impulses[j, 0] -= impulse * rows[NX, c]
            impulses[j, 1] -= impulse * rows[NY, c]
            loaded[i] += 1
            loaded[j] += 1
