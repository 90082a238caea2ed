"""The arrays of the numba engine for one replica.

Arrays are passed whole and indexed by row and column. Indices are unsigned, which spares a test for
negative ones.
"""

from typing import Any, NamedTuple

import numpy as np
from numba import njit

from jaxgran.dynamics.numba_engine.layout import LANES, LEAST_SHIFT
from jaxgran.dynamics.tally import NUMBERS

_PAIRS_PER_GRAIN = 16  # capacity


class Grains(NamedTuple):
    """The grains. Positions in the laboratory are r + v t with t counted from the last search for
    near pairs.

    motion: (grains, 4), r and v in the laboratory.
    constants: (grains, 2), radius and inverse mass.
    in_state: (grains,), the index of each grain in the state.
    """

    motion: Any
    constants: Any
    in_state: Any


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


class Arrays(NamedTuple):
    """All arrays of the time loop; ``step_sums``: (NUMBERS,), those of one step."""

    grains: Grains
    pairs: Pairs
    network: Network
    clusters: Clusters
    step_sums: Any


@njit
def arrays_of(count):
    """All arrays for ``count`` grains, as they are before the first step."""
    network = _network_of(count)
    return Arrays(
        Grains(np.empty((count, 4)), np.empty((count, 2)), np.empty(count, np.uint32)),
        _pairs_of(count),
        network,
        _clusters_of(count, network.impulses),  # summed after the solves
        np.empty(NUMBERS),
    )


@njit
def _pairs_of(count):
    capacity = min(_PAIRS_PER_GRAIN * count, count * (count - 1) // 2)
    slots, cells = (capacity + LANES) // LANES * LANES, max(9, 2 * count)
    return Pairs(
        ends=np.empty((2, slots), np.uint32),
        images=np.empty((2, slots)),
        calendar=np.empty((3, slots), np.int32),
        bounds=np.empty((2, (slots >> LEAST_SHIFT) + LANES), np.int32),  # padded to whole rows
        of_grain=np.empty(2 * capacity, np.uint32),
        offsets=np.empty(count + 1, np.uint32),
        starts=np.empty(cells + 1, np.uint32),
        cells=np.empty(count, np.uint32),
        sorted=np.empty(count, np.uint32),
        places=np.empty((3, count)),
        listed=np.empty(slots, np.uint32),
        flights=np.empty((5, LANES)),
        entries=np.empty((3, LANES), np.int32),
    )


@njit
def _network_of(count):
    """Contacts of discs form a planar graph, so there are at most 3 N of them."""
    size = 3 * count
    return Network(
        near_pair=np.empty(size, np.uint32),
        ends=np.empty((2, size), np.uint32),
        rows=np.empty((5, size)),
        touched=np.empty(count, np.uint32),
        degree=np.zeros(count, np.int32),
        loaded=np.zeros(count, np.int32),
        impulses=np.zeros((count, 2)),
    )


@njit
def _clusters_of(count, dv):
    """``dv`` is an array of the network, which the solver may overwrite."""
    size = 3 * count
    return Clusters(
        source=np.empty(size, np.uint32),
        starts=np.empty(size + 1, np.uint32),
        of_grain=np.empty(2 * size, np.uint32),
        offsets=np.empty(count, np.uint32),
        queue=np.empty(count, np.uint32),
        reached=np.zeros(count, np.int32),
        places=np.empty(size, np.uint32),
        ends=np.empty((size, 2), np.uint32),
        rows=np.empty((size, 8)),
        iterate=np.empty((size, 5)),
        dv=dv,
        matrices=np.empty((count, 3)),
    )
