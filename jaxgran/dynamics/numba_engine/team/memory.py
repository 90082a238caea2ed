"""The arrays of a team, one behind the other from an address on: on a device there is nobody to ask
for memory.

They have the names of ``numba_engine.arrays``, so that both engines share the functions that read
and write them.
"""

# pyright: reportCallIssue=false

from typing import Any, NamedTuple

import numpy as np
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic
from numba.np.arrayobj import np_cfarray

from jaxgran.dynamics.numba_engine.arrays import CONSTANTS, CONTACT, ITERATE, MOTION
from jaxgran.dynamics.numba_engine.compilation import njit
from jaxgran.dynamics.tally import NUMBERS

PAIRS_PER_GRAIN = 16  # capacity
MOST_COLOURS = 32
_PER_GRAIN = sum(x.itemsize for x in (MOTION, CONSTANTS)) + 4 + 4 + 16 + 24 + 4 * 4  # bytes
_PER_PAIR = 2 * 4 + 2 * 8 + 3 * 4 + 4
_PER_CONTACT = 4 + 2 * 4 + 5 * 8 + 4 + 4 + 2 * 4 + CONTACT.itemsize + ITERATE.itemsize
_PADDING = 8 * 32  # of arrays that end within a word


class Grains(NamedTuple):
    """As in ``numba_engine.arrays``, in the order of the state."""

    motion: Any
    constants: Any


class Pairs(NamedTuple):
    """As in ``numba_engine.arrays``; in a search, listed has the ranks of the grains of a cell."""

    ends: Any
    images: Any
    calendar: Any
    listed: Any
    starts: Any
    cells: Any
    sorted: Any


class Network(NamedTuple):
    """As in ``numba_engine.arrays``, with the colours of contacts and grains as bits: contacts of
    one colour share no grain.
    """

    near_pair: Any
    ends: Any
    rows: Any
    loaded: Any
    impulses: Any
    colours: Any  # (grains,), of all contacts of a grain
    colour: Any  # (contacts,); 0 of isolated pairs, once they are solved


class Clusters(NamedTuple):
    """As in ``numba_engine.arrays``: all contacts but isolated pairs, sorted by colour."""

    source: Any
    starts: Any
    ends: Any
    rows: Any
    iterate: Any
    dv: Any
    matrices: Any


class Memory(NamedTuple):
    """All arrays of the time loop."""

    grains: Grains
    pairs: Pairs
    network: Network
    clusters: Clusters
    sums: Any  # (lanes, NUMBERS), the running sums of each lane


@intrinsic
def _array(context, address, shape, dtype):
    """``numba.carray`` at an address, in a function that counts no references."""
    axes = len(shape) if isinstance(shape, types.BaseTuple) else 1
    kind = types.Array(dtype.dtype, axes, "C")

    def generate(context, builder, signature, arguments):
        pointer = builder.inttoptr(arguments[0], cgutils.voidptr_t)
        inner = kind(types.voidptr, shape)
        return np_cfarray(context, builder, inner, (pointer, arguments[1]))

    return kind(types.int64, shape, dtype), generate


@njit
def array_at(address, shape, dtype):
    """An array at an address, and the next address of a whole word behind it."""
    array = _array(address, shape, dtype)
    return array, address + ((array.nbytes + 7) >> 3 << 3)


def words_needed(grains: int, lanes: int) -> int:
    """The words of eight bytes of one replica."""
    per_grain = _PER_GRAIN + PAIRS_PER_GRAIN * _PER_PAIR + 3 * _PER_CONTACT
    return lanes * NUMBERS + (per_grain * grains + 4 * MOST_COLOURS + _PADDING) // 8


@njit
def memory_at(address, grains, lanes):
    """The arrays for so many grains and lanes, and the address behind them."""
    count, contacts = np.int64(grains), 3 * np.int64(grains)
    slots = PAIRS_PER_GRAIN * count
    sums, address = array_at(address, (np.int64(lanes), NUMBERS), np.float64)
    motion, address = array_at(address, count, MOTION)
    constants, address = array_at(address, count, CONSTANTS)
    ends, address = array_at(address, (2, slots), np.uint32)
    images, address = array_at(address, (2, slots), np.float64)
    calendar, address = array_at(address, (3, slots), np.int32)
    listed, address = array_at(address, slots, np.uint32)
    cell_starts, address = array_at(address, max(9, 2 * count) + 1, np.uint32)
    cells, address = array_at(address, count, np.uint32)
    in_cells, address = array_at(address, count, np.uint32)
    near_pair, address = array_at(address, contacts, np.uint32)
    contact_ends, address = array_at(address, (2, contacts), np.uint32)
    rows, address = array_at(address, (5, contacts), np.float64)
    loaded, address = array_at(address, count, np.int32)
    impulses, address = array_at(address, (count, 2), np.float64)
    colours, address = array_at(address, count, np.uint32)
    colour, address = array_at(address, contacts, np.uint32)
    source, address = array_at(address, contacts, np.uint32)
    starts, address = array_at(address, MOST_COLOURS + 1, np.uint32)
    solver_ends, address = array_at(address, (contacts, 2), np.uint32)
    solver_rows, address = array_at(address, contacts, CONTACT)
    iterate, address = array_at(address, contacts, ITERATE)
    matrices, address = array_at(address, (count, 3), np.float64)
    memory = Memory(
        Grains(motion, constants),
        Pairs(ends, images, calendar, listed, cell_starts, cells, in_cells),
        Network(near_pair, contact_ends, rows, loaded, impulses, colours, colour),
        Clusters(source, starts, solver_ends, solver_rows, iterate, impulses, matrices),
        sums,
    )
    return memory, address
