"""The rival: contact dynamics of frictionless discs in steady simple shear, as one classical loop
compiled by numba.

It solves the same time step as jaxgran and shares no code with it, so it serves twice: as the time
to beat on one core and as an independent check of the physics. The loop visits every time step, it
never jumps over free flight; everything else is made to be fast:

- *Two Verlet lists.* A cell list fills an outer list with a wide skin; an inner list with a narrow
  one is filtered from it. The skins follow from the fastest grain and the time step. The inner list
  is valid while a running bound on the relative travel, twice the largest peculiar speed plus the
  shear across a pair, stays below its skin; the outer one by measured displacements in the
  coordinates that move with the cell, plus the strain times the largest centre distance.
- *Frozen pairs.* Between impulses every laboratory velocity is constant, so the squared separation
  of a near pair is a parabola in time. The step evaluates its three stored coefficients: no image,
  no gather, no square root, SIMD code. An impulse refreshes only the pairs of the grains it moved.
- *Small problems.* Steps in which no contact approaches cost nothing more. Isolated pairs have a
  closed form, the other contacts are solved one connected cluster at a time by projected
  Gauss-Seidel sweeps with mild over-relaxation, and clusters in which nothing approaches are left
  out.
- *Kinetic stress for free.* Its sums are carried through flights and impulses, so no step visits
  all grains.

Velocities are peculiar: the laboratory velocity is ``velocity + shear_rate * y`` along x. The
periodic cell has the lattice vectors ``(side, 0)`` and ``(tilt * side, side)``, with a tilt in
[-1/2, 1/2).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

MAX_SWEEPS = 10_000
# Over-relaxation of the Gauss-Seidel sweeps, in small clusters and in those of more than SMALL
# contacts: measured best. 1 is the plain method, which needs twice the sweeps and up to 1.6 times
# the time in the densest flows.
RELAX_SMALL, RELAX_LARGE, SMALL = 1.2, 1.45, 32
# The skins balance the work on the lists against rebuilding them; the optimum is flat.
INNER_SKIN, OUTER_SKIN = 1.8, 3.0
BLOCK = 64  # near pairs tested together
ROW = 8  # numbers a contact brings to the solver
FAR = 1e300
# Places of the sums over a run: stresses have the components xx, xy, yy
IMPULSE, BINARY, CONTACT_STRESS, BINARY_STRESS, KINETIC, SUMS = 0, 1, 2, 5, 8, 11

# Fused multiply-adds are the only liberty taken with the arithmetic: infinities and NaN keep their
# meaning.
compiled = njit(cache=True, error_model="numpy", fastmath={"contract"})


class Tally(NamedTuple):
    """Sums and averages over one run; stresses are (xx, xy, yy), averaged over cell area and all
    steps.
    """

    impulse: float  # sum of p
    binary_impulse: float  # sum of (1 + restitution) * reduced mass * max(0, -normal velocity)
    contact_stress: np.ndarray
    binary_stress: np.ndarray
    kinetic_stress: np.ndarray
    temperature: float

    @property
    def force_ratio(self) -> float:
        """Mean contact force over mean binary force."""
        return self.impulse / self.binary_impulse if self.binary_impulse > 0 else math.nan

    @property
    def pressure(self) -> float:
        """Half the trace of the contact plus the kinetic stress."""
        total = self.contact_stress + self.kinetic_stress
        return 0.5 * (total[0] + total[2])

    @property
    def shear_stress(self) -> float:
        """Minus the xy component of the contact plus the kinetic stress."""
        return -(self.contact_stress[1] + self.kinetic_stress[1])


@compiled
def _outer_pairs(x, y, radii, side, tilt, skin, heads, links, outer):
    """Pairs with a gap below the skin, the x shift and the row of the image; positions lie in the
    primary cell.

    Returns the number found, which may exceed the room in the arrays: then only the count is
    meaningful.
    """
    first, second, shift_x, image = outer
    grains = x.size
    room = first.size
    count = 0
    reach = 2.0 * radii.max() + skin
    rows = int(side / reach)
    columns = int(side / (reach * math.sqrt(1.0 + tilt * tilt)))
    if rows < 3 or columns < 3 or rows * columns > heads.size:
        for i in range(grains):
            for j in range(i):
                dx = x[i] - x[j]
                dy = y[i] - y[j]
                ny = np.rint(dy / side)
                dy -= ny * side
                dx -= ny * tilt * side
                nx = np.rint(dx / side)
                dx -= nx * side
                limit = radii[i] + radii[j] + skin
                if dx * dx + dy * dy < limit * limit:
                    if count < room:
                        first[count] = i
                        second[count] = j
                        shift_x[count] = (nx + ny * tilt) * side
                        image[count] = ny
                    count += 1
        return count

    heads[: rows * columns] = -1
    for i in range(grains):
        row = min(int(y[i] / side * rows), rows - 1)
        column = min(max(int((x[i] - tilt * y[i]) / side * columns), 0), columns - 1)
        cell = row * columns + column
        links[i] = heads[cell]
        heads[cell] = i
    for row in range(rows):
        for column in range(columns):
            for k in range(5):
                # the cell itself, its right neighbour, and the three above
                to_row = row + (1 if k >= 2 else 0)
                to_column = column + (k - 3 if k >= 2 else k)
                ny = float(to_row // rows)
                nx = float(to_column // columns)
                across = (nx + ny * tilt) * side
                other = heads[to_row % rows * columns + to_column % columns]
                i = heads[row * columns + column]
                while i >= 0:
                    xi = x[i] - across
                    yi = y[i] - ny * side
                    touching = radii[i] + skin
                    j = links[i] if k == 0 else other
                    while j >= 0:
                        dx = xi - x[j]
                        dy = yi - y[j]
                        limit = touching + radii[j]
                        if dx * dx + dy * dy < limit * limit:
                            if count < room:
                                first[count] = i
                                second[count] = j
                                shift_x[count] = across
                                image[count] = ny
                            count += 1
                        j = links[j]
                    i = links[i]
    # The image that was moved is j's: s = r_i - r_j - shift.
    return count


@compiled
def _root(parent, grain):
    """Representative of a grain's cluster, with path halving."""
    while parent[grain] != grain:
        parent[grain] = parent[parent[grain]]
        grain = parent[grain]
    return grain


