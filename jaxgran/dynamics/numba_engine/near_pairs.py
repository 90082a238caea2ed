"""Near pairs of grains, found through a grid of cells, and how long a list of them is valid."""

import math

import numpy as np

from jaxgran.dynamics.numba_engine.compilation import CELL, njit, whole_part
from jaxgran.dynamics.numba_engine.layout import FIRST, IMAGE_ROW, IMAGE_X, SECOND
from jaxgran.dynamics.numba_engine.motion import sort_by_cell

nearest_image = CELL["nearest_image"]

# strain: the longest life of a list, in which a peculiar speed grows by a factor of 1.1 at most
LIFE = 0.1
ATTEMPTS = 12  # with ever narrower skins, while a list has more pairs than room


@njit
def closing_speed_bound(max_speed, shear_rate, distance, look_ahead):
    """Bound on how fast the gap of a pair within a distance closes while a list is valid and in the
    look-ahead beyond, see ``dynamics.step``.
    """
    return 2 * max_speed * (1 + LIFE + shear_rate * look_ahead) + shear_rate * distance / 2


@njit
def search(grains, pairs, side, tilt, largest_diameter, skin):
    """Write the pairs with a gap within a skin, which is narrowed until there is room for all of
    them.

    Returns their number, the skin, and whether there was room.
    """
    capacity = pairs.of_grain.size // 2
    count = 0
    for _ in range(ATTEMPTS):
        count = find_near_pairs(grains, pairs, side, tilt, largest_diameter + skin, skin, capacity)
        if count <= capacity:
            break
        skin *= 0.7
    kept = min(count, capacity)
    _index_pairs(pairs, kept)
    return kept, skin, count <= capacity


@njit
def find_near_pairs(grains, pairs, side, tilt, reach, skin, capacity):
    """Write the pairs with a gap within the skin, and their images; pairs beyond the capacity
    are counted, not written.
    """
    rows, columns = grid_of(reach, side, tilt, pairs.starts.size - 1)
    if rows > 0:
        _sort_into_cells(grains, pairs, side, tilt, rows, columns)
        return _pairs_of_cells(pairs, side, tilt, rows, columns, skin, capacity)
    return _pairs_of_all(grains, pairs, side, tilt, skin, capacity)


@njit
def grid_of(reach, side, tilt, most_cells):
    """Rows and columns of a grid whose cells are as wide as the reach; none where it would be
    smaller than 3×3.
    """
    most = math.sqrt(most_cells)
    rows = whole_part(side / reach, most)
    columns = whole_part(side / (reach * math.sqrt(1.0 + tilt * tilt)), most)
    return (rows, columns) if rows >= 3 and columns >= 3 else (0, 0)


@njit
def cell_of(x, y, side, tilt, rows, columns):
    """The number of the cell of a place, row by row."""
    row = whole_part(y / side * rows, rows - 1)
    return row * columns + whole_part((x - tilt * y) / side * columns, columns - 1)


@njit
def stretch_of(part, row, column, rows, columns, starts):
    """Half of the cells around a cell in four stretches of sorted grains: itself and its right
    neighbour, the three above it, and those of either across the boundary; returns the first grain,
    the end, and the column and the row of the image.
    """
    cell = row * columns + column
    above, image_above = (row + 1) * columns, 0  # first cell of the next row, and its image
    if row + 1 == rows:
        above, image_above = 0, 1
    begin = end = image_column = image_row = 0
    if part == 0:
        begin, end = starts[cell], starts[cell + 1 if column + 1 == columns else cell + 2]
    elif part == 1 and column + 1 == columns:
        begin, end = starts[row * columns], starts[row * columns + 1]
        image_column = 1
    elif part == 2:
        begin = starts[above + max(column - 1, 0)]
        end = starts[above + min(column + 2, columns)]
        image_row = image_above
    elif part == 3 and column == 0:
        begin, end = starts[above + columns - 1], starts[above + columns]
        image_column, image_row = -1, image_above
    elif part == 3 and column + 1 == columns:
        begin, end = starts[above], starts[above + 1]
        image_column, image_row = 1, image_above
    return begin, end, image_column, image_row


