"""The advance of one replica as one loop of machine code, for processors: every pair is asked once when it will touch.

The loop does what ``dynamics.advance`` does, contact for contact, with the same rule, impulses to the same tolerance
and the same sums. It differs in what it visits. Between two impulses both grains of a pair fly freely, so the steps in
which they are a contact follow from a quadratic equation, and hold until one of the two is struck:

- *A calendar of pairs.* Of every near pair the loop keeps the first step in which it is an approaching contact and the
  first and last step in which it is a contact at all. The next step to visit is the smallest entry; its contacts are a
  comparison of whole numbers away. An impulse renews the entries of the struck grains' pairs, and no others.
- *Flight moves nothing.* Positions in the laboratory frame are r + v t, with t counted from the last search for near
  pairs; an impulse shifts r by −Δv t.
- *One list of near pairs*, found through a grid of cells, valid as long as the fastest pair cannot have crossed its
  skin.
- *Clusters apart.* Isolated pairs have a closed form. The others are solved cluster by cluster, one contact after the
  other, by projected Gauss–Seidel sweeps; where these are slow (long chains, grains of very different mass, flows about
  to jam) the default of ``methods`` goes on from where they stand. A cluster in which nothing approaches needs no
  impulses. Each may leave the share of the permitted squared residual that its number of contacts has in those of all
  clusters.

Source: the sweeps are those of C. W. Cryer, SIAM J. Control 9, 385 (1971), and converge for semidefinite W by
O. L. Mangasarian, J. Optim. Theory Appl. 22, 465 (1977).

Everything is compiled by numba when it is first needed, and kept on disc. Arrays are handed on whole and read by row
and column: every view that is made of one would be counted, at the cost of many contacts. Indices are unsigned, which
spares a test for negative ones.
"""

# pyright: reportCallIssue=false
# An intrinsic of numba is called without the context that it is defined with.

import math

import numpy as np
from llvmlite import ir
from numba import carray, cfunc, njit, types
from numba.extending import intrinsic

from jaxgran.contact.projected_methods import LONGEST_STRIDE, PROGRESS, WINDOW
from jaxgran.contact.solver import JAMMED_RESPONSE
from jaxgran.dynamics.tally import FLAT_SUMS, RESIDUAL_EDGES
from jaxgran.model.status import DEEP_OVERLAP, Status

_CONTACTS, _CLUSTERS, _SOLVES, _LARGEST, _STATUS, _TILT = FLAT_SUMS  # where they begin in what a call returns
_SUMS = _TILT + 1

_PAIRS_PER_GRAIN = 2.7  # expected within the skin: wide lists cost the events, narrow ones the searches
_PAIR_CAPACITY = 16  # slots of pairs for each grain
_NARROWER = 12  # lists that are tried with ever narrower skins, where pairs are more than there is room for
_LIFE = 0.1  # strain: the longest life of a list, in which a peculiar speed grows by 1.1 at most
_NEVER, _MANY = np.int32(2**31 - 1), 2.0**30
_CACHED_GRAINS, _ROW_HEIGHT = 2000, 2.0  # larger flows are put in order, in cells of two diameters
_LANES = 64  # entries of the calendar that are compared together
_EPS = float(np.finfo(np.float64).eps)
_EDGES = RESIDUAL_EDGES[1:-1]
_RELAXATION, _RELAXATION_OF_FEW, _FEW = 1.45, 1.2, 32  # over-relaxation, and that of clusters of up to 32 contacts
_SWEEPS = 200  # after which a cluster is taken for a stiff one
_OK, _ITERATION_LIMIT, _OVERLAP = int(Status.ok), int(Status.iteration_limit), int(Status.deep_overlap)
_INFEASIBLE, _CAPACITY, _NONFINITE = int(Status.infeasible), int(Status.capacity), int(Status.nonfinite)

_X, _Y, _VX, _VY = range(4)  # columns of the motion of the grains
_RADIUS, _INVERSE_MASS = range(2)  # columns of the grains
_FIRST, _SECOND = range(2)  # rows of the pairs, and of the contacts
_ACROSS, _ROW = range(2)  # rows of the images: r_i − r_j − (across, row·L) is the separation
_STRIKES, _BEGINS, _ENDS = range(3)  # rows of the calendar, in steps since the search
_NX, _NY, _APPROACH, _DISTANCE, _IMPULSE = range(5)  # rows of the network
_PULL_X, _PULL_Y, _DRIVE, _IX, _IY, _JX, _JY, _MOBILITY, _P = range(9)  # columns of what a contact brings to the solver

_RESPONSE, _STEP, _CHANGE, _BEST, _BOUND = range(5)  # columns of the same of a stiff cluster

_compiled = njit(cache=True, error_model="numpy", fastmath={"contract"})