@compiled
def _gauss_seidel(first, second, rows, impulse, kick_x, kick_y, start, stop, target):
    """Impulses of one cluster by projected Gauss-Seidel: 0 <= p, w = W p + u >= 0, p w = 0.

    A row holds, per contact: the normal times the reduced mass, the normal over either mass, the
    normal velocity times the reduced mass, and one over the reduced mass. Without relaxation the
    update of a contact over its reduced mass is its residual min(diag(W) p, w), so a sweep
    estimates the norm for nothing; the residual of a single state decides. ``target`` is the square
    of the norm to reach. Indices are unsigned, which spares the test for negative ones.
    """
    relax = RELAX_LARGE if stop - start > SMALL else RELAX_SMALL
    for _ in range(MAX_SWEEPS):
        seen = 0.0
        for c in range(np.uint64(start), np.uint64(stop)):
            row = np.uint64(ROW) * c
            i = first[c]
            j = second[c]
            old = impulse[c]
            fall = (
                rows[row] * (kick_x[j] - kick_x[i])
                + rows[row + np.uint64(1)] * (kick_y[j] - kick_y[i])
                - rows[row + np.uint64(6)]
            )
            change = max(relax * fall, -old)
            if change != 0.0:
                impulse[c] = old + change
                kick_x[i] += change * rows[row + np.uint64(2)]
                kick_y[i] += change * rows[row + np.uint64(3)]
                kick_x[j] -= change * rows[row + np.uint64(4)]
                kick_y[j] -= change * rows[row + np.uint64(5)]
                residual = change * rows[row + np.uint64(7)]
                seen += residual * residual
        if seen <= target:
            true = 0.0
            for c in range(np.uint64(start), np.uint64(stop)):
                row = np.uint64(ROW) * c
                i = first[c]
                j = second[c]
                fall = (
                    rows[row] * (kick_x[j] - kick_x[i])
                    + rows[row + np.uint64(1)] * (kick_y[j] - kick_y[i])
                    - rows[row + np.uint64(6)]
                )
                residual = min(impulse[c], -fall) * rows[row + np.uint64(7)]
                true += residual * residual
            if true <= target:
                return
        elif not seen < math.inf:
            return