@njit
def _sort_into_cells(grains, pairs, side, tilt, rows, columns):
    """Sort the grains into cells row by row, and write their positions and radii in this order."""
    motion, constants, cells, places = grains.motion, grains.constants, pairs.cells, pairs.places
    for g in range(motion.size):
        cells[g] = cell_of(motion[g].x, motion[g].y, side, tilt, rows, columns)
    sort_by_cell(cells, rows * columns, pairs.starts, pairs.sorted)
    for n in range(motion.size):
        g = pairs.sorted[n]
        places[0, n], places[1, n], places[2, n] = motion[g].x, motion[g].y, constants[g].radius


@njit
def _pairs_of_cells(pairs, side, tilt, rows, columns, skin, capacity):
    """Pairs within each cell, with its right neighbour, and with the three above it."""
    starts, sorted_grains, places = pairs.starts, pairs.sorted, pairs.places
    ends, images = pairs.ends, pairs.images
    count = 0
    for cell in range(rows * columns):
        row, column = cell // columns, cell % columns
        for part in range(4):
            begin, end, image_column, image_row = stretch_of(
                part, row, column, rows, columns, starts
            )
            image_x, image_y = (image_column + image_row * tilt) * side, image_row * side
            for m in range(starts[cell], starts[cell + 1]):
                i, x, y = sorted_grains[m], places[0, m] - image_x, places[1, m] - image_y
                radius_and_skin = places[2, m] + skin
                for n in range(m + 1 if part == 0 else begin, end):
                    dx, dy = x - places[0, n], y - places[1, n]
                    reach = radius_and_skin + places[2, n]
                    # without a branch, which would be mispredicted
                    p = np.uint64(min(count, capacity))
                    ends[FIRST, p], ends[SECOND, p] = i, sorted_grains[n]
                    images[IMAGE_X, p], images[IMAGE_ROW, p] = image_x, image_row
                    count += dx * dx + dy * dy <= reach * reach
    return count


@njit
def _pairs_of_all(grains, pairs, side, tilt, skin, capacity):
    """Compare all pairs by nearest images, in a periodic cell too small for a grid of 3×3."""
    motion, constants, ends, images = grains.motion, grains.constants, pairs.ends, pairs.images
    count = 0
    for i in range(motion.size):
        for j in range(i):
            dx, dy = motion[i].x - motion[j].x, motion[i].y - motion[j].y
            column, row = nearest_image(dx, dy, side, tilt)
            image_x = column * side + row * tilt * side
            dx, dy = dx - image_x, dy - row * side
            reach = constants[i].radius + constants[j].radius + skin
            if dx * dx + dy * dy <= reach * reach:
                if count < capacity:
                    ends[FIRST, count], ends[SECOND, count] = i, j
                    images[IMAGE_X, count], images[IMAGE_ROW, count] = image_x, row
                count += 1
    return count


@njit
def _index_pairs(pairs, count):
    """The pairs of grain g are those in ``of_grain[offsets[g] : offsets[g + 1]]``."""
    ends, offsets, of_grain = pairs.ends, pairs.offsets, pairs.of_grain
    for g in range(offsets.size):
        offsets[g] = 0
    for p in range(count):
        offsets[ends[FIRST, p] + 1] += 1
        offsets[ends[SECOND, p] + 1] += 1
    for g in range(1, offsets.size):
        offsets[g] += offsets[g - 1]
    for p in range(count):
        for end in range(2):
            g = ends[end, p]
            of_grain[offsets[g]] = p
            offsets[g] += 1
    for g in range(offsets.size - 1, 0, -1):
        offsets[g] = offsets[g - 1]
    offsets[0] = 0
