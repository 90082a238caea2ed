"""Near pairs of grains, found through a grid of cells, and how long a list of them is valid."""

import math

import numpy as np

from jaxgran.dynamics.numba_engine.compilation import CELL, inline_njit, njit
from jaxgran.dynamics.numba_engine.layout import (
    FIRST,
    IMAGE_ROW,
    IMAGE_X,
    RADIUS,
    SECOND,
    X,
    Y,
)

nearest_image = CELL["nearest_image"]

# strain: the longest life of a list, in which a peculiar speed grows by a factor of 1.1 at most
LIFE = 0.1
_ATTEMPTS = 12  # with ever narrower skins, while a list has more pairs than room


@inline_njit
def closing_speed_bound(max_speed, shear_rate, distance):
    """Bound on how fast the gap of a pair within a distance closes while a list is valid, see
    ``dynamics.step``.
    """
    return 2 * max_speed * (1 + LIFE) + shear_rate * distance / 2


@njit
def search(grains, pairs, side, tilt, largest, skin):
    """Write the pairs with a gap within a skin, which is narrowed until there is room for all of
    them.

    Returns their number, the skin, and whether there was room.
    """
    room = pairs.of_grain.size // 2
    found = 0
    for _ in range(_ATTEMPTS):
        found = find_near_pairs(grains, pairs, side, tilt, largest + skin, skin, room)
        if found <= room:
            break
        skin *= 0.7
    kept = min(found, room)
    _index_pairs(pairs, kept)
    return kept, skin, found <= room


@njit
def find_near_pairs(grains, pairs, side, tilt, reach, skin, room):
    """Write the pairs with a gap within the skin, and their images; pairs beyond the room are
    counted, not written.
    """
    most = math.sqrt(pairs.starts.size - 1)
    up, along = (
        int(min(most, side / reach)),
        int(min(most, side / (reach * math.sqrt(1.0 + tilt * tilt)))),
    )
    if up >= 3 and along >= 3:
        _sort_into_cells(grains, pairs, side, tilt, up, along)
        return _pairs_of_cells(pairs, side, tilt, up, along, skin, room)
    return _pairs_of_all(grains, pairs, side, tilt, skin, room)


@inline_njit
def _sort_into_cells(grains, pairs, side, tilt, up, along):
    """Sort the grains into cells row by row, those of a cell at ``starts[cell] : starts[cell +
    1]``.
    """
    motion, constants = grains.motion, grains.constants
    starts, cells, sorted_grains, places = pairs.starts, pairs.cells, pairs.sorted, pairs.places
    for cell in range(up * along + 1):
        starts[cell] = 0
    for g in range(motion.shape[0]):
        row = min(max(int(motion[g, Y] / side * up), 0), up - 1)
        fraction = (motion[g, X] - tilt * motion[g, Y]) / side
        cells[g] = row * along + min(max(int(fraction * along), 0), along - 1)
        starts[cells[g] + 1] += 1
    for cell in range(up * along):
        starts[cell + 1] += starts[cell]
    for g in range(
        motion.shape[0] - 1, -1, -1
    ):  # a cell is filled from its end, which moves to its beginning
        starts[cells[g] + 1] -= 1
        n = starts[cells[g] + 1]
        sorted_grains[n] = g
        places[0, n], places[1, n], places[2, n] = motion[g, X], motion[g, Y], constants[g, RADIUS]
    for cell in range(up * along):
        starts[cell] = starts[cell + 1]
    starts[up * along] = motion.shape[0]


@inline_njit
def _pairs_of_cells(pairs, side, tilt, up, along, skin, room):
    """Pairs within each cell, with its right neighbour, and with the three above it."""
    starts, sorted_grains, places = pairs.starts, pairs.sorted, pairs.places
    ends, images = pairs.ends, pairs.images
    found = 0
    for cell in range(up * along):
        row, column = cell // along, cell % along
        above, over = (row + 1) * along, 0
        if row + 1 == up:
            above, over = 0, 1
        for part in range(4):  # stretches of cells in a row, those across the boundary apart
            begin = end = across = lift = 0
            if part == 0:
                end = starts[cell + 1 if column + 1 == along else cell + 2]
            elif part == 1 and column + 1 == along:
                begin, end, across = starts[row * along], starts[row * along + 1], 1
            elif part == 2:
                begin, end = (
                    starts[above + max(column - 1, 0)],
                    starts[above + min(column + 2, along)],
                )
                lift = over
            elif part == 3 and column == 0:
                begin, end, across, lift = (
                    starts[above + along - 1],
                    starts[above + along],
                    -1,
                    over,
                )
            elif part == 3 and column + 1 == along:
                begin, end, across, lift = starts[above], starts[above + 1], 1, over
            shift, rise = (across + lift * tilt) * side, lift * side
            for m in range(starts[cell], starts[cell + 1]):
                i, x, y, width = (
                    sorted_grains[m],
                    places[0, m] - shift,
                    places[1, m] - rise,
                    places[2, m] + skin,
                )
                for n in range(m + 1 if part == 0 else begin, end):
                    dx, dy, limit = x - places[0, n], y - places[1, n], width + places[2, n]
                    at = np.uint64(
                        min(found, room)
                    )  # without a branch, which would be mispredicted
                    ends[FIRST, at], ends[SECOND, at] = i, sorted_grains[n]
                    images[IMAGE_X, at], images[IMAGE_ROW, at] = shift, lift
                    found += dx * dx + dy * dy <= limit * limit
    return found


@inline_njit
def _pairs_of_all(grains, pairs, side, tilt, skin, room):
    """Compare all pairs by nearest images, in a periodic cell too small for a grid of 3×3."""
    motion, constants, ends, images = grains.motion, grains.constants, pairs.ends, pairs.images
    found = 0
    for i in range(motion.shape[0]):
        for j in range(i):
            dx, dy = motion[i, X] - motion[j, X], motion[i, Y] - motion[j, Y]
            column, row = nearest_image(dx, dy, side, tilt)
            shift = column * side + row * tilt * side
            dx, dy = dx - shift, dy - row * side
            limit = constants[i, RADIUS] + constants[j, RADIUS] + skin
            if dx * dx + dy * dy <= limit * limit:
                if found < room:
                    ends[FIRST, found], ends[SECOND, found] = i, j
                    images[IMAGE_X, found], images[IMAGE_ROW, found] = shift, row
                found += 1
    return found


@inline_njit
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
