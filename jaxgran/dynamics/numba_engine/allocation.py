"""The arrays of the numba engine, cut from one block of memory.

The handler allocates the block, one for each replica, unless XLA keeps it for another call. So the
engine needs no runtime of numba. That is why an intrinsic makes the arrays, by
``numba.np.arrayobj``: the public ``numba.carray`` needs the runtime.
"""

# pyright: reportCallIssue=false
# An intrinsic of numba is called without the context that it is defined with.

from typing import Any, NamedTuple

from numba import from_dtype, types
from numba.core import cgutils
from numba.extending import intrinsic
from numba.np.arrayobj import make_array, populate_array

from jaxgran.dynamics.numba_engine.compilation import inline_njit
from jaxgran.dynamics.numba_engine.layout import (
    INPUTS,
    LANES,
    LEAST_SHIFT,
    SAVED,
    SAVED_NUMBERS,
    WORDS,
    WORDS_PER_GRAIN,
    Clusters,
    Grains,
    Network,
    Order,
    Pairs,
)
from jaxgran.dynamics.tally import NUMBERS

_PAIRS_PER_GRAIN = 16  # capacity


class Arrays(NamedTuple):
    """All arrays of the time loop: see ``layout``; step_sums and saved_sums: (NUMBERS,);
    saved_numbers: (1,) of ``SAVED``.
    """

    grains: Any
    pairs: Any
    network: Any
    clusters: Any
    order: Any
    step_sums: Any
    saved_sums: Any
    saved_numbers: Any


def _array_of(kind: types.Type) -> Any:
    """An intrinsic ``array(address, shape)``: an array of this dtype over existing memory, without
    reference counts.
    """

    @intrinsic
    def array(context, address, shape):
        made = types.Array(kind, shape.count, "C")

        def generate(context, builder, signature, arguments):
            target = make_array(made)(context, builder)
            size = context.get_abi_sizeof(context.get_data_type(kind))
            sizes = cgutils.unpack_tuple(builder, arguments[1], shape.count)
            strides = [cgutils.intp_t(size)]
            for length in reversed(sizes[1:]):
                strides.insert(0, builder.mul(strides[0], length))
            data = builder.inttoptr(arguments[0], target.data.type)
            populate_array(target, data, sizes, strides, cgutils.intp_t(size), None)
            return target._getvalue()

        return made(types.int64, types.UniTuple(types.intp, shape.count)), generate

    return array


integers_at, doubles_at = _array_of(types.int64), _array_of(types.float64)
inputs_at, _saved_at = _array_of(from_dtype(INPUTS)), _array_of(from_dtype(SAVED))
_signed_at, _unsigned_at = _array_of(types.int32), _array_of(types.uint32)


@inline_njit
def _reserve(memory, count, size):
    """Bump allocator: reserve ``count * size`` bytes; ``memory`` is (1,), the address of the first
    free byte.
    """
    address = memory[0]
    memory[0] += (count * size + 7) // 8 * 8
    return address


