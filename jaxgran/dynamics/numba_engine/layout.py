"""The memory layout of the numba engine, and the groups of arrays that its functions take.

Arrays are passed whole and indexed by row and column. Indices are unsigned, which spares a test for
negative ones. Nothing here imports the compiler, so a cached engine runs without it.
"""

from typing import Any, NamedTuple

import numpy as np

from jaxgran.dynamics.tally import NUMBERS
from jaxgran.model.status import Status

INPUTS = 9  # numbers of a flow and of its advance
STATUS, TILT, SUSPENDED, RECORDED, KINETIC, DRIFT = range(NUMBERS, NUMBERS + 6)  # behind the sums
RESULTS = NUMBERS + 6
BETWEEN_LISTS, WITHIN_LIST = 1, 2  # where a suspended loop goes on
SAVED = 15  # numbers of a suspended loop, behind its sums
WORDS, WORDS_PER_GRAIN = (
    2048 + 2 * NUMBERS + SAVED,
    189,
)  # of eight bytes: bounds of the memory that ``allocation`` divides

X, Y, VX, VY = range(4)  # columns of the motion of the grains
RADIUS, INVERSE_MASS = range(2)  # columns of the grains
FIRST, SECOND = range(2)  # rows of the ends of a pair, and of a contact
WAITING, DONE = 1, 2  # of a grain in the search of clusters; 0 before it is reached
ACROSS, ROW = range(2)  # rows of the images: r_i − r_j − (across, row·L) is the separation
STRIKES, BEGINS, ENDS = range(3)  # rows of the calendar, in steps since the search
NX, NY, APPROACH, DISTANCE, IMPULSE = range(5)  # rows of the network
# Columns of a contact in the solver: μ n, μ u⁻, 1/μ, 1/(μ m_i), 1/(μ m_j) and p, with the reduced
# mass μ.
MU_NX, MU_NY, MU_U, INVERSE_MU, INVERSE_MU_MI, INVERSE_MU_MJ, P = range(7)
AT_STEP, ACTED, CONTACTS, TILTED, RECORD_HEAD = range(
    5
)  # columns of a record; behind them its grains and contacts
RECORD_OF_GRAIN, RECORD_OF_CONTACT = (
    4,
    7,
)  # numbers of a record for each grain, and for each contact
RESPONSE, STEP, CHANGE, BEST, BOUND = range(5)  # columns of the same for a stiff cluster

NEVER = np.int32(2**31 - 1)  # a step of the calendar that does not come
MANY = 2.0**30  # steps, the end of the calendar
LANES = 64  # entries of the calendar that are compared together
LEAST_SHIFT = 5  # blocks of entries are of 2**5 at least
EPSILON = float(np.finfo(np.float64).eps)
OK, ITERATION_LIMIT = int(Status.ok), int(Status.iteration_limit)
INFEASIBLE, CAPACITY, NONFINITE = (
    int(Status.infeasible),
    int(Status.capacity),
    int(Status.nonfinite),
)
FAILED = int(Status.failed)


def record_numbers(grains: int) -> int:
    """Numbers of a record; contacts of discs form a planar graph."""
    return RECORD_HEAD + (RECORD_OF_GRAIN + 3 * RECORD_OF_CONTACT) * grains


class Flow(NamedTuple):
    """Numbers of a flow that do not change: side of the cell, shear rate, dt, θ, 1 + α, tolerance,
    most iterations.
    """

    side: Any
    rate: Any
    dt: Any
    theta: Any
    one_plus_alpha: Any
    tolerance: Any
    most_iterations: Any


class Grains(NamedTuple):
    """The grains. Positions in the laboratory are r + v t with t counted from the last search for
    near pairs.

    motion: (grains, 4), r and v in the laboratory; constants: (grains, 2), radius and inverse mass.
    """

    motion: Any
    constants: Any


class Order(NamedTuple):
    """The order of the grains in memory: ``given[g]`` is the place of grain g in the state.

    given: (grains,); cells, starts: (grains,) and (grains + 2,), for the sorting.
    """

    given: Any
    cells: Any
    starts: Any


class Pairs(NamedTuple):
    """Near pairs, padded to whole ``LANES``, with a spare slot for a pair beyond the room.

    ends: (2, slots) grains; images: (2, slots); calendar: (3, slots) steps; bounds: (2, blocks) the
      least strike and begin of a block of the calendar, or less; of_grain: (2 room,) pairs of the
      grains, those of grain g at ``offsets[g] : offsets[g + 1]``. For the search: starts: (cells +
      1,); cells, sorted: (grains,) the cell of each grain, and the grains in the order of the
      cells; places: (3, grains) x, y and radius of these. listed: (slots,) pairs to be predicted;
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

    met: (contacts,) pairs; ends: (2, contacts) grains; rows: (5, contacts); touched: (grains,) the
      grains with contacts. For each grain: degree, its contacts; loaded, those with an impulse;
      kicks, (grains, 2) total impulse.
    """

    met: Any
    ends: Any
    rows: Any
    touched: Any
    degree: Any
    loaded: Any
    kicks: Any


class Clusters(NamedTuple):
    """Contacts that touch each other, sorted by cluster, and the memory of their solver.

    source: (contacts,) places in the network; those of cluster m at ``starts[m] : starts[m + 1]``;
      of_grain: (2 contacts,) contacts of the grains, those of grain g from ``offsets[g]`` on;
      queue, reached: (grains,) for the search for clusters. Of the cluster that is solved: places:
      (contacts,) in the network; ends: (contacts, 2) grains;
    rows: (contacts, 8); stiff: (contacts, 5); dv: (grains, 2) changes of velocity; matrices:
      (grains, 3) Σ n ⊗ n.
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
    stiff: Any
    dv: Any
    matrices: Any
