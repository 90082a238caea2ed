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
    largest_diameter, finite = 0.0, True
    for g in range(grains.in_state.size):
        n = grains.in_state[g]
        finite &= read_grain(g, n, positions, velocities, radii, masses, shear_rate, grains)
        largest_diameter = max(largest_diameter, 2 * radii[n])
    return largest_diameter, finite


@njit
def read_grain(g, n, positions, velocities, radii, masses, shear_rate, grains):
    """Copy grain n of the state to place g; returns whether it is finite."""
    motion, constants = grains.motion, grains.constants
    motion[g].x, motion[g].y = positions[n, 0], positions[n, 1]
    motion[g].vx = velocities[n, 0] + shear_rate * positions[n, 1]
    motion[g].vy = velocities[n, 1]
    constants[g].radius, constants[g].inverse_mass = radii[n], 1 / masses[n]
    finite = abs(motion[g].x) < math.inf and abs(motion[g].y) < math.inf
    finite &= abs(motion[g].vx) < math.inf and abs(motion[g].vy) < math.inf
    return finite


@njit
def bring_into_cell(grains, side, tilt, shear_rate):
    """Bring the grains into the cell, at the same peculiar velocities; returns the largest peculiar
    speed.
    """
    squared_speed = 0.0
    for g in range(grains.motion.size):
        squared_speed = max(squared_speed, bring_grain_into_cell(g, grains, side, tilt, shear_rate))
    return math.sqrt(squared_speed)


@njit
def bring_grain_into_cell(g, grains, side, tilt, shear_rate):
    """Bring a grain into the cell; returns the square of its peculiar speed."""
    motion = grains.motion
    cx, cy = motion[g].vx - shear_rate * motion[g].y, motion[g].vy
    row = np.floor(motion[g].y / side)
    motion[g].y -= row * side
    motion[g].x -= row * tilt * side
    motion[g].x -= np.floor((motion[g].x - tilt * motion[g].y) / side) * side
    motion[g].vx = cx + shear_rate * motion[g].y
    return cx * cx + cy * cy


@njit
def kinetic_sums(grains, shear_rate):
    """Σ m c_x c_x, Σ m c_x c_y and Σ m c_y c_y, just after a search."""
    kinetic = 0.0, 0.0, 0.0
    for g in range(grains.motion.size):
        kinetic = with_grain(g, grains, shear_rate, kinetic)
    return kinetic


@njit
def with_grain(g, grains, shear_rate, kinetic):
    """Σ m c ⊗ c with another grain."""
    motion, mass = grains.motion, 1 / grains.constants[g].inverse_mass
    xx, xy, yy = kinetic
    cx, cy = motion[g].vx - shear_rate * motion[g].y, motion[g].vy
    return xx + mass * cx * cx, xy + mass * cx * cy, yy + mass * cy * cy


@njit
def move_grains(t, grains):
    """Move the grains to their positions at the time t since the search."""
    for g in range(grains.motion.size):
        move_grain(g, t, grains)


@njit
def move_grain(g, t, grains):
    """Move a grain."""
    motion = grains.motion
    motion[g].x += motion[g].vx * t
    motion[g].y += motion[g].vy * t


@njit
def write_state(side, tilt, shear_rate, grains, new_positions, new_velocities):
    """Write the positions, in the cell, and the peculiar velocities of the grains."""
    for g in range(grains.motion.size):
        n = grains.in_state[g]
        write_grain(g, n, side, tilt, shear_rate, grains, new_positions, new_velocities)


@njit
def write_grain(g, n, side, tilt, shear_rate, grains, new_positions, new_velocities):
    """Write the grain at place g as grain n of the state."""
    motion = grains.motion
    new_positions[n, 0], new_positions[n, 1] = image_in_cell(motion[g].x, motion[g].y, side, tilt)
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