@compiled
def _refresh(p, near, x, y, vx, vy, shear_rate, parabola):
    """The parabola of a near pair from its grains."""
    first, second, shift_x, shift_y, touch = near
    i = first[p]
    j = second[p]
    ux = vx[i] - vx[j] - shear_rate * shift_y[p]
    uy = vy[i] - vy[j]
    dx = x[i] - x[j] - shift_x[p]
    dy = y[i] - y[j] - shift_y[p]
    block = p // BLOCK
    q = p % BLOCK
    parabola[block, 0, q] = dx * dx + dy * dy - touch[p] * touch[p]
    parabola[block, 1, q] = dx * ux + dy * uy
    parabola[block, 2, q] = ux * ux + uy * uy


@compiled
def _add_stress(sums, place, push, nx, ny):
    sums[place] += push * nx * nx
    sums[place + 1] += push * nx * ny
    sums[place + 2] += push * ny * ny


@compiled
def _run(x, y, vx, vy, radii, masses, side, tilt, law, steps, room, sums):
    """The loop. Positions and LABORATORY velocities (unwrapped) are advanced in place.

    Between two rebuilds of the inner list grain positions are referred to the time of the rebuild:
    r(t) = r + v t, so that only grains that receive an impulse are touched, by r -= (change of v)
    t.

    ``room`` bounds the outer pairs: when there are more, the loop stops early. (To grow the arrays
    in here would make numba count their references in every step.) Returns the tilt, the steps done
    and the pairs found, -1 if the time step is too long for the cell.
    """
    shear_rate, restitution, dt, theta, tolerance = law
    grains = x.size
    largest = 2.0 * radii.max()
    ahead = theta * dt
    inverse_mass = 1.0 / masses

    heads = np.empty(max(9, 4 * grains), np.int64)
    links = np.empty(grains, np.int64)
    outer_first = np.empty(room, np.uint32)
    outer_second = np.empty(room, np.uint32)
    outer_shift = np.empty(room)
    outer_image = np.empty(room)
    outer = outer_first, outer_second, outer_shift, outer_image
    inner_first = np.empty(room, np.uint32)
    inner_second = np.empty(room, np.uint32)
    inner_x = np.empty(room)  # shift of the image at the rebuild
    inner_y = np.empty(room)
    inner_touch = np.empty(room)  # sum of radii
    near = inner_first, inner_second, inner_x, inner_y, inner_touch
    parabola = np.empty((room // BLOCK + 1, 3, BLOCK))  # |s|^2 - D^2 = [0] + 2 [1] t + [2] t^2
    chain = np.empty(2 * room + 2, np.int64)  # pairs of a grain, as a linked list of 2 * pair + end
    chain_heads = np.empty(grains, np.int64)
    flags = np.zeros(BLOCK, np.uint8)
    words = flags.view(np.uint64)

    start_x = x.copy()
    start_y = y.copy()
    kick_x = np.zeros(grains)
    kick_y = np.zeros(grains)
    degree = np.zeros(grains, np.int64)
    parent = np.arange(grains)
    moved = np.empty(grains, np.int64)
    cluster_of = np.full(grains, -1)

    contact_pair = np.empty(room, np.int64)
    first = np.empty(room, np.uint32)
    second = np.empty(room, np.uint32)
    rows = np.empty(ROW * room)
    source = np.empty(room, np.int64)
    impulse = np.empty(room)
    cluster_start = np.empty(room + 1, np.int64)
    cluster_drive = np.empty(room)
    net = np.empty(room, np.int64)
    raw_normals = np.empty((room, 2))
    raw_speed = np.empty(room)
    raw_distance = np.empty(room)

    pairs = 0
    found = 0
    outer_skin = -1.0  # forces the first rebuilds
    inner_skin = -1.0
    outer_strain = 0.0
    travel = 0.0
    fastest = 0.0
    k = 0  # steps since the inner rebuild
    sxx = 0.0
    sxy = 0.0
    syy = 0.0

    done = steps
    for step in range(steps):
        t = k * dt
        rate = 2.0 * fastest * (1.0 + abs(shear_rate) * t) + abs(shear_rate) * (
            largest + max(inner_skin, 0.0)
        )
        if not travel + rate * ahead <= inner_skin:
            # Bring every grain to the present, measure speeds and the displacement since the outer
            # rebuild.
            outer_strain += shear_rate * t
            square = 0.0
            farthest = 0.0
            sxx = 0.0
            sxy = 0.0
            syy = 0.0
            for i in range(grains):
                x[i] += vx[i] * t
                y[i] += vy[i] * t
                cx = vx[i] - shear_rate * y[i]
                cy = vy[i]
                sxx += masses[i] * cx * cx
                sxy += masses[i] * cx * cy
                syy += masses[i] * cy * cy
                square = max(square, cx * cx + cy * cy)
                dx = x[i] - start_x[i] - outer_strain * y[i]
                dy = y[i] - start_y[i]
                farthest = max(farthest, dx * dx + dy * dy)
            fastest = math.sqrt(square)
            k = 0
            t = 0.0
            travel = 0.0
            widest = max(0.5 * side - largest, 1e-3 * largest)
            rate = 2.0 * fastest + abs(shear_rate) * largest
            inner_skin = min(
                max(INNER_SKIN * math.sqrt(rate * dt * largest), 2.0 * rate * dt), 0.5 * widest
            )
            if not rate * ahead <= inner_skin:
                done = step
                found = -1
                break
            used = (
                2.0 * math.sqrt(farthest) + abs(outer_strain) * (largest + inner_skin) + inner_skin
            )
            if not used <= outer_skin:
                tilt += outer_strain
                tilt -= math.floor(tilt + 0.5)
                outer_strain = 0.0
                outer_skin = min(
                    max(OUTER_SKIN * math.sqrt(inner_skin * largest), 2.0 * inner_skin), widest
                )
                for i in range(grains):
                    row = math.floor(y[i] / side)
                    y[i] -= row * side
                    vx[i] -= row * side * shear_rate
                    x[i] -= row * tilt * side
                    x[i] -= math.floor((x[i] - tilt * y[i]) / side) * side
                    start_x[i] = x[i]
                    start_y[i] = y[i]
                found = _outer_pairs(x, y, radii, side, tilt, outer_skin, heads, links, outer)
                if found > room:
                    done = step
                    break
            pairs = 0
            chain_heads[:] = -1
            for p in range(found):
                i = outer_first[p]
                j = outer_second[p]
                shift_x = outer_shift[p] + outer_strain * side * outer_image[p]
                shift_y = outer_image[p] * side
                dx = x[i] - x[j] - shift_x
                dy = y[i] - y[j] - shift_y
                touch = radii[i] + radii[j]
                squared = dx * dx + dy * dy
                if squared < (touch + inner_skin) * (touch + inner_skin):
                    inner_first[pairs] = i
                    inner_second[pairs] = j
                    inner_x[pairs] = shift_x
                    inner_y[pairs] = shift_y
                    inner_touch[pairs] = touch
                    _refresh(pairs, near, x, y, vx, vy, shear_rate, parabola)
                    chain[2 * pairs] = chain_heads[i]
                    chain[2 * pairs + 1] = chain_heads[j]
                    chain_heads[i] = 2 * pairs
                    chain_heads[j] = 2 * pairs + 1
                    pairs += 1
            blocks = (pairs + BLOCK - 1) // BLOCK
            for p in range(pairs, blocks * BLOCK):  # pairs that never meet fill the last block
                parabola[p // BLOCK, 0, p % BLOCK] = FAR
                parabola[p // BLOCK, 1:, p % BLOCK] = 0.0
            rate = 2.0 * fastest + abs(shear_rate) * (largest + inner_skin)

        sums[KINETIC] += sxx
        sums[KINETIC + 1] += sxy
        sums[KINETIC + 2] += syy

        # Activation: free flight over theta dt touches.
        contacts = 0
        approaching = 0
        for block in range(blocks):
            flagged = 0
            for q in range(BLOCK):
                half = parabola[block, 1, q] + parabola[block, 2, q] * t
                gap = parabola[block, 0, q] + t * (parabola[block, 1, q] + half)
                closing = half if half < 0.0 else 0.0
                flag = gap + 2.0 * ahead * closing <= 0.0
                flags[q] = flag
                flagged += flag
            if flagged > 0:
                for word in range(BLOCK // 8):
                    if words[word] == 0:
                        continue
                    for q in range(8 * word, 8 * word + 8):
                        if flags[q] == 0:
                            continue
                        curvature = parabola[block, 2, q]
                        half = parabola[block, 1, q] + curvature * t
                        gap = parabola[block, 0, q] + t * (parabola[block, 1, q] + half)
                        when = ahead
                        if half < 0.0 and -half < ahead * curvature:
                            when = -half / curvature
                        if gap + when * (2.0 * half + when * curvature) <= 0.0:
                            contact_pair[contacts] = block * BLOCK + q
                            contacts += 1
                            approaching += 1 if half < 0.0 else 0

        if approaching > 0:
            hits = 0
            drive = 0.0
            for c in range(contacts):
                p = contact_pair[c]
                i = inner_first[p]
                j = inner_second[p]
                ux = vx[i] - vx[j] - shear_rate * inner_y[p]
                uy = vy[i] - vy[j]
                dx = x[i] - x[j] - inner_x[p] + ux * t
                dy = y[i] - y[j] - inner_y[p] + uy * t
                distance = math.sqrt(dx * dx + dy * dy)
                dx /= distance
                dy /= distance
                speed = ux * dx + uy * dy
                raw_normals[c, 0] = dx
                raw_normals[c, 1] = dy
                raw_speed[c] = speed
                raw_distance[c] = distance
                if speed < 0.0:
                    drive += speed * speed
                for g in (i, j):
                    if degree[g] == 0:
                        moved[hits] = g
                        hits += 1
                    degree[g] += 1

            # Isolated pairs have a closed form; the others join clusters.
            coupled = 0
            for c in range(contacts):
                p = contact_pair[c]
                i = inner_first[p]
                j = inner_second[p]
                if degree[i] == 1 and degree[j] == 1:
                    speed = raw_speed[c]
                    if speed < 0.0:
                        reduced = masses[i] * masses[j] / (masses[i] + masses[j])
                        push = -speed * reduced
                        nx = raw_normals[c, 0]
                        ny = raw_normals[c, 1]
                        kick_x[i] = push * nx * inverse_mass[i]
                        kick_y[i] = push * ny * inverse_mass[i]
                        kick_x[j] = -push * nx * inverse_mass[j]
                        kick_y[j] = -push * ny * inverse_mass[j]
                        push *= 1.0 + restitution
                        sums[IMPULSE] += push
                        sums[BINARY] += push
                        push *= raw_distance[c]
                        _add_stress(sums, CONTACT_STRESS, push, nx, ny)
                        _add_stress(sums, BINARY_STRESS, push, nx, ny)
                else:
                    net[coupled] = c
                    coupled += 1
                    a = _root(parent, np.int64(i))
                    b = _root(parent, np.int64(j))
                    parent[a] = b

            if coupled > 0:
                # Number the clusters in which something approaches, sort their contacts by cluster.
                clusters = 0
                for n in range(coupled):
                    c = net[n]
                    if raw_speed[c] < 0.0:
                        root = _root(parent, np.int64(inner_first[contact_pair[c]]))
                        if cluster_of[root] < 0:
                            cluster_of[root] = clusters
                            cluster_start[clusters] = 0
                            cluster_drive[clusters] = 0.0
                            clusters += 1
                        cluster_drive[cluster_of[root]] += raw_speed[c] * raw_speed[c]
                for n in range(coupled):
                    number = cluster_of[_root(parent, np.int64(inner_first[contact_pair[net[n]]]))]
                    if number >= 0:
                        cluster_start[number] += 1
                total = 0
                for m in range(clusters):
                    total += cluster_start[m]
                    cluster_start[m] = total
                cluster_start[clusters] = total
                for n in range(coupled - 1, -1, -1):
                    c = net[n]
                    p = contact_pair[c]
                    i = inner_first[p]
                    j = inner_second[p]
                    number = cluster_of[_root(parent, np.int64(i))]
                    if number >= 0:
                        cluster_start[number] -= 1
                        d = cluster_start[number]
                        nx = raw_normals[c, 0]
                        ny = raw_normals[c, 1]
                        first[d] = i
                        second[d] = j
                        source[d] = c
                        inverse = inverse_mass[i] + inverse_mass[j]
                        reduced = 1.0 / inverse
                        rows[ROW * d] = nx * reduced
                        rows[ROW * d + 1] = ny * reduced
                        rows[ROW * d + 2] = nx * inverse_mass[i]
                        rows[ROW * d + 3] = ny * inverse_mass[i]
                        rows[ROW * d + 4] = nx * inverse_mass[j]
                        rows[ROW * d + 5] = ny * inverse_mass[j]
                        rows[ROW * d + 6] = raw_speed[c] * reduced
                        rows[ROW * d + 7] = inverse
                        impulse[d] = 0.0

                # A cluster may leave half its own share of the permitted squared residual plus half
                # a share by size: the sum is no more than the tolerance of the whole step allows.
                for m in range(clusters):
                    begin = cluster_start[m]
                    end = cluster_start[m + 1]
                    allowed = 0.5 * cluster_drive[m] + 0.5 * drive * (end - begin) / total
                    target = tolerance * tolerance * allowed
                    _gauss_seidel(first, second, rows, impulse, kick_x, kick_y, begin, end, target)

                for d in range(total):
                    c = source[d]
                    nx = raw_normals[c, 0]
                    ny = raw_normals[c, 1]
                    push = (1.0 + restitution) * impulse[d]
                    single = (1.0 + restitution) * max(0.0, -rows[ROW * d + 6])
                    sums[IMPULSE] += push
                    sums[BINARY] += single
                    push *= raw_distance[c]
                    single *= raw_distance[c]
                    _add_stress(sums, CONTACT_STRESS, push, nx, ny)
                    _add_stress(sums, BINARY_STRESS, single, nx, ny)

            # Kick the grains, keep the kinetic sums and the bound on the speed, clean up.
            kicked = 0
            for h in range(hits):
                g = moved[h]
                degree[g] = 0
                parent[g] = g
                cluster_of[g] = -1
                ax = (1.0 + restitution) * kick_x[g]
                ay = (1.0 + restitution) * kick_y[g]
                if ax != 0.0 or ay != 0.0:
                    moved[kicked] = g
                    kicked += 1
                    kick_x[g] = 0.0
                    kick_y[g] = 0.0
                    cx = vx[g] - shear_rate * (y[g] + vy[g] * t)
                    cy = vy[g]
                    sxx += masses[g] * ax * (2.0 * cx + ax)
                    sxy += masses[g] * (ax * cy + ay * cx + ax * ay)
                    syy += masses[g] * ay * (2.0 * cy + ay)
                    square = (cx + ax) * (cx + ax) + (cy + ay) * (cy + ay)
                    if square > fastest * fastest:
                        fastest = math.sqrt(square)
                    vx[g] += ax
                    vy[g] += ay
                    x[g] -= ax * t
                    y[g] -= ay * t
            if 4 * kicked > grains:
                for p in range(pairs):
                    _refresh(p, near, x, y, vx, vy, shear_rate, parabola)
            else:
                for h in range(kicked):
                    link = chain_heads[moved[h]]
                    while link >= 0:
                        _refresh(link >> 1, near, x, y, vx, vy, shear_rate, parabola)
                        link = chain[link]
            rate = 2.0 * fastest * (1.0 + abs(shear_rate) * t) + abs(shear_rate) * (
                largest + inner_skin
            )

        # Free flight: the laboratory velocity is constant, the peculiar one is sheared.
        flight = shear_rate * dt
        sxx += flight * (flight * syy - 2.0 * sxy)
        sxy -= flight * syy
        k += 1
        travel += rate * dt * (1.0 + abs(shear_rate) * dt)

    t = k * dt
    for i in range(grains):
        x[i] += vx[i] * t
        y[i] += vy[i] * t
    tilt += outer_strain + shear_rate * t
    tilt -= math.floor(tilt + 0.5)
    return tilt, done, found


def advance(
    positions,
    velocities,
    radii,
    masses,
    side,
    tilt,
    shear_rate,
    restitution,
    timestep,
    activation,
    tolerance=1e-4,
    steps=1,
):
    """Positions, velocities, tilt and the tally after a number of time steps.

    Args:
      positions:     (grains, 2)  laboratory coordinates, any image
      velocities:    (grains, 2)  peculiar
      radii, masses: (grains,)
      side, tilt:    cell side and strain offset of the images
      restitution:   0 to 1, one number for all pairs
      activation:    theta: a pair is a contact when free flight over theta * timestep makes it
                     overlap; 1/2 midpoint, 0 touching
      tolerance:     of |min(diag(W) p, w)| / |min(u, 0)| in each step

    Returns:
      positions in the primary cell, peculiar velocities, tilt in [-1/2, 1/2), Tally

    Raises ValueError where the cell is narrower than two of the largest grains or the time step is
    too long for it.
    """
    x, y = np.array(positions, float).T.copy()
    vx, vy = np.array(velocities, float).T.copy()
    radii = np.ascontiguousarray(radii, float)
    masses = np.ascontiguousarray(masses, float)
    side, tilt, shear_rate = float(side), float(tilt), float(shear_rate)
    if side <= 4.0 * radii.max():
        raise ValueError("the cell must be wider than two of the largest grains: use more grains")
    vx += shear_rate * y
    sums = np.zeros(SUMS)
    law = shear_rate, *map(float, (restitution, timestep, activation, tolerance))
    left = steps = int(steps)
    room = 12 * radii.size + 64
    while left > 0:
        tilt, done, pairs = _run(x, y, vx, vy, radii, masses, side, tilt, law, left, room, sums)
        left -= done
        if pairs < 0:
            raise ValueError(
                "grains cross the cell in one time step or their velocities are not finite: "
                "shorten the time step"
            )
        room = max(room, pairs + pairs // 4)
    vx -= shear_rate * y
    rows = np.floor(y / side)
    y -= rows * side
    x -= rows * tilt * side
    x -= np.floor((x - tilt * y) / side) * side
    area, steps, kinetic = side * side, max(steps, 1), sums[KINETIC:]
    duration = area * float(timestep) * steps
    tally = Tally(
        impulse=sums[IMPULSE],
        binary_impulse=sums[BINARY],
        contact_stress=sums[CONTACT_STRESS:BINARY_STRESS] / duration,
        binary_stress=sums[BINARY_STRESS:KINETIC] / duration,
        kinetic_stress=kinetic / (area * steps),
        temperature=float((kinetic[0] + kinetic[2]) / (2 * radii.size * steps)),
    )
    return np.stack([x, y], 1), np.stack([vx, vy], 1), tilt, tally
