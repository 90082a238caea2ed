"""Readings of the velocity scales in the numba engine, as by ``dynamics.velocity_scales``."""

import math

import numpy as np

from jaxgran.dynamics.numba_engine.compilation import CELL, njit, whole_part
from jaxgran.dynamics.tally import place_of
from jaxgran.dynamics.velocity_scales import BOX_GRAINS, WAVES

remap_tilt = CELL["remap_tilt"]

DURATION, READ_UNTIL = place_of("duration"), place_of("read_until")
LOCAL, WAVE = place_of("local_kinetic"), place_of("wave_kinetic")
_AMPLITUDES = 4 * len(WAVES)  # real and imaginary parts of both components


@njit
def read_velocity_scales(t, tilt, flow, grains, network, clusters, sums):
    """Add a reading of the state at the time t since the search, which stands for the time since
    the last reading.

    ``tilt`` is that of the cell then. It uses memory of the contacts, which is free between steps.
    """
    count, boxes, amplitudes = grains.motion.size, clusters.matrices, network.step_sums
    across = max(1, int(np.rint(math.sqrt(count / BOX_GRAINS))))
    tilt = remap_tilt(tilt)
    for box in range(across * across):
        boxes[box, 0] = boxes[box, 1] = boxes[box, 2] = 0.0
    for n in range(_AMPLITUDES):
        amplitudes[n] = 0.0
    energy, total = 0.0, 0.0  # Σ m c² and Σ m
    for g in range(count):
        sx, sy, mass, cx, cy = place_and_velocity(g, t, tilt, flow, grains)
        px, py = mass * cx, mass * cy
        energy += px * cx + py * cy
        total += mass
        box = box_of(sx, sy, across)
        boxes[box, 0] += mass
        boxes[box, 1] += px
        boxes[box, 2] += py
        ca, sa = math.cos(2 * math.pi * sx), math.sin(2 * math.pi * sx)
        cb, sb = math.cos(2 * math.pi * sy), math.sin(2 * math.pi * sy)
        sum_cos, sum_sin = ca * cb - sa * sb, sa * cb + ca * sb
        difference_cos, difference_sin = ca * cb + sa * sb, sa * cb - ca * sb
        waves = (ca, sa, cb, sb, sum_cos, sum_sin, difference_cos, difference_sin)
        for n in range(len(waves)):
            amplitudes[2 * n] += waves[n] * px
            amplitudes[2 * n + 1] += waves[n] * py
    occupied = 0
    for box in range(across * across):
        mass, px, py = boxes[box, 0], boxes[box, 1], boxes[box, 2]
        if mass > 0.0:
            occupied += 1
            energy -= (px * px + py * py) / mass
    squares = 0.0
    for n in range(_AMPLITUDES):
        squares += amplitudes[n] * amplitudes[n]
    since = sums[DURATION] - sums[READ_UNTIL]
    sums[LOCAL] += since * energy / (2 * max(count - occupied, 1))
    sums[WAVE] += since * 2 * squares / (_AMPLITUDES * total)
    sums[READ_UNTIL] = sums[DURATION]


@njit
def place_and_velocity(g, t, tilt, flow, grains):
    """Place of a grain in the cell, from 0 to 1, its mass and its peculiar velocity."""
    motion, side = grains.motion, flow.side
    x, y = motion[g].x + motion[g].vx * t, motion[g].y + motion[g].vy * t
    cx, cy = motion[g].vx - flow.shear_rate * y, motion[g].vy
    sx, sy = (x - tilt * y) / side, y / side
    return sx - np.floor(sx), sy - np.floor(sy), 1 / grains.constants[g].inverse_mass, cx, cy


@njit
def box_of(sx, sy, across):
    """The number of the box of a place."""
    row, column = whole_part(sy * across, across - 1), whole_part(sx * across, across - 1)
    return across * row + column
