"""What the numba engine is given and returns, and the columns of its arrays. Nothing here imports
the compiler.
"""

from typing import Any, NamedTuple

import numpy as np

from jaxgran.dynamics.tally import NUMBERS
from jaxgran.model.status import Status

# Buffers of a call: what it is given, and what it returns
POSITIONS, VELOCITIES, RADII, MASSES, NUMBERS_GIVEN, STEPS, BEGIN = range(7)
NEW_POSITIONS, NEW_VELOCITIES, BLOCKS, RECORDS = range(4)

# Words of memory that the compiled code shares with Python: it runs while the first one is zero;
# its number of threads; and the address of its handler, which the threads call
STOP, THREADS, HANDLER, SHARED_WORDS = range(4)


class Inputs(NamedTuple):
    """Numbers of an advance, passed as one row of doubles in this order."""

    side: Any
    restitution: Any
    timestep: Any
    shear_rate: Any
    tolerance: Any
    activation: Any
    max_steps: Any


def doubles(*fields: str) -> np.dtype:
    """Named doubles side by side; aligned, as a device would load others byte by byte."""
    return np.dtype([(name, np.float64) for name in fields], align=True)


INPUTS = doubles(*Inputs._fields)
INPUT_NUMBERS = len(Inputs._fields)

# Columns of the results of a block, behind its sums: the status and the tilt; whether the call has
# ended early, with how many records, and then whether the contacts of the present step have been
# dealt with, and the number of collisions until the last reading of the velocity scales; kinetic
# energy and relative momentum at the end of each block but the last one. A call begins with such a
# row, which is that of an earlier call where it goes on with one.
STATUS, TILT, UNFINISHED, RECORDED, SOLVED, READ, KINETIC, DRIFT = range(NUMBERS, NUMBERS + 8)
RESULTS = NUMBERS + 8

FIRST, SECOND = range(2)  # rows of the ends of a pair, and of a contact
WAITING, DONE = 1, 2  # of a grain in the search for clusters; 0 before it is reached
IMAGE_X, IMAGE_ROW = range(2)  # rows of the images: r_i − r_j − (x, row·ℓ) is the separation
STRIKES, BEGINS, ENDS = range(3)  # rows of the calendar, in steps since the search
NX, NY, APPROACH, DISTANCE, IMPULSE = range(5)  # rows of the network
# Columns of a record; behind this head its grains, then its contacts
RECORD_STEP, RECORD_SOLVED, RECORD_CONTACTS, RECORD_TILT, RECORD_HEAD = range(5)
RECORD_OF_GRAIN = 4  # numbers: x, y, c_x and c_y
RECORD_I, RECORD_J, RECORD_OF_CONTACT = 5, 6, 7  # behind the rows of the network

NEVER = np.int32(2**31 - 1)  # a step of the calendar that does not come
MANY = 2.0**30  # steps, the end of the calendar
KERNEL, WARP = "jaxgran_advance", 32  # on a CUDA device: its name, and the lanes of a replica
LANES = 64  # entries of the calendar that are compared together
LEAST_SHIFT = 5  # blocks of entries are of 2**5 at least
EPSILON = float(np.finfo(np.float64).eps)
OK, ITERATION_LIMIT = int(Status.ok), int(Status.iteration_limit)
INFEASIBLE, CAPACITY = int(Status.infeasible), int(Status.capacity)
NONFINITE, FAILED = int(Status.nonfinite), int(Status.failed)


def record_numbers(grains: int) -> int:
    """Numbers of a record; contacts of discs form a planar graph."""
    return RECORD_HEAD + (RECORD_OF_GRAIN + 3 * RECORD_OF_CONTACT) * grains


class Flow(NamedTuple):
    """Numbers of a flow and its solver that do not change."""

    side: Any
    shear_rate: Any
    timestep: Any
    activation: Any
    one_plus_alpha: Any
    tolerance: Any
    max_steps: Any
