"""Records of the visited steps, for a user's functions: the grains, and the contacts with their
impulses.

A record is a row of numbers: its step, whether contacts act in it, how many there are, and the
tilt; then x, y, c_x and c_y of every grain before the contacts act; then n_x, n_y, u⁻, distance,
impulse, i and j of every contact. Positions are not wrapped. A call begins with a record without
contacts.
"""

from jaxgran.dynamics.numba_engine.compilation import CELL, njit
from jaxgran.dynamics.numba_engine.layout import (
    FIRST,
    IMPULSE,
    RECORD_CONTACTS,
    RECORD_HEAD,
    RECORD_I,
    RECORD_J,
    RECORD_OF_CONTACT,
    RECORD_OF_GRAIN,
    RECORD_SOLVED,
    RECORD_STEP,
    RECORD_TILT,
    SECOND,
)

remap_tilt = CELL["remap_tilt"]


@njit
def record_flight(record, step, solved, tilt, t, shear_rate, grains):
    """Record the grains at the time t since the search, without contacts; ``solved``: whether those
    have been.
    """
    motion, in_state = grains.motion, grains.in_state
    record[RECORD_STEP], record[RECORD_SOLVED], record[RECORD_CONTACTS] = step, solved, 0.0
    record[RECORD_TILT] = remap_tilt(tilt)
    for g in range(in_state.size):
        at = RECORD_HEAD + RECORD_OF_GRAIN * in_state[g]
        y = motion[g].y + motion[g].vy * t
        record[at], record[at + 1] = motion[g].x + motion[g].vx * t, y
        record[at + 2], record[at + 3] = motion[g].vx - shear_rate * y, motion[g].vy


@njit
def record_contacts(record, contacts, one_plus_alpha, grains, network):
    """Add the contacts of a step and their impulses to its record."""
    ends, rows, in_state = network.ends, network.rows, grains.in_state
    record[RECORD_SOLVED], record[RECORD_CONTACTS] = 1.0, contacts
    for c in range(contacts):
        at = RECORD_HEAD + RECORD_OF_GRAIN * in_state.size + RECORD_OF_CONTACT * c
        for row in range(IMPULSE):
            record[at + row] = rows[row, c]
        record[at + IMPULSE] = one_plus_alpha * rows[IMPULSE, c]
        record[at + RECORD_I] = in_state[ends[FIRST, c]]
        record[at + RECORD_J] = in_state[ends[SECOND, c]]
