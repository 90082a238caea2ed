"""The arrays of the numba engine for one replica.

Arrays are passed whole. Indices are unsigned, which spares a test for negative ones.
"""

from typing import Any, NamedTuple

import numpy as np
from numba import njit

from jaxgran.dynamics.numba_engine.layout import LANES, LEAST_SHIFT, doubles
from jaxgran.dynamics.tally import NUMBERS

_PAIRS_PER_GRAIN = 16  # capacity


MOTION = doubles("x", "y", "vx", "vy")
CONSTANTS = doubles("radius", "inverse_mass")
# A contact in the solver: μ n, μ u⁻, 1/μ, 1/(μ m_i), 1/(μ m_j) and J, with the reduced mass μ;
# padded to a cache line
CONTACT = doubles(
    "mu_nx", "mu_ny", "mu_u", "inverse_mu", "inverse_mu_mi", "inverse_mu_mj", "impulse", "padding"
)
# A contact in the method of Barzilai and Borwein: W J, the last changes of J and of W J, J of the
# best iterate, and the diagonal D
ITERATE = doubles("response", "step", "response_change", "best", "bound")


class Grains(NamedTuple):
    """The grains. Positions in the laboratory are r + v t with t counted from the last search for
    near pairs.
    """

    motion: Any  # (grains,) of ``MOTION``, r and v in the laboratory
    constants: Any  # (grains,) of ``CONSTANTS``
    in_state: Any  # (grains,), the index of each grain in the state


class Pairs(NamedTuple):
    """Near pairs, padded to whole ``LANES``, with a spare slot for a pair beyond the capacity."""

    ends: Any  # (2, slots), grains
    images: Any  # (2, slots)
    calendar: Any  # (3, slots), steps
    bounds: Any  # (2, blocks), the least strike and begin of a block of the calendar, or less
    of_grain: Any  # pairs of the grains, those of grain g at ``offsets[g] : offsets[g + 1]``
    offsets: Any
    starts: Any  # (cells + 1,), for the search
    cells: Any  # (grains,), the cell of each grain
    sorted: Any  # (grains,), in the order of the cells
    places: Any  # (3, grains), x, y and radius of these
    listed: Any  # (slots,), pairs to be predicted
    flights: Any  # (5, LANES), memory of a prediction
    entries: Any  # (3, LANES), memory of a prediction


class Network(NamedTuple):
    """The contacts of one step and the grains that they touch."""

    near_pair: Any  # (contacts,), the pair of each contact
    ends: Any  # (2, contacts), grains
    rows: Any  # (5, contacts)
    touched: Any  # the grains with contacts
    degree: Any  # (grains,), contacts of each grain
    loaded: Any  # (grains,), those with an impulse
    impulses: Any  # (grains, 2), total impulse of each grain
    step_sums: Any  # (NUMBERS,), what the contacts add to the running sums


class Clusters(NamedTuple):
    """Contacts that touch each other, sorted by cluster, and the memory of their solver."""

    source: Any  # indices in the network, those of cluster m at ``starts[m] : starts[m + 1]``
    starts: Any
    of_grain: Any  # contacts of the grains, those of grain g from ``offsets[g]`` on
    offsets: Any
    queue: Any  # (grains,), of the search for clusters
    reached: Any  # (grains,), of the search for clusters
    # of the cluster that is solved
    places: Any  # (contacts,), indices in the network
    ends: Any  # (contacts, 2), grains
    rows: Any  # (contacts,) of ``CONTACT``
    iterate: Any  # (contacts,) of ``ITERATE``
    dv: Any  # (grains, 2), changes of velocity
    matrices: Any  # (grains, 3), Σ n ⊗ n


class Arrays(NamedTuple):
    """All arrays of the time loop."""

    grains: Grains
    pairs: Pairs
    network: Network
    clusters: Clusters


@njit
def arrays_of(count):
    """All arrays for ``count`` grains, as they are before the first step."""
    network = _network_of(count)
    return Arrays(
        Grains(np.empty(count, MOTION), np.empty(count, CONSTANTS), np.empty(count, np.uint32)),
        _pairs_of(count),
        network,
        _clusters_of(count, network.impulses),  # summed after the solves
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
        step_sums=np.empty(NUMBERS),
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
        rows=np.empty(size, CONTACT),
        iterate=np.empty(size, ITERATE),
        dv=dv,
        matrices=np.empty((count, 3)),
    )
