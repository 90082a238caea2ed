"""The memory layout of the numba engine, and the groups of arrays that its functions take.

Arrays are passed whole and indexed by row and column. Indices are unsigned, which spares a test for
negative ones. Nothing here imports the compiler, so a cached engine runs without it.
"""

from typing import Any, NamedTuple

import numpy as np

from jaxgran.dynamics.tally import NUMBERS
from jaxgran.model.status import Status

# Buffers of a call: what it is given, and what it returns
POSITIONS, VELOCITIES, RADII, MASSES, NUMBERS_GIVEN, STEPS, MEMORY_GIVEN = range(7)
NEW_POSITIONS, NEW_VELOCITIES, BLOCKS, MEMORY, RECORDS = range(5)


class Inputs(NamedTuple):
    """Numbers of an advance, passed as one row of doubles in this order.

    status: that of the state and the flow before the first step.
    resume_at: where an earlier call was suspended, ``BETWEEN_LISTS`` or ``WITHIN_LIST``; 0 to
    begin.
    """

    side: Any
    tilt: Any
    restitution: Any
    timestep: Any
    shear_rate: Any
    tolerance: Any
    activation: Any
    max_steps: Any
    status: Any
    resume_at: Any


INPUTS = np.dtype([(name, np.float64) for name in Inputs._fields])
INPUT_NUMBERS = len(Inputs._fields)
BETWEEN_LISTS, WITHIN_LIST = 1, 2  # where a loop is suspended

# What a suspended loop keeps beside its sums: first numbers of the advance, then of the list in
# use; the names are those of the variables of ``loop``.
SAVED = np.dtype(
    [
        ("tilt", np.float64),
        ("largest_diameter", np.float64),
        ("steps_before_list", np.int64),
        ("solved", np.int64),
        ("status", np.int64),
        ("collisions_read", np.float64),
        ("k", np.int64),
        ("pair_count", np.int64),
        ("skin", np.float64),
        ("closing_speed", np.float64),
        ("slack", np.float64),
        ("max_speed", np.float64),
        ("kinetic_xx", np.float64),
        ("kinetic_xy", np.float64),
        ("kinetic_yy", np.float64),
    ]
)
SAVED_NUMBERS = SAVED.itemsize // 8

# Columns of the results of a block, behind its sums
STATUS, TILT, SUSPENDED, RECORDED, KINETIC, DRIFT = range(NUMBERS, NUMBERS + 6)
RESULTS = NUMBERS + 6
# Bounds of the memory that ``allocation`` divides, in words of eight bytes
WORDS = 2048 + 2 * NUMBERS + SAVED_NUMBERS
WORDS_PER_GRAIN = 189

X, Y, VX, VY = range(4)  # columns of the motion of the grains
RADIUS, INVERSE_MASS = range(2)  # columns of the grains
FIRST, SECOND = range(2)  # rows of the ends of a pair, and of a contact
WAITING, DONE = 1, 2  # of a grain in the search for clusters; 0 before it is reached
IMAGE_X, IMAGE_ROW = range(2)  # rows of the images: r_i − r_j − (x, row·ℓ) is the separation
STRIKES, BEGINS, ENDS = range(3)  # rows of the calendar, in steps since the search
NX, NY, APPROACH, DISTANCE, IMPULSE = range(5)  # rows of the network
# Columns of a contact in the solver: μ n, μ u⁻, 1/μ, 1/(μ m_i), 1/(μ m_j) and J, with the reduced
# mass μ
MU_NX, MU_NY, MU_U, INVERSE_MU, INVERSE_MU_MI, INVERSE_MU_MJ, J = range(7)
# Columns of a contact in the method of Barzilai and Borwein: W J, the last changes of J and of W J,
# J of the best iterate, and the diagonal D
RESPONSE, STEP, RESPONSE_CHANGE, BEST, BOUND = range(5)
# Columns of a record; behind this head its grains, then its contacts
RECORD_STEP, RECORD_SOLVED, RECORD_CONTACTS, RECORD_TILT, RECORD_HEAD = range(5)
# Columns of a recorded grain and of a recorded contact, and how many these are
RECORD_X, RECORD_Y, RECORD_CX, RECORD_CY, RECORD_OF_GRAIN = range(5)
RECORD_I, RECORD_J, RECORD_NX, RECORD_NY, RECORD_APPROACH, RECORD_DISTANCE = range(6)
RECORD_IMPULSE, RECORD_OF_CONTACT = 6, 7

NEVER = np.int32(2**31 - 1)  # a step of the calendar that does not come
MANY = 2.0**30  # steps, the end of the calendar
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


class Grains(NamedTuple):
    """The grains. Positions in the laboratory are r + v t with t counted from the last search for
    near pairs.

    motion: (grains, 4), r and v in the laboratory.
    constants: (grains, 2), radius and inverse mass.
    """

    motion: Any
    constants: Any


class Order(NamedTuple):
    """The order of the grains in memory.

    in_state: (grains,), the index of each grain in the state.
    cells, starts: (grains,) and (grains + 2,), for the sorting.
    """

    in_state: Any
    cells: Any
    starts: Any


class Pairs(NamedTuple):
    """Near pairs, padded to whole ``LANES``, with a spare slot for a pair beyond the capacity.

    ends: (2, slots), grains.
    images: (2, slots).
    calendar: (3, slots), steps.
    bounds: (2, blocks), the least strike and begin of a block of the calendar, or less.
    of_grain: (2 capacity,), pairs of the grains, those of grain g at
      ``offsets[g] : offsets[g + 1]``.
    starts, cells, sorted: for the search, (cells + 1,), the cell of each grain, and the grains in
      the order of the cells.
    places: (3, grains), x, y and radius of these.
    listed: (slots,), pairs to be predicted.
    flights, entries: (5, LANES) and (3, LANES), scratch memory of a prediction.
    """

    ends: Any
    images: Any
    calendar: Any
    bounds: Any
    of_grain: Any
    offsets: Any
    starts: Any
    cells: Any
    sorted: Any
    places: Any
    listed: Any
    flights: Any
    entries: Any


class Network(NamedTuple):
    """The contacts of one step and the grains that they touch.

    near_pair: (contacts,), the pair of each contact.
    ends: (2, contacts), grains.
    rows: (5, contacts).
    touched: (grains,), the grains with contacts.
    degree, loaded: (grains,), contacts of each grain, and those with an impulse.
    impulses: (grains, 2), total impulse of each grain.
    """

    near_pair: Any
    ends: Any
    rows: Any
    touched: Any
    degree: Any
    loaded: Any
    impulses: Any


class Clusters(NamedTuple):
    """Contacts that touch each other, sorted by cluster, and the memory of their solver.

    source: (contacts,), indices in the network; those of cluster m at
      ``starts[m] : starts[m + 1]``.
    of_grain: (2 contacts,), contacts of the grains, those of grain g from ``offsets[g]`` on.
    queue, reached: (grains,), for the search for clusters.

    Of the cluster that is solved:

    places: (contacts,), indices in the network.
    ends: (contacts, 2), grains.
    rows: (contacts, 8).
    iterate: (contacts, 5), for the method of Barzilai and Borwein.
    dv: (grains, 2), changes of velocity.
    matrices: (grains, 3), Σ n ⊗ n.
    """

    source: Any
    starts: Any
    of_grain: Any
    offsets: Any
    queue: Any
    reached: Any
    places: Any
    ends: Any
    rows: Any
    iterate: Any
    dv: Any
    matrices: Any