@inline_njit
def _pairs_of(memory, count):
    capacity = min(_PAIRS_PER_GRAIN * count, count * (count - 1) // 2)
    slots, cells = (capacity + LANES) // LANES * LANES, max(9, 2 * count)
    bounds = (slots >> LEAST_SHIFT) + LANES  # padded to whole rows
    return Pairs(
        _unsigned_at(_reserve(memory, 2 * slots, 4), (2, slots)),
        doubles_at(_reserve(memory, 2 * slots, 8), (2, slots)),
        _signed_at(_reserve(memory, 3 * slots, 4), (3, slots)),
        _signed_at(_reserve(memory, 2 * bounds, 4), (2, bounds)),
        _unsigned_at(_reserve(memory, 2 * capacity, 4), (2 * capacity,)),
        _unsigned_at(_reserve(memory, count + 1, 4), (count + 1,)),
        _unsigned_at(_reserve(memory, cells + 1, 4), (cells + 1,)),
        _unsigned_at(_reserve(memory, count, 4), (count,)),
        _unsigned_at(_reserve(memory, count, 4), (count,)),
        doubles_at(_reserve(memory, 3 * count, 8), (3, count)),
        _unsigned_at(_reserve(memory, slots, 4), (slots,)),
        doubles_at(_reserve(memory, 5 * LANES, 8), (5, LANES)),
        _signed_at(_reserve(memory, 3 * LANES, 4), (3, LANES)),
    )


@inline_njit
def _network_of(memory, count):
    """Contacts of discs form a planar graph, so there are at most 3 N of them."""
    size = 3 * count
    return Network(
        _unsigned_at(_reserve(memory, size, 4), (size,)),
        _unsigned_at(_reserve(memory, 2 * size, 4), (2, size)),
        doubles_at(_reserve(memory, 5 * size, 8), (5, size)),
        _unsigned_at(_reserve(memory, count, 4), (count,)),
        _signed_at(_reserve(memory, count, 4), (count,)),
        _signed_at(_reserve(memory, count, 4), (count,)),
        doubles_at(_reserve(memory, 2 * count, 8), (count, 2)),
    )


@inline_njit
def _clusters_of(memory, count, dv):
    """``dv`` is an array of the network, which the solver may overwrite."""
    size = 3 * count
    return Clusters(
        _unsigned_at(_reserve(memory, size, 4), (size,)),
        _unsigned_at(_reserve(memory, size + 1, 4), (size + 1,)),
        _unsigned_at(_reserve(memory, 2 * size, 4), (2 * size,)),
        _unsigned_at(_reserve(memory, count, 4), (count,)),
        _unsigned_at(_reserve(memory, count, 4), (count,)),
        _signed_at(_reserve(memory, count, 4), (count,)),
        _unsigned_at(_reserve(memory, size, 4), (size,)),
        _unsigned_at(_reserve(memory, 2 * size, 4), (size, 2)),
        doubles_at(_reserve(memory, 8 * size, 8), (size, 8)),
        doubles_at(_reserve(memory, 5 * size, 8), (size, 5)),
        dv,
        doubles_at(_reserve(memory, 3 * count, 8), (count, 3)),
    )


@inline_njit
def arrays_of(memory, count):
    """All arrays for ``count`` grains, as they are before the first step, and whether the block has
    room for them.

    ``memory`` is (1,), the address of a block of ``WORDS + WORDS_PER_GRAIN · count`` words.
    """
    end = memory[0] + 8 * (WORDS + WORDS_PER_GRAIN * count)
    motion, constants = _reserve(memory, 4 * count, 8), _reserve(memory, 2 * count, 8)
    grains = Grains(doubles_at(motion, (count, 4)), doubles_at(constants, (count, 2)))
    pairs, network = _pairs_of(memory, count), _network_of(memory, count)
    clusters = _clusters_of(memory, count, network.impulses)  # summed after the solves
    order = Order(
        _unsigned_at(_reserve(memory, count, 4), (count,)),
        _unsigned_at(_reserve(memory, count, 4), (count,)),
        _unsigned_at(_reserve(memory, count + 2, 4), (count + 2,)),
    )
    step_sums = doubles_at(_reserve(memory, NUMBERS, 8), (NUMBERS,))
    saved_sums = doubles_at(_reserve(memory, NUMBERS, 8), (NUMBERS,))
    saved_numbers = _saved_at(_reserve(memory, SAVED_NUMBERS, 8), (1,))
    fits = memory[0] <= end
    for g in range(count if fits else 0):
        network.degree[g] = network.loaded[g] = 0
        network.impulses[g, 0] = network.impulses[g, 1] = 0.0
        clusters.reached[g] = 0
    return Arrays(
        grains, pairs, network, clusters, order, step_sums, saved_sums, saved_numbers
    ), fits
