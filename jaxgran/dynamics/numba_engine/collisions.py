"""The contacts of one step: their impulses, the grains that they strike, and the pairs of these."""

import math

import numpy as np

from jaxgran.dynamics.numba_engine.cluster_solver import solve_cluster
from jaxgran.dynamics.numba_engine.compilation import LAW, njit
from jaxgran.dynamics.numba_engine.layout import EPSILON, FIRST, OK, SECOND, STRIKES
from jaxgran.dynamics.numba_engine.network import (
    find_clusters,
    make_network,
    solve_isolated,
    sum_impulses,
)
from jaxgran.dynamics.numba_engine.sums import add_contacts, add_solve

residual_target, relative_residual = LAW["residual_target"], LAW["relative_residual"]


@njit
def collide(contacts, t, flow, grains, pairs, network, clusters, sums):
    """Solve the contacts of a step and add them to the sums; returns the number of their grains,
    and the status.
    """
    touched_count, squared_scale, overlap = make_network(contacts, t, flow, grains, pairs, network)
    scale = math.sqrt(squared_scale)
    target = residual_target(scale, flow.tolerance, flow.shear_rate, EPSILON)
    iterations, squared_residual, status = solve_network(
        contacts, touched_count, target, flow.max_steps, grains, network, clusters
    )
    residual = relative_residual(math.sqrt(squared_residual), scale, target)
    sum_impulses(contacts, touched_count, flow.one_plus_alpha, network)
    add_contacts(sums, contacts, flow.one_plus_alpha, grains, network)
    add_solve(sums, iterations, residual, status, overlap)
    return touched_count, status


@njit
def solve_network(contacts, touched_count, target, max_steps, grains, network, clusters):
    """Write the impulses J₀ of a network at restitution zero, to a residual of ``target``.

    Returns the most iterations of a cluster, the squared residual, and the worst status.
    """
    iterations, squared_residual, status = 1, 0.0, OK
    if solve_isolated(contacts, grains, network) > 0:
        permitted = target * target  # squared residual of the clusters that are not solved yet
        count = find_clusters(contacts, touched_count, network, clusters)
        starts = clusters.starts
        for m in range(count):
            share = permitted * (starts[m + 1] - starts[m]) / (starts[count] - starts[m])
            cluster_iterations, cluster_residual, cluster_status = solve_cluster(
                m, share, max_steps, grains, network, clusters
            )
            iterations = max(iterations, cluster_iterations)
            squared_residual += cluster_residual
            status = max(status, cluster_status)
            permitted -= cluster_residual if cluster_residual < share else share
    return iterations, squared_residual, status


@njit
def strike(touched_count, t, shear_rate, grains, network, clusters, kinetic, max_speed):
    """Change the velocities of the struck grains; returns Σ m c ⊗ c and the largest speed after it,
    and whether all is finite.

    A position in the laboratory is r + v t, so a change of v by Δv shifts r by −Δv t.
    """
    finite = True
    for n in range(touched_count):
        g = network.touched[n]
        network.degree[g], clusters.reached[g] = 0, 0
        kinetic, speed = strike_grain(g, t, shear_rate, grains, network.impulses, kinetic)
        finite &= speed < math.inf
        max_speed = max(max_speed, speed)
    return kinetic, max_speed, finite


@njit
def strike_grain(g, t, shear_rate, grains, impulses, kinetic):
    """Change the velocity of a grain; returns Σ m c ⊗ c after it, and its speed, or 0 where nothing
    strikes it.
    """
    motion, inverse_mass, speed = grains.motion, grains.constants[g].inverse_mass, 0.0
    xx, xy, yy = kinetic
    px, py = impulses[g, 0], impulses[g, 1]
    dvx, dvy = px * inverse_mass, py * inverse_mass
    if dvx != 0.0 or dvy != 0.0:
        cx, cy = motion[g].vx - shear_rate * (motion[g].y + motion[g].vy * t), motion[g].vy
        xx += px * (2 * cx + dvx)
        xy += px * cy + py * cx + px * dvy
        yy += py * (2 * cy + dvy)
        speed = math.sqrt((cx + dvx) * (cx + dvx) + (cy + dvy) * (cy + dvy))
        motion[g].vx += dvx
        motion[g].vy += dvy
        motion[g].x -= dvx * t
        motion[g].y -= dvy * t
    return (xx, xy, yy), speed


@njit
def list_struck_pairs(k, touched_count, contacts, overfull, pairs, network):
    """List the pairs of the struck grains, each once, for a new prediction; clears the impulses.

    Args:
      k: the step.
      touched_count: number of grains with contacts.
      contacts: number of contacts, or of all near pairs if ``overfull``.
      overfull: whether there was no room for all contacts.

    Returns:
      The number of listed pairs.
    """
    impulses, touched, loaded = network.impulses, network.touched, network.loaded
    ends, offsets, of_grain, listed = pairs.ends, pairs.offsets, pairs.of_grain, pairs.listed
    count = np.uint64(0)
    for n in range(touched_count):
        g = touched[n]
        if loaded[g] > 0:
            for q in range(offsets[g], offsets[g + 1]):
                p = of_grain[q]
                other = ends[FIRST, p] ^ ends[SECOND, p] ^ g
                listed[count] = p
                # each pair once: of two struck grains the one with the smaller number lists it
                count += np.uint64((other > g) | (loaded[other] == 0))
    for c in range(contacts):
        p = np.uint32(c) if overfull else network.near_pair[c]
        if (
            pairs.calendar[STRIKES, p] <= k
            and loaded[ends[FIRST, p]] == 0
            and loaded[ends[SECOND, p]] == 0
        ):
            listed[count] = p  # it approached by rounding only, or there was no room for it
            count += np.uint64(1)
    for n in range(touched_count):
        g = touched[n]
        impulses[g, 0] = impulses[g, 1] = 0.0
        loaded[g] = 0
    return np.int64(count)