@_compiled
def advance_loop(positions, velocities, radii, masses, numbers, new_positions, new_velocities, sums):
    """Advance one replica.

    Args:
      positions, velocities: (grains, 2) as in a State; ``new_positions`` and ``new_velocities`` receive those after,
        the positions not wrapped.
      radii, masses: (grains,).
      numbers: side, tilt, restitution, timestep, shear rate, tolerance, activation fraction, most iterations of a
        solve, and steps.
      sums: (114,) receives the ``Sums``, and the tilt.
    """
    side, tilt, alpha, dt, rate = numbers[0], numbers[1], numbers[2], numbers[3], numbers[4]
    tolerance, theta, most_iterations, steps = numbers[5], numbers[6], int(numbers[7]), int(numbers[8])
    count = radii.size
    ahead, bounce = theta * dt, 1.0 + alpha
    for a in range(_SUMS):
        sums[a] = 0.0

    motion, grains = np.empty((count, 4)), np.empty((count, 2))
    largest, finite = 0.0, True
    order = _order(positions, side, tilt)
    for g in range(count):
        given = order[g]
        motion[g, _X], motion[g, _Y] = positions[given, 0], positions[given, 1]
        motion[g, _VX], motion[g, _VY] = velocities[given, 0] + rate * positions[given, 1], velocities[given, 1]
        grains[g, _RADIUS], grains[g, _INVERSE_MASS] = radii[given], 1 / masses[given]
        largest = max(largest, 2 * radii[given])
        for a in range(4):
            finite &= abs(motion[g, a]) < math.inf
    widest = max(side / 2 - largest, 1e-3)  # nearest images are unique
    expected = math.sqrt(2 * _PAIRS_PER_GRAIN * side * side / (math.pi * count)) - 1.0
    usual = min(max(expected, 0.05), widest)

    room = min(_PAIR_CAPACITY * count, count * (count - 1) // 2)
    slots = (room + _LANES - 1) // _LANES * _LANES
    pairs, images, calendar = np.empty((2, slots), np.uint32), np.empty((2, slots)), np.empty((3, slots), np.int32)
    of_grain, offsets = np.empty(2 * room, np.uint32), np.empty(count + 1, np.uint32)
    heads, links = np.empty(max(9, 2 * count), np.int32), np.empty(count, np.int32)

    size = 3 * count  # contacts of discs form a planar graph
    ends, network = np.empty((2, size), np.uint32), np.empty((5, size))
    met, source, scratch = np.empty(size, np.uint32), np.empty(size, np.uint32), np.empty((2, size), np.uint32)
    starts, touched = np.empty(size + 1, np.uint32), np.empty(count, np.uint32)
    degree, loaded, parent = np.zeros(count, np.int32), np.zeros(count, np.int32), np.empty(count, np.uint32)
    number = np.full(count, -1, np.int32)
    for g in range(count):
        parent[g] = g
    kicks, matrices = np.zeros((count, 2)), np.empty((count, 3))
    rows, stiff = np.empty((size, 9)), np.empty((size, 5))

    done, solved = 0, 0  # steps until the last search; whether the contacts of the present step have been dealt with
    status = _OK if finite else _NONFINITE
    while done < steps and status != _NONFINITE:
        fastest = _wrapped(motion, side, tilt, rate)
        sxx, sxy, syy = _kinetic(motion, grains, rate)
        skin = 1.2 * (2 * fastest * (1 + _LIFE) + rate * largest) * ahead  # what one step may need
        skin, found = min(max(skin, usual), widest), 0
        for _ in range(_NARROWER):
            found = _near_pairs(motion, grains, side, tilt, largest + skin, skin, room, heads, links, pairs, images)
            if found <= room:
                break
            skin *= 0.7
        loss = _loss(fastest, rate, largest + skin)
        slack = skin - loss * ahead
        if found > room or slack < 0.0:
            found, status = min(found, room), max(status, _CAPACITY)
        if not loss < math.inf:
            status = _NONFINITE
            break
        _index_pairs(pairs, found, offsets, of_grain)
        blocks = (found + _LANES - 1) // _LANES
        life = _LIFE / rate if rate > 0.0 else math.inf
        horizon = max(min(slack / loss if loss > 0.0 else math.inf, life), dt) + ahead
        for p in range(found):
            _ask(p, 0.0, solved, horizon, side, rate, dt, theta, pairs, images, motion, grains, calendar)
        for p in range(found, blocks * _LANES):
            calendar[_STRIKES, p], calendar[_BEGINS, p], calendar[_ENDS, p] = _NEVER, _NEVER, -1

        k, fresh = 0, True  # steps since the search
        while True:
            # The next step to visit is that of a contact, the end of the list's life, or that of the advance.
            spare = min(slack / (loss * dt), life / dt - k, _MANY) if loss > 0.0 else _MANY
            after = k + int(max(spare, 1.0 if fresh else 0.0))  # a new list lasts to the next step, where it is renewed
            strike = _next_strike(calendar, blocks)
            after, fresh, before = min(after, strike, steps - done), False, k
            flight = (after - k) * dt
            turned = rate * flight
            sums[0] += flight
            sums[1] += after - k
            sums[2] += flight * (sxx - turned * sxy + turned * turned / 3 * syy)
            sums[3] += flight * (sxy - turned / 2 * syy)
            sums[4] += flight * syy
            sxx += turned * (turned * syy - 2 * sxy)
            sxy -= turned * syy
            slack -= loss * flight
            k = after
            solved = solved if k == before else 0
            if done + k >= steps or strike > k or (k > before and slack < -16 * _EPS * skin):
                break

            t = k * dt
            contacts = _contacts_of_step(k, calendar, blocks, met)
            overfull = contacts > size
            if overfull:
                contacts, status = size, max(status, _CAPACITY)
            hits, scale, deepest = _make_network(
                contacts, met, t, side, rate, pairs, images, motion, grains, ends, network, degree, touched
            )
            target = tolerance * math.sqrt(scale) + 10 * _EPS * rate
            coupled = _solve_isolated(contacts, ends, network, grains, degree, parent, source)
            iterations, squared, outcome = 1, 0.0, _OK
            if coupled > 0:
                clusters = _sort_by_cluster(coupled, source, ends, network, parent, number, starts, scratch)
                for m in range(clusters):
                    begin, end = starts[m], starts[m + 1]
                    share = target * target * (end - begin) / starts[clusters]
                    needed, left, missed = _solve_cluster(
                        begin, end, source, ends, network, grains, share, most_iterations, rows, stiff, scratch, kicks,
                        matrices,
                    )  # fmt: skip
                    iterations, squared, outcome = max(iterations, needed), squared + left, max(outcome, missed)
            floor = max(math.sqrt(scale), target)  # zero where what approaches does so by rounding, without shear
            residual = math.sqrt(squared) / floor if floor > 0.0 else 0.0
            _gather_kicks(contacts, hits, touched, bounce, ends, network, kicks, loaded)
            _count(sums, contacts, bounce, ends, network, grains, kicks, loaded)
            _count_solve(sums, iterations, residual, outcome, deepest)
            status = max(status, outcome, _OVERLAP if deepest > DEEP_OVERLAP else _OK)

            for h in range(hits):
                g = touched[h]
                degree[g], parent[g], number[g], loaded[g] = 0, g, -1, 0
                ax, ay = kicks[g, 0] * grains[g, _INVERSE_MASS], kicks[g, 1] * grains[g, _INVERSE_MASS]
                if ax != 0.0 or ay != 0.0:
                    cx, cy = motion[g, _VX] - rate * (motion[g, _Y] + motion[g, _VY] * t), motion[g, _VY]
                    px, py = kicks[g, 0], kicks[g, 1]
                    sxx += px * (2 * cx + ax)
                    sxy += px * cy + py * cx + px * ay
                    syy += py * (2 * cy + ay)
                    speed = math.sqrt((cx + ax) * (cx + ax) + (cy + ay) * (cy + ay))
                    finite &= speed < math.inf
                    fastest = max(fastest, speed)
                    motion[g, _VX] += ax
                    motion[g, _VY] += ay
                    motion[g, _X] -= ax * t
                    motion[g, _Y] -= ay * t
            solved = 1
            if not finite:
                status = _NONFINITE
                break
            loss_before, loss = loss, _loss(fastest, rate, largest + skin)
            slack -= (loss - loss_before) * ahead
            horizon = max(min(slack / loss, life - t), dt) + ahead
            for h in range(hits):
                g = touched[h]
                if kicks[g, 0] != 0.0 or kicks[g, 1] != 0.0:
                    for q in range(offsets[g], offsets[g + 1]):
                        p = of_grain[q]
                        other = pairs[_SECOND, p] if pairs[_FIRST, p] == g else pairs[_FIRST, p]
                        if other > g or (kicks[other, 0] == 0.0 and kicks[other, 1] == 0.0):  # or it has asked for both
                            _ask(p, t, k + 1, horizon, side, rate, dt, theta, pairs, images, motion, grains, calendar)
            for h in range(hits):
                kicks[touched[h], 0] = kicks[touched[h], 1] = 0.0
            for c in range(found if overfull else contacts):
                p = np.uint32(c) if overfull else met[c]
                if calendar[_STRIKES, p] <= k:  # it approached by no more than rounding, or there was no room for it
                    _ask(p, t, k + 1, horizon, side, rate, dt, theta, pairs, images, motion, grains, calendar)

        t = k * dt
        done += k
        tilt += rate * t
        tilt -= math.floor(tilt + 0.5)
        for g in range(count):
            motion[g, _X] += motion[g, _VX] * t
            motion[g, _Y] += motion[g, _VY] * t

    for g in range(count):
        given = order[g]
        new_positions[given, 0], new_positions[given, 1] = motion[g, _X], motion[g, _Y]
        new_velocities[given, 0], new_velocities[given, 1] = motion[g, _VX] - rate * motion[g, _Y], motion[g, _VY]
        if done == 0:  # as it was, to the bit
            for a in range(2):
                new_positions[given, a], new_velocities[given, a] = positions[given, a], velocities[given, a]
    sums[_STATUS], sums[_TILT] = status, tilt


@_compiled
def _loss(fastest, rate, distance):
    """How much of its skin a list may lose in unit time, where pairs are within a distance."""
    return 2 * fastest * (1 + _LIFE) + rate * distance / 2


@_compiled
def _order(positions, side, tilt):
    """An order of the grains in which neighbours are close in memory: row by row, where a flow outgrows the caches."""
    count = positions.shape[0]
    order = np.empty(count, np.uint32)
    across = max(1, int(side / _ROW_HEIGHT)) if count > _CACHED_GRAINS else 1
    before = np.zeros(across * across + 1, np.int64)
    cell = np.zeros(count, np.int64)
    for g in range(count):
        if across > 1 and abs(positions[g, 0]) < math.inf and abs(positions[g, 1]) < math.inf:
            row = min(max(int(positions[g, 1] / side * across), 0), across - 1)
            fraction = (positions[g, 0] - tilt * positions[g, 1]) / side
            column = int((fraction - math.floor(fraction)) * across)
            cell[g] = row * across + min(max(column, 0), across - 1)
        before[cell[g] + 1] += 1
    for c in range(before.size - 1):
        before[c + 1] += before[c]
    for g in range(count):
        order[before[cell[g]]] = g
        before[cell[g]] += 1
    return order


@_compiled
def _wrapped(motion, side, tilt, rate):
    """Bring the grains into the cell, at the same peculiar velocities; returns the largest peculiar speed."""
    fastest = 0.0
    for g in range(motion.shape[0]):
        cx, cy = motion[g, _VX] - rate * motion[g, _Y], motion[g, _VY]
        row = math.floor(motion[g, _Y] / side)
        motion[g, _Y] -= row * side
        motion[g, _X] -= row * tilt * side
        motion[g, _X] -= math.floor((motion[g, _X] - tilt * motion[g, _Y]) / side) * side
        motion[g, _VX] = cx + rate * motion[g, _Y]
        fastest = max(fastest, cx * cx + cy * cy)
    return math.sqrt(fastest)


@_compiled
def _kinetic(motion, grains, rate):
    """Σ m c_x c_x, Σ m c_x c_y and Σ m c_y c_y."""
    sxx = sxy = syy = 0.0
    for g in range(motion.shape[0]):
        cx, cy, mass = motion[g, _VX] - rate * motion[g, _Y], motion[g, _VY], 1 / grains[g, _INVERSE_MASS]
        sxx += mass * cx * cx
        sxy += mass * cx * cy
        syy += mass * cy * cy
    return sxx, sxy, syy


@_compiled
def _near_pairs(motion, grains, side, tilt, reach, skin, room, heads, links, pairs, images):
    """Write the pairs with a gap within the skin, and their images; what there is no room for is only counted."""
    count, found = motion.shape[0], 0
    most = math.sqrt(heads.size)
    up, along = int(min(most, side / reach)), int(min(most, side / (reach * math.sqrt(1.0 + tilt * tilt))))
    small = not (up >= 3 and along >= 3)  # all pairs, by nearest images
    cells = 1 if small else up * along
    for cell in range(cells):
        heads[cell] = -1
    for g in range(count):
        cell = 0
        if not small:
            row = min(max(int(motion[g, _Y] / side * up), 0), up - 1)
            fraction = (motion[g, _X] - tilt * motion[g, _Y]) / side
            cell = row * along + min(max(int(fraction * along), 0), along - 1)
        links[g] = heads[cell]
        heads[cell] = g
    for cell in range(cells):
        for k in range(1 if small else 5):  # the cell itself, its right neighbour, and the three above
            above, beside = cell // along + (k >= 2), cell % along + (k - 3 if k >= 2 else k)
            row, column = 0, 0
            if above == up and not small:
                above, row = 0, 1
            if beside == along and not small:
                beside, column = 0, 1
            elif beside < 0:
                beside, column = along - 1, -1
            shift = (column + row * tilt) * side
            i = heads[cell]
            while i >= 0:
                j = links[i] if k == 0 else heads[above * along + beside]
                while j >= 0:
                    dx, dy = motion[i, _X] - motion[j, _X], motion[i, _Y] - motion[j, _Y]
                    if small:
                        row = int(np.rint(dy / side))
                        shift = np.rint((dx - row * tilt * side) / side) * side + row * tilt * side
                    dx, dy = dx - shift, dy - row * side
                    limit = grains[i, _RADIUS] + grains[j, _RADIUS] + skin
                    if dx * dx + dy * dy <= limit * limit:
                        if found < room:
                            pairs[_FIRST, found], pairs[_SECOND, found] = i, j
                            images[_ACROSS, found], images[_ROW, found] = shift, row
                        found += 1
                    j = links[j]
                i = links[i]
    return found


@_compiled
def _index_pairs(pairs, found, offsets, of_grain):
    """The pairs of grain g are those in ``of_grain[offsets[g] : offsets[g + 1]]``."""
    for g in range(offsets.size):
        offsets[g] = 0
    for p in range(found):
        offsets[pairs[_FIRST, p] + 1] += 1
        offsets[pairs[_SECOND, p] + 1] += 1
    for g in range(1, offsets.size):
        offsets[g] += offsets[g - 1]
    for p in range(found):
        for end in range(2):
            g = pairs[end, p]
            of_grain[offsets[g]] = p
            offsets[g] += 1
    for g in range(offsets.size - 1, 0, -1):
        offsets[g] = offsets[g - 1]
    offsets[0] = 0


@_compiled
def _ask(p, t, earliest, horizon, side, rate, dt, theta, pairs, images, motion, grains, calendar):
    """Write into the calendar when, from the step ``earliest`` on, a pair is a contact if neither grain is struck.

    ``t`` is the present time, and ``horizon`` the time from now after which the list is no longer valid.
    """
    i, j = pairs[_FIRST, p], pairs[_SECOND, p]
    up = images[_ROW, p] * side
    ux, uy = motion[i, _VX] - motion[j, _VX] - rate * up, motion[i, _VY] - motion[j, _VY]
    dx = motion[i, _X] - motion[j, _X] - images[_ACROSS, p] + ux * t
    dy = motion[i, _Y] - motion[j, _Y] - up + uy * t
    reach = grains[i, _RADIUS] + grains[j, _RADIUS]
    closing = dx * ux + dy * uy
    excess = dx * dx + dy * dy - reach * reach
    calendar[_STRIKES, p], calendar[_BEGINS, p], calendar[_ENDS, p] = _NEVER, _NEVER, -1
    if excess > 0.0 and excess + 2 * closing * horizon > 0.0:
        return  # apart, and the gap does not close while the list is valid
    speed = ux * ux + uy * uy
    discriminant = closing * closing - speed * excess
    if speed == 0.0:
        if excess <= 0.0:
            calendar[_BEGINS, p], calendar[_ENDS, p] = earliest, _NEVER - 1
        return
    if not discriminant >= 0.0:
        return
    root = math.sqrt(discriminant)
    now, per_step = t / dt, 1 / (speed * dt)
    turn = _step(np.ceil(now - closing * per_step))  # the first step in which the pair recedes
    enter = excess / ((root - closing) * dt) if closing < 0.0 else -(root + closing) * per_step
    begin = max(earliest, _step(np.ceil(now + enter - theta)))
    last = max(turn - 1, _step(np.floor(now + (root - closing) * per_step - theta)))
    if begin <= last and begin < _MANY:
        calendar[_BEGINS, p], calendar[_ENDS, p] = begin, last
        if begin < turn:
            calendar[_STRIKES, p] = begin


@_compiled
def _step(number):
    """The number as a step of the calendar: -1 for what is past or no number, and never beyond its end."""
    if number > _MANY:
        return int(_MANY)
    return int(number) if number > -1.0 else -1


@_compiled
def _next_strike(calendar, blocks):
    """The smallest entry of the strikes."""
    strike = _NEVER
    for p in range(blocks * _LANES):
        strike = min(strike, calendar[_STRIKES, p])
    return strike


@_compiled
def _contacts_of_step(k, calendar, blocks, met):
    """Write the pairs that are contacts in a step; more than there is room for are counted, not kept."""
    contacts, now = 0, np.int32(k)
    for block in range(blocks):
        inside = 0
        for p in range(block * _LANES, (block + 1) * _LANES):
            inside += (calendar[_BEGINS, p] <= now) & (now <= calendar[_ENDS, p])
        if inside > 0:
            for p in range(block * _LANES, (block + 1) * _LANES):
                if calendar[_BEGINS, p] <= now and now <= calendar[_ENDS, p]:
                    if contacts < met.size:
                        met[contacts] = p
                    contacts += 1
    return contacts


@_compiled
def _make_network(contacts, met, t, side, rate, pairs, images, motion, grains, ends, network, degree, touched):
    """Write the contacts of a step and their grains; returns their number, Σ min(0, u⁻)² and the deepest overlap."""
    hits, scale, deepest = 0, 0.0, 0.0
    for c in range(contacts):
        p = met[c]
        i, j = pairs[_FIRST, p], pairs[_SECOND, p]
        up = images[_ROW, p] * side
        ux, uy = motion[i, _VX] - motion[j, _VX] - rate * up, motion[i, _VY] - motion[j, _VY]
        dx = motion[i, _X] - motion[j, _X] - images[_ACROSS, p] + ux * t
        dy = motion[i, _Y] - motion[j, _Y] - up + uy * t
        distance = math.sqrt(dx * dx + dy * dy)
        dx, dy = dx / distance, dy / distance
        approach = ux * dx + uy * dy
        ends[_FIRST, c], ends[_SECOND, c] = i, j
        network[_NX, c], network[_NY, c], network[_APPROACH, c] = dx, dy, approach
        network[_DISTANCE, c], network[_IMPULSE, c] = distance, 0.0
        deepest = max(deepest, grains[i, _RADIUS] + grains[j, _RADIUS] - distance)
        scale += min(approach, 0.0) * approach
        for end in range(2):
            g = ends[end, c]
            if degree[g] == 0:
                touched[hits] = g
                hits += 1
            degree[g] += 1
    return hits, scale, deepest


@_compiled
def _solve_isolated(contacts, ends, network, grains, degree, parent, source):
    """Write the impulses of isolated pairs; collect the other contacts, and join their grains. Returns their number."""
    coupled = 0
    for c in range(contacts):
        i, j = ends[_FIRST, c], ends[_SECOND, c]
        if degree[i] == 1 and degree[j] == 1:
            mobility = grains[i, _INVERSE_MASS] + grains[j, _INVERSE_MASS]
            network[_IMPULSE, c] = max(0.0, -network[_APPROACH, c]) / mobility
        else:
            source[coupled] = c
            coupled += 1
            parent[_root(parent, i)] = _root(parent, j)
    return coupled


@_compiled
def _root(parent, grain):
    """A grain that stands for the cluster of the given one."""
    while parent[grain] != grain:
        parent[grain] = parent[parent[grain]]
        grain = parent[grain]
    return grain


@_compiled
def _sort_by_cluster(coupled, source, ends, network, parent, number, starts, scratch):
    """Number the clusters in which a contact approaches, and sort the contacts of these by cluster.

    Returns the number of clusters; the contacts of cluster m are ``source[starts[m] : starts[m + 1]]``.
    """
    clusters = 0
    for n in range(coupled):
        root = _root(parent, ends[_FIRST, source[n]])
        scratch[1, n] = root
        if network[_APPROACH, source[n]] < 0.0 and number[root] < 0:
            number[root] = clusters
            starts[clusters] = 0
            clusters += 1
    for n in range(coupled):
        m = number[scratch[1, n]]
        if m >= 0:
            starts[m] += 1
    total = 0
    for m in range(clusters):
        total += starts[m]
        starts[m] = total
    starts[clusters] = total
    for n in range(coupled - 1, -1, -1):
        m = number[scratch[1, n]]
        if m >= 0:
            starts[m] -= 1
            scratch[0, starts[m]] = source[n]
    for n in range(total):
        source[n] = scratch[0, n]
    return clusters


@_compiled
def _solve_cluster(
    start, stop, source, ends, network, grains, target, most_iterations, rows, stiff, scratch, turns, matrices
):
    """Write the impulses p₀ of one cluster at restitution zero.

    ``target`` is the squared residual to reach. Returns the iterations, the squared residual, and ok, iteration_limit,
    infeasible or nonfinite.
    """
    size = np.uint64(stop - start)
    sweeps = min(most_iterations, _SWEEPS)
    iterations, squared = _sweep(start, size, source, ends, network, grains, target, sweeps, rows, scratch, turns)
    jammed = _is_jammed(size, rows, scratch, turns)
    if squared > target and squared < math.inf and iterations < most_iterations:
        needed, squared = _descend(size, target, most_iterations - iterations, rows, stiff, scratch, turns, matrices)
        jammed = _is_jammed(size, rows, scratch, turns)  # the last iterate: impulses of the best may not have grown yet
        iterations += needed
        for c in range(size):
            rows[c, _P] = stiff[c, _BEST]
    for c in range(size):
        network[_IMPULSE, source[start + c]] = rows[c, _P]
    if squared <= target:
        return iterations, squared, _OK
    if not squared < math.inf:
        return iterations, squared, _NONFINITE
    return iterations, squared, _INFEASIBLE if jammed else _ITERATION_LIMIT


@_compiled
def _is_jammed(size, rows, scratch, turns):
    """Whether impulses have grown without moving anything: pᵀWp is far below −pᵀu⁻, which it is at a solution."""
    moved = felt = 0.0
    for c in range(size):
        i, j = scratch[_FIRST, c], scratch[_SECOND, c]
        fall = rows[c, _PULL_X] * (turns[j, 0] - turns[i, 0]) + rows[c, _PULL_Y] * (turns[j, 1] - turns[i, 1])
        moved -= rows[c, _P] * fall * rows[c, _MOBILITY]
        felt -= rows[c, _P] * rows[c, _DRIVE] * rows[c, _MOBILITY]
    return moved < JAMMED_RESPONSE * felt


@_compiled
def _sweep(start, size, source, ends, network, grains, target, most_sweeps, rows, scratch, turns):
    """Projected Gauss–Seidel sweeps with over-relaxation; returns their number and the squared residual.

    The update of a contact, without relaxation and over its reduced mass, is its residual min(W_cc p, u), so a sweep
    estimates the norm for nothing; that of one state decides. ``turns`` are the changes of the grains' velocities.
    """
    relaxation = _RELAXATION if size > _FEW else _RELAXATION_OF_FEW
    for c in range(size):
        s = source[start + c]
        i, j = ends[_FIRST, s], ends[_SECOND, s]
        scratch[_FIRST, c], scratch[_SECOND, c] = i, j
        nx, ny, mi, mj = network[_NX, s], network[_NY, s], grains[i, _INVERSE_MASS], grains[j, _INVERSE_MASS]
        reduced_mass = 1 / (mi + mj)
        rows[c, _PULL_X], rows[c, _PULL_Y] = nx * reduced_mass, ny * reduced_mass
        rows[c, _DRIVE] = network[_APPROACH, s] * reduced_mass
        rows[c, _IX], rows[c, _IY], rows[c, _JX], rows[c, _JY] = nx * mi, ny * mi, nx * mj, ny * mj
        rows[c, _MOBILITY], rows[c, _P] = mi + mj, 0.0
        turns[i, 0] = turns[i, 1] = turns[j, 0] = turns[j, 1] = 0.0
    sweeps, squared, going = 0, math.inf, True
    while going:
        seen = 0.0
        for c in range(size):
            i, j = scratch[_FIRST, c], scratch[_SECOND, c]
            fall = rows[c, _PULL_X] * (turns[j, 0] - turns[i, 0]) + rows[c, _PULL_Y] * (turns[j, 1] - turns[i, 1])
            old = rows[c, _P]
            change = max(relaxation * (fall - rows[c, _DRIVE]), -old)
            if change != 0.0:
                rows[c, _P] = old + change
                turns[i, 0] += change * rows[c, _IX]
                turns[i, 1] += change * rows[c, _IY]
                turns[j, 0] -= change * rows[c, _JX]
                turns[j, 1] -= change * rows[c, _JY]
                error = change * rows[c, _MOBILITY]
                seen += error * error
        sweeps += 1
        going = sweeps < most_sweeps and seen < math.inf
        if seen <= target * relaxation * relaxation or not going:
            squared = 0.0
            for c in range(size):
                i, j = scratch[_FIRST, c], scratch[_SECOND, c]
                fall = rows[c, _PULL_X] * (turns[j, 0] - turns[i, 0]) + rows[c, _PULL_Y] * (turns[j, 1] - turns[i, 1])
                error = min(rows[c, _P], rows[c, _DRIVE] - fall) * rows[c, _MOBILITY]
                squared += error * error
            going &= not squared <= target
    return sweeps, squared


@_compiled
def _descend(size, target, most_iterations, rows, stiff, scratch, turns, matrices):
    """The guarded method of Barzilai and Borwein (``methods``), from the impulses where the sweeps ended.

    Returns the products with W and the squared residual of the best iterate, whose impulses are in ``stiff``.
    """
    for c in range(size):
        for end in range(2):
            matrices[scratch[end, c], 0] = matrices[scratch[end, c], 1] = matrices[scratch[end, c], 2] = 0.0
    for c in range(size):
        nx, ny = rows[c, _PULL_X] * rows[c, _MOBILITY], rows[c, _PULL_Y] * rows[c, _MOBILITY]
        for end in range(2):
            g = scratch[end, c]
            matrices[g, 0] += nx * nx
            matrices[g, 1] += nx * ny
            matrices[g, 2] += ny * ny
    for c in range(size):
        nx, ny = rows[c, _PULL_X] * rows[c, _MOBILITY], rows[c, _PULL_Y] * rows[c, _MOBILITY]
        i, j = scratch[_FIRST, c], scratch[_SECOND, c]
        inverse_mass_i = nx * rows[c, _IX] + ny * rows[c, _IY]
        inverse_mass_j = nx * rows[c, _JX] + ny * rows[c, _JY]
        bound = _largest_eigenvalue(matrices, i) * inverse_mass_i + _largest_eigenvalue(matrices, j) * inverse_mass_j
        stiff[c, _BOUND], stiff[c, _STEP], stiff[c, _CHANGE], stiff[c, _BEST] = bound, 0.0, 0.0, rows[c, _P]
        stiff[c, _RESPONSE] = nx * (turns[i, 0] - turns[j, 0]) + ny * (turns[i, 1] - turns[j, 1])
    stride, momentum, before, best, squared = 1.0, -1, math.inf, math.inf, math.inf
    iterations = 0
    while iterations == 0 or (iterations < most_iterations and not squared <= target and squared < math.inf):
        push, descent = max(momentum, 0) / (max(momentum, 0) + 3.0), 0.0
        for c in range(size):
            i, j = scratch[_FIRST, c], scratch[_SECOND, c]
            old, bound = rows[c, _P], stiff[c, _BOUND]
            at = old + push * stiff[c, _STEP]
            slope = stiff[c, _RESPONSE] + push * stiff[c, _CHANGE] + rows[c, _DRIVE] * rows[c, _MOBILITY]
            new = max(0.0, at - stride * slope / bound)
            descent += (at - new) * (new - old) * bound
            stiff[c, _STEP] = new - old
            rows[c, _P] = new
            turns[i, 0] = turns[i, 1] = turns[j, 0] = turns[j, 1] = 0.0
        for c in range(size):
            i, j, press = scratch[_FIRST, c], scratch[_SECOND, c], rows[c, _P]
            turns[i, 0] += press * rows[c, _IX]
            turns[i, 1] += press * rows[c, _IY]
            turns[j, 0] -= press * rows[c, _JX]
            turns[j, 1] -= press * rows[c, _JY]
        squared = mixed = long = short = 0.0
        for c in range(size):
            i, j, bound = scratch[_FIRST, c], scratch[_SECOND, c], stiff[c, _BOUND]
            pull = rows[c, _PULL_X] * (turns[i, 0] - turns[j, 0]) + rows[c, _PULL_Y] * (turns[i, 1] - turns[j, 1])
            response = pull * rows[c, _MOBILITY]
            error = min(rows[c, _P], pull + rows[c, _DRIVE]) * rows[c, _MOBILITY]
            step, change = stiff[c, _STEP], response - stiff[c, _RESPONSE]
            stiff[c, _CHANGE], stiff[c, _RESPONSE] = change, response
            squared += error * error
            mixed += step * change
            long += step * step * bound
            short += change * change / bound
        if squared < best:
            best = squared
            for c in range(size):
                stiff[c, _BEST] = rows[c, _P]
        judged = iterations % WINDOW == WINDOW - 1
        if momentum >= 0 or (judged and not math.sqrt(best) < PROGRESS * before):
            momentum, stride = 0 if descent > 0.0 else max(momentum, -1) + 1, 1.0
        else:
            over, under = (mixed, short) if iterations % 2 == 0 else (long, mixed)
            stride = min(over / under, LONGEST_STRIDE) if under > 0.0 else LONGEST_STRIDE
        before = math.sqrt(best) if judged else before
        iterations += 1
    return iterations, best


@_compiled
def _largest_eigenvalue(matrices, g):
    xx, xy, yy = matrices[g, 0], matrices[g, 1], matrices[g, 2]
    return (xx + yy + math.sqrt((xx - yy) * (xx - yy) + 4 * xy * xy)) / 2


@_compiled
def _gather_kicks(contacts, hits, touched, bounce, ends, network, kicks, loaded):
    """Add up the impulses on every grain, and its contacts that carry one."""
    for h in range(hits):
        kicks[touched[h], 0] = kicks[touched[h], 1] = 0.0
    for c in range(contacts):
        push = bounce * network[_IMPULSE, c]
        if push > 0.0:
            i, j = ends[_FIRST, c], ends[_SECOND, c]
            kicks[i, 0] += push * network[_NX, c]
            kicks[i, 1] += push * network[_NY, c]
            kicks[j, 0] -= push * network[_NX, c]
            kicks[j, 1] -= push * network[_NY, c]
            loaded[i] += 1
            loaded[j] += 1


@_compiled
def _count(sums, contacts, bounce, ends, network, grains, kicks, loaded):
    """Add the contacts of one step to the sums: those entries of ``Sums.contacts`` that a tally reads."""
    pushes = singles = pxx = pxy = pyy = bxx = bxy = byy = cxx = cxy = cyy = loss = slip = overlap = 0.0
    loads = collisions = 0
    for c in range(contacts):
        i, j = ends[_FIRST, c], ends[_SECOND, c]
        nx, ny, approach, distance = network[_NX, c], network[_NY, c], network[_APPROACH, c], network[_DISTANCE, c]
        mi, mj = grains[i, _INVERSE_MASS], grains[j, _INVERSE_MASS]
        xx, xy, yy = nx * nx * distance, nx * ny * distance, ny * ny * distance
        overlap += max(grains[i, _RADIUS] + grains[j, _RADIUS] - distance, 0.0)
        if approach < 0.0:
            single = -bounce * approach / (mi + mj)
            collisions += 1
            singles += single
            bxx += single * xx
            bxy += single * xy
            byy += single * yy
        push = bounce * network[_IMPULSE, c]
        if push > 0.0:
            response = (nx * (kicks[i, 0] * mi - kicks[j, 0] * mj) + ny * (kicks[i, 1] * mi - kicks[j, 1] * mj)) / 2
            loads += 1
            pushes += push
            pxx += push * xx
            pxy += push * xy
            pyy += push * yy
            loss -= push * (approach + response)
            slip += push * (bounce / 2 * approach + response)
            if loaded[i] > 1 or loaded[j] > 1:
                cxx += push * xx
                cxy += push * xy
                cyy += push * yy
    at = _CONTACTS  # (7, 5): features times weights
    sums[at] += pushes
    sums[at + 1] += singles
    sums[at + 2] += contacts
    sums[at + 3] += loads
    sums[at + 4] += collisions
    sums[at + 5] += pxx
    sums[at + 6] += bxx
    sums[at + 10] += pxy
    sums[at + 11] += bxy
    sums[at + 15] += pyy
    sums[at + 16] += byy
    sums[at + 20] += loss
    sums[at + 27] += overlap
    sums[at + 30] += slip
    sums[_CLUSTERS] += cxx
    sums[_CLUSTERS + 1] += cxy
    sums[_CLUSTERS + 2] += cyy


@_compiled
def _count_solve(sums, iterations, residual, outcome, deepest):
    """Add one solve to the sums."""
    place = 0
    while place < _EDGES.size and residual > _EDGES[place]:
        place += 1
    sums[_SOLVES] += 1
    sums[_SOLVES + 1] += iterations
    sums[_SOLVES + 2] += outcome != _OK
    sums[_SOLVES + 3 + place] += 1
    sums[_LARGEST] = max(sums[_LARGEST], deepest)
    sums[_LARGEST + 1] = max(sums[_LARGEST + 1], residual)


# Words of eight bytes in the structures of ``xla/ffi/api/c_api.h``, whose layout is kept from version to version. A
# frame is (size, extensions, interface, context, stage, arguments, results, ...); arguments and results are (size,
# extensions, count, types, pointers); a buffer is (size, extensions, dtype, data, rank, dims). A frame that comes with
# an extension asks for the version that is spoken.
_EXTENSIONS, _INTERFACE, _ARGUMENTS, _RESULTS = 1, 2, 9, 14  # of a frame
_DATA, _DIMS = 3, 5  # of a buffer
_VERSION = 4  # of the interface: the minor version in the upper half, and the major one, 0, in the lower


@intrinsic
def _words(context, address):
    """The address as a pointer to words of eight bytes."""

    def generate(_, builder, signature, arguments):
        return builder.inttoptr(arguments[0], ir.IntType(64).as_pointer())

    return types.CPointer(types.int64)(types.int64), generate


@intrinsic
def _doubles(context, address):
    """The address as a pointer to numbers of double precision."""

    def generate(_, builder, signature, arguments):
        return builder.inttoptr(arguments[0], ir.DoubleType().as_pointer())

    return types.CPointer(types.float64)(types.int64), generate


@_compiled
def _data(buffers, k):
    return _words(_words(buffers)[k])[_DATA]


@_compiled
def _length(buffers, k):
    return _words(_words(_words(buffers)[k])[_DIMS])[0]


@cfunc(types.int64(types.int64), cache=True)
def handler(frame):
    """``advance_loop`` as XLA calls it: arguments and results are buffers of a call frame."""
    extension = _words(frame)[_EXTENSIONS]
    if extension != 0:
        metadata = _words(_words(extension)[3])
        metadata[3] = _words(_words(frame)[_INTERFACE])[_VERSION] >> 32 << 32
        return 0
    given, made = _words(frame)[_ARGUMENTS], _words(frame)[_RESULTS]
    grains = _length(given, 2)
    advance_loop(
        carray(_doubles(_data(given, 0)), (grains, 2)),
        carray(_doubles(_data(given, 1)), (grains, 2)),
        carray(_doubles(_data(given, 2)), (grains,)),
        carray(_doubles(_data(given, 3)), (grains,)),
        carray(_doubles(_data(given, 4)), (9,)),
        carray(_doubles(_data(made, 0)), (grains, 2)),
        carray(_doubles(_data(made, 1)), (grains, 2)),
        carray(_doubles(_data(made, 2)), (_SUMS,)),
    )
    return 0
