"""The grains in the laboratory frame: read from a state, moved, and written back."""

import math

import numpy as np

from jaxgran.dynamics.numba_engine.compilation import CELL, njit, whole_part

image_in_cell = CELL["image_in_cell"]

_CACHED_GRAINS, _ROW_HEIGHT = 2000, 2.0  # larger flows are put in order, in cells of two diameters


@njit
def put_in_order(positions, side, tilt, grains, pairs):
    """Write an order of the grains, row by row, that keeps neighbours close in memory if a flow
    outgrows the caches; ``pairs`` has memory for the sorting.
    """
    count, cells, across = len(positions), pairs.cells, 1
    if count > _CACHED_GRAINS:
        across = max(1, whole_part(side / _ROW_HEIGHT, math.sqrt(count)))
    for g in range(count):
        cells[g] = 0
        if across > 1:
            row = whole_part(positions[g, 1] / side * across, across - 1)
            fraction = (positions[g, 0] - tilt * positions[g, 1]) / side
            column = whole_part((fraction - np.floor(fraction)) * across, across - 1)
            cells[g] = row * across + column
    sort_by_cell(cells, across * across, pairs.starts, grains.in_state)


@njit
def sort_by_cell(cells, cell_count, starts, order):
    """Write the order of the grains by the number of their cell; those of a cell then stand at
    ``starts[cell] : starts[cell + 1]``.
    """
    for cell in range(cell_count + 1):
        starts[cell] = 0
    for g in range(cells.size):
        starts[cells[g] + 1] += 1
    for cell in range(cell_count):
        starts[cell + 1] += starts[cell]
    # A cell is filled from its end, which moves to its beginning
    for g in range(cells.size - 1, -1, -1):
        starts[cells[g] + 1] -= 1
        order[starts[cells[g] + 1]] = g
    for cell in range(cell_count):
        starts[cell] = starts[cell + 1]
    starts[cell_count] = cells.size


@njit
def read_state(positions, velocities, radii, masses, shear_rate, grains):
    """Copy the grains, with velocities of the laboratory; returns the largest diameter and whether
    all is finite.
    """
    motion, constants, in_state = grains.motion, grains.constants, grains.in_state
    largest_diameter, finite = 0.0, True
    for g in range(in_state.size):
        n = in_state[g]
        motion[g].x, motion[g].y = positions[n, 0], positions[n, 1]
        motion[g].vx = velocities[n, 0] + shear_rate * positions[n, 1]
        motion[g].vy = velocities[n, 1]
        constants[g].radius, constants[g].inverse_mass = radii[n], 1 / masses[n]
        largest_diameter = max(largest_diameter, 2 * radii[n])
        finite &= abs(motion[g].x) < math.inf and abs(motion[g].y) < math.inf
        finite &= abs(motion[g].vx) < math.inf and abs(motion[g].vy) < math.inf
    return largest_diameter, finite


@njit
def bring_into_cell(grains, side, tilt, shear_rate):
    """Bring the grains into the cell, at the same peculiar velocities; returns the largest peculiar
    speed.
    """
    motion = grains.motion
    squared_speed = 0.0
    for g in range(motion.size):
        cx, cy = motion[g].vx - shear_rate * motion[g].y, motion[g].vy
        row = np.floor(motion[g].y / side)
        motion[g].y -= row * side
        motion[g].x -= row * tilt * side
        motion[g].x -= np.floor((motion[g].x - tilt * motion[g].y) / side) * side
        motion[g].vx = cx + shear_rate * motion[g].y
        squared_speed = max(squared_speed, cx * cx + cy * cy)
    return math.sqrt(squared_speed)


@njit
def kinetic_sums(grains, shear_rate):
    """Σ m c_x c_x, Σ m c_x c_y and Σ m c_y c_y, just after a search."""
    motion, constants = grains.motion, grains.constants
    xx = xy = yy = 0.0
    for g in range(motion.size):
        cx, cy = motion[g].vx - shear_rate * motion[g].y, motion[g].vy
        mass = 1 / constants[g].inverse_mass
        xx += mass * cx * cx
        xy += mass * cx * cy
        yy += mass * cy * cy
    return xx, xy, yy


@njit
def move_grains(t, grains):
    """Move the grains to their positions at the time t since the search."""
    motion = grains.motion
    for g in range(motion.size):
        motion[g].x += motion[g].vx * t
        motion[g].y += motion[g].vy * t


@njit
def write_state(side, tilt, shear_rate, grains, new_positions, new_velocities):
    """Write the positions, in the cell, and the peculiar velocities of the grains."""
    motion = grains.motion
    for g in range(motion.size):
        n = grains.in_state[g]
        new_positions[n, 0], new_positions[n, 1] = image_in_cell(
            motion[g].x, motion[g].y, side, tilt
        )
        new_velocities[n, 0] = motion[g].vx - shear_rate * motion[g].y
        new_velocities[n, 1] = motion[g].vy


@njit
def write_motion(grains, new_positions, new_velocities):
    """Write the positions as they are, and the velocities in the laboratory."""
    motion = grains.motion
    for g in range(motion.size):
        n = grains.in_state[g]
        new_positions[n, 0], new_positions[n, 1] = motion[g].x, motion[g].y
        new_velocities[n, 0], new_velocities[n, 1] = motion[g].vx, motion[g].vy
