"""Near pairs of grains, found through a grid of cells, and how long a list of them is valid."""

import math

import numpy as np

from jaxgran.dynamics.machine_code.compiled import called, compiled
from jaxgran.dynamics.machine_code.layout import ACROSS, FIRST, INVERSE_MASS, RADIUS, ROW, SECOND, VX, VY, X, Y

LIFE = 0.1  # strain: the longest life of a list, in which a peculiar speed grows by 1.1 at most
_NARROWER = 12  # lists that are tried with ever narrower skins, where pairs are more than there is room for
_CACHED_GRAINS, _ROW_HEIGHT = 2000, 2.0  # larger flows are put in order, in cells of two diameters


@compiled
def skin_loss(fastest, rate, distance):
    """How much of its skin a list may lose in unit time, where pairs are within a distance."""
    return 2 * fastest * (1 + LIFE) + rate * distance / 2


@called
def put_in_order(positions, side, tilt, order):
    """Write an order that keeps neighbours close in memory: row by row, where a flow outgrows the caches."""
    given, cells, starts, count = order.given, order.cells, order.starts, order.given.size
    across = int(max(1.0, min(math.sqrt(count), side / _ROW_HEIGHT))) if count > _CACHED_GRAINS else 1
    for c in range(across * across + 1):
        starts[c] = 0
    for g in range(count):
        cells[g] = 0
        if across > 1 and abs(positions[g, 0]) < math.inf and abs(positions[g, 1]) < math.inf:
            row = min(max(int(positions[g, 1] / side * across), 0), across - 1)
            fraction = (positions[g, 0] - tilt * positions[g, 1]) / side
            column = int((fraction - math.floor(fraction)) * across)
            cells[g] = row * across + min(max(column, 0), across - 1)
        starts[cells[g] + 1] += 1
    for c in range(across * across):
        starts[c + 1] += starts[c]
    for g in range(count):
        given[starts[cells[g]]] = g
        starts[cells[g]] += 1


@compiled
def bring_into_cell(grains, side, tilt, rate):
    """Bring the grains into the cell, at the same peculiar velocities; returns the largest peculiar speed."""
    motion = grains.motion
    fastest = 0.0
    for g in range(motion.shape[0]):
        cx, cy = motion[g, VX] - rate * motion[g, Y], motion[g, VY]
        row = math.floor(motion[g, Y] / side)
        motion[g, Y] -= row * side
        motion[g, X] -= row * tilt * side
        motion[g, X] -= math.floor((motion[g, X] - tilt * motion[g, Y]) / side) * side
        motion[g, VX] = cx + rate * motion[g, Y]
        fastest = max(fastest, cx * cx + cy * cy)
    return math.sqrt(fastest)


@called
def search(grains, pairs, side, tilt, largest, skin):
    """Write the pairs with a gap within a skin, which is made narrower where there is no room for all of them.

    Returns their number, the skin, and whether there was room.
    """
    room = pairs.of_grain.size // 2
    found = 0
    for _ in range(_NARROWER):
        found = find_near_pairs(grains, pairs, side, tilt, largest + skin, skin, room)
        if found <= room:
            break
        skin *= 0.7
    kept = min(found, room)
    _index_pairs(pairs, kept)
    return kept, skin, found <= room


@called
def find_near_pairs(grains, pairs, side, tilt, reach, skin, room):
    """Write the pairs with a gap within the skin, and their images; what there is no room for is only counted."""
    motion, constants = grains.motion, grains.constants
    ends, images, heads, links = pairs.ends, pairs.images, pairs.heads, pairs.links
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
            row = min(max(int(motion[g, Y] / side * up), 0), up - 1)
            fraction = (motion[g, X] - tilt * motion[g, Y]) / side
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
                    dx, dy = motion[i, X] - motion[j, X], motion[i, Y] - motion[j, Y]
                    if small:
                        row = int(np.rint(dy / side))
                        shift = np.rint((dx - row * tilt * side) / side) * side + row * tilt * side
                    dx, dy = dx - shift, dy - row * side
                    limit = constants[i, RADIUS] + constants[j, RADIUS] + skin
                    if dx * dx + dy * dy <= limit * limit:
                        if found < room:
                            ends[FIRST, found], ends[SECOND, found] = i, j
                            images[ACROSS, found], images[ROW, found] = shift, row
                        found += 1
                    j = links[j]
                i = links[i]
    return found


@compiled
def _index_pairs(pairs, found):
    """The pairs of grain g are those in ``of_grain[offsets[g] : offsets[g + 1]]``."""
    ends, offsets, of_grain = pairs.ends, pairs.offsets, pairs.of_grain
    for g in range(offsets.size):
        offsets[g] = 0
    for p in range(found):
        offsets[ends[FIRST, p] + 1] += 1
        offsets[ends[SECOND, p] + 1] += 1
    for g in range(1, offsets.size):
        offsets[g] += offsets[g - 1]
    for p in range(found):
        for end in range(2):
            g = ends[end, p]
            of_grain[offsets[g]] = p
            offsets[g] += 1
    for g in range(offsets.size - 1, 0, -1):
        offsets[g] = offsets[g - 1]
    offsets[0] = 0


@compiled
def kinetic_sums(grains, rate):
    """Σ m c_x c_x, Σ m c_x c_y and Σ m c_y c_y, just after a search."""
    motion, constants = grains.motion, grains.constants
    xx = xy = yy = 0.0
    for g in range(motion.shape[0]):
        cx, cy, mass = motion[g, VX] - rate * motion[g, Y], motion[g, VY], 1 / constants[g, INVERSE_MASS]
        xx += mass * cx * cx
        xy += mass * cx * cy
        yy += mass * cy * cy
    return xx, xy, yy
