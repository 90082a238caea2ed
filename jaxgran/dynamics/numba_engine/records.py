"""Records of the visited steps, for a user's functions: the grains, and the contacts with their
impulses.

A record is a row of numbers: its step, whether contacts act in it, how many there are, and the
tilt; then x, y, c_x and c_y of every grain before the contacts act; then i, j, n_x, n_y, u,
distance and impulse of every contact. Positions are not wrapped. A call begins with a record
without contacts.
"""

from jaxgran.dynamics.numba_engine.compilation import CELL, njit
from jaxgran.dynamics.numba_engine.layout import (
    APPROACH,
    DISTANCE,
    FIRST,
    IMPULSE,
    NX,
    NY,
    RECORD_APPROACH,
    RECORD_CONTACTS,
    RECORD_CX,
    RECORD_CY,
    RECORD_DISTANCE,
    RECORD_HEAD,
    RECORD_I,
    RECORD_IMPULSE,
    RECORD_J,
    RECORD_NX,
    RECORD_NY,
    RECORD_OF_CONTACT,
    RECORD_OF_GRAIN,
    RECORD_SOLVED,
    RECORD_STEP,
    RECORD_TILT,
    RECORD_X,
    RECORD_Y,
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
        record[at + RECORD_X], record[at + RECORD_Y] = motion[g].x + motion[g].vx * t, y
        record[at + RECORD_CX], record[at + RECORD_CY] = motion[g].vx - shear_rate * y, motion[g].vy


@njit
def record_contacts(record, contacts, one_plus_alpha, grains, network):
    """Add the contacts of a step and their impulses to its record."""
    ends, rows, in_state = network.ends, network.rows, grains.in_state
    record[RECORD_SOLVED], record[RECORD_CONTACTS] = 1.0, contacts
    for c in range(contacts):
        at = RECORD_HEAD + RECORD_OF_GRAIN * in_state.size + RECORD_OF_CONTACT * c
        record[at + RECORD_I] = in_state[ends[FIRST, c]]
        record[at + RECORD_J] = in_state[ends[SECOND, c]]
        record[at + RECORD_NX], record[at + RECORD_NY] = rows[NX, c], rows[NY, c]
        record[at + RECORD_APPROACH] = rows[APPROACH, c]
        record[at + RECORD_DISTANCE] = rows[DISTANCE, c]
        record[at + RECORD_IMPULSE] = one_plus_alpha * rows[IMPULSE, c]
