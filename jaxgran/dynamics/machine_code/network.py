"""The contacts of one step, their clusters, and the total impulses on the grains."""

import math

from jaxgran.dynamics.machine_code.calendar import pair_motion
from jaxgran.dynamics.machine_code.compiled import compiled
from jaxgran.dynamics.machine_code.layout import (
    APPROACH,
    DISTANCE,
    FIRST,
    IMPULSE,
    INVERSE_MASS,
    NX,
    NY,
    RADIUS,
    SECOND,
)


@compiled
def make_network(contacts, t, flow, grains, pairs, network):
    """Write the contacts of a step and their grains; returns their number, Σ min(0, u⁻)² and the deepest overlap."""
    met, ends, rows, degree, touched = network.met, network.ends, network.rows, network.degree, network.touched
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


@compiled
def solve_isolated(contacts, grains, network, clusters):
    """Write the impulses of isolated pairs; collect the other contacts, and join their grains. Returns their number."""
    ends, rows, degree, constants = network.ends, network.rows, network.degree, grains.constants
    source, parent = clusters.source, clusters.parent
    coupled = 0
    for c in range(contacts):
        i, j = ends[FIRST, c], ends[SECOND, c]
        if degree[i] == 1 and degree[j] == 1:
            mobility = constants[i, INVERSE_MASS] + constants[j, INVERSE_MASS]
            rows[IMPULSE, c] = max(0.0, -rows[APPROACH, c]) / mobility
        else:
            source[coupled] = c
            coupled += 1
            parent[_root(parent, i)] = _root(parent, j)
    return coupled


@compiled
def _root(parent, grain):
    """A grain that stands for the cluster of the given one."""
    while parent[grain] != grain:
        parent[grain] = parent[parent[grain]]
        grain = parent[grain]
    return grain


@compiled
def sort_by_cluster(coupled, network, clusters):
    """Number the clusters in which a contact approaches, and sort the contacts of these by cluster.

    Returns the number of clusters; the contacts of cluster m are ``source[starts[m] : starts[m + 1]]``.
    """
    source, starts, parent, number = clusters.source, clusters.starts, clusters.parent, clusters.number
    scratch, ends, rows = clusters.scratch, network.ends, network.rows
    found = 0
    for n in range(coupled):
        root = _root(parent, ends[FIRST, source[n]])
        scratch[1, n] = root
        if rows[APPROACH, source[n]] < 0.0 and number[root] < 0:
            number[root] = found
            starts[found] = 0
            found += 1
    for n in range(coupled):
        m = number[scratch[1, n]]
        if m >= 0:
            starts[m] += 1
    total = 0
    for m in range(found):
        total += starts[m]
        starts[m] = total
    starts[found] = total
    for n in range(coupled - 1, -1, -1):
        m = number[scratch[1, n]]
        if m >= 0:
            starts[m] -= 1
            scratch[0, starts[m]] = source[n]
    for n in range(total):
        source[n] = scratch[0, n]
    return found


@compiled
def gather_kicks(contacts, hits, bounce, network):
    """Add up the impulses on every grain, and its contacts that carry one."""
    ends, rows, touched, kicks, loaded = network.ends, network.rows, network.touched, network.kicks, network.loaded
    for h in range(hits):
        kicks[touched[h], 0] = kicks[touched[h], 1] = 0.0
    for c in range(contacts):
        push = bounce * rows[IMPULSE, c]
        if push > 0.0:
            i, j = ends[FIRST, c], ends[SECOND, c]
            kicks[i, 0] += push * rows[NX, c]
            kicks[i, 1] += push * rows[NY, c]
            kicks[j, 0] -= push * rows[NX, c]
            kicks[j, 1] -= push * rows[NY, c]
            loaded[i] += 1
            loaded[j] += 1
