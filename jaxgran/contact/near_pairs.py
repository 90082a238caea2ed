"""PairList: near pairs with frozen separations, and how long the list is valid.

Separations are stored once, when a list is built. In coordinates that move with the sheared cell
they follow from the displacements δ of the grains since then and from the strain γ since then,
without images or tilt:

    Δy = Δy₀ + δy_i − δy_j,    Δx = Δx₀ + δx_i − δx_j + γ Δy,    dδx/dt = c_x − γ c_y,  dδy/dt =
    c_y.

There are two lists. The outer one has a large skin and is searched seldom; the near one, which
every event reads, is filtered from it often. A list with skin s holds every pair whose gap was at
most s when it was built. Two grains within a distance r now have |Δy| ≤ r, so no such pair is
missed as long as its gap is at most

    s − 2 max|δ| (1 + |γ_ref|) − r |γ − γ_ref|

with δ counted from the build of the list and γ_ref the strain of the frame at that time. The outer
list is judged by this before a near list is filtered from it, with r the largest diameter and the
skin of the near list. The near list is judged in ``dynamics.step`` by a bound on the speed at which
a gap closes, which costs less and is as safe.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxgran.contact.cell_list import cell_list_pairs, largest_cutoff
from jaxgran.contact.compaction import bit_positions, count_bits, pack_bits
from jaxgran.model.cell import displacement, remap_tilt, sheared, wrap
from jaxgran.model.control_flow import any_replica, where_active
from jaxgran.model.grains import Grains
from jaxgran.model.indexing import taken

ALL_PAIRS_LIMIT = 512  # above this number of grains the search uses a cell list
NEAR_PAIRS_PER_GRAIN = 4
OUTER_PAIRS_PER_GRAIN = 10
_FILL = 0.8  # share of a buffer that the expected number of pairs may take
_NARROWER, _LEAST_SHARE = 0.7, 0.15  # of the skin, where grains cluster and a buffer is too small
_FAR = 1e6  # σ, separation in an empty slot


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PairList:
    """Pairs i, j that may touch, with their separations when the frame was frozen; empty slots lie
    far apart.

    ===========  ===========  ====  ==========================================
    field        shape        unit  meaning
    ===========  ===========  ====  ==========================================
    i, j         (pairs,)     –     grains of the pair
    separations  (pairs, 2)   σ     r_i − r_j (nearest image) in the frozen frame
    reach        (pairs,)     σ     sum of the radii, 0 in an empty slot
    skin         ()           σ     largest gap of a pair at the time of the build
    overflow     ()           –     True where pairs were left out
    ===========  ===========  ====  ==========================================
    """

    i: Int[Array, " pairs"]
    j: Int[Array, " pairs"]
    separations: Float[Array, "pairs 2"]
    reach: Float[Array, " pairs"]
    skin: Float[Array, ""]
    overflow: Bool[Array, ""]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Frame:
    """Motion since the separations were frozen: displacements (grains, 2) in σ and strain ()."""

    displacements: Float[Array, "grains 2"]
    strain: Float[Array, ""]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PairLists:
    """Both lists and the frame that their separations are frozen in.

    ===========  ===========  ====  =====================================================
    field        shape        unit  meaning
    ===========  ===========  ====  =====================================================
    outer        PairList     –     all pairs within a large skin
    near         PairList     –     those of them within a small skin
    frame        Frame        –     motion since the frame was frozen
    near_frame   Frame        –     that motion when the near list was built
    positions    (grains, 2)  σ     positions when the frame was frozen
    tilt         ()           –     tilt of the cell when the frame was frozen
    ===========  ===========  ====  =====================================================
    """

    outer: PairList
    near: PairList
    frame: Frame
    near_frame: Frame
    positions: Float[Array, "grains 2"]
    tilt: Float[Array, ""]


def separations_now(pairs: PairList, frame: Frame) -> Float[Array, "pairs 2"]:
    """Separations r_i − r_j of the pairs after the motion of the frame."""
    at_i, at_j = taken(frame.displacements, pairs.i), taken(frame.displacements, pairs.j)
    return sheared(pairs.separations + at_i - at_j, frame.strain)


def consumed_skin(frame: Frame, since: Frame, distance: Array) -> Float[Array, ""]:
    """How much of the skin of a list built at ``since`` the motion up to ``frame`` may have used.

    It holds for pairs that are now within the given distance (of their centres).
    """
    moved = jnp.sqrt(jnp.max(jnp.sum((frame.displacements - since.displacements) ** 2, axis=-1)))
    return 2 * moved * (1 + jnp.abs(since.strain)) + distance * jnp.abs(frame.strain - since.strain)


def present(lists: PairLists, side: Array) -> tuple[Float[Array, "grains 2"], Float[Array, ""]]:
    """Positions of the grains now, wrapped into the cell, and its tilt."""
    y = lists.positions[:, 1] + lists.frame.displacements[:, 1]
    x = lists.positions[:, 0] + lists.frame.displacements[:, 0] + lists.frame.strain * y
    tilt = lists.tilt + lists.frame.strain
    remapped = remap_tilt(tilt)
    return wrap(jnp.stack([x, y], axis=-1), side, remapped), remapped


def no_lists(positions: Float[Array, "grains 2"], tilt: Array) -> PairLists:
    """Lists of no pairs, which ``refresh`` replaces at its first call."""

    def empty(pairs_per_grain: int) -> PairList:
        slots, dtype = _capacity(pairs_per_grain, len(positions)), positions.dtype
        return PairList(
            i=jnp.zeros(slots, jnp.int32),
            j=jnp.zeros(slots, jnp.int32),
            separations=jnp.broadcast_to(jnp.asarray([_FAR, 0], dtype), (slots, 2)),
            reach=jnp.zeros(slots, dtype),
            skin=jnp.asarray(-jnp.inf, dtype),
            overflow=jnp.bool_(False),
        )

    at_rest = Frame(jnp.zeros_like(positions), jnp.zeros_like(tilt))
    return PairLists(
        empty(OUTER_PAIRS_PER_GRAIN), empty(NEAR_PAIRS_PER_GRAIN), at_rest, at_rest, positions, tilt
    )


def pair_lists(
    positions: Float[Array, "grains 2"], grains: Grains, side: Array, tilt: Array
) -> PairLists:
    """Both lists, built from the positions; the frame starts here."""
    at_rest = Frame(jnp.zeros_like(positions), jnp.zeros_like(side))
    outer = outer_pairs(positions, grains, side, tilt)
    skin = jnp.minimum(_nominal_skin(NEAR_PAIRS_PER_GRAIN, grains, side), outer.skin)
    near = _near_pairs(outer, at_rest, skin, grains)
    return PairLists(outer, near, at_rest, at_rest, positions, tilt)


def refresh(lists: PairLists, grains: Grains, side: Array, stale: Bool[Array, ""]) -> PairLists:
    """The lists with a new near list where it is ``stale``, and both anew where the outer list is
    used up.

    Args:
      lists: the present lists.
      grains, side: the grains and the side of their cell.
      stale: whether this replica needs it; others of the batch keep what they have.
    """
    at_rest = Frame(jnp.zeros_like(lists.positions), jnp.zeros_like(lists.tilt))
    nominal = _nominal_skin(NEAR_PAIRS_PER_GRAIN, grains, side)
    consumed = consumed_skin(lists.frame, at_rest, 2 * jnp.max(grains.radii) + nominal)
    remaining = lax.stop_gradient(lists.outer.skin - consumed)
    search = stale & ~(remaining >= nominal)

    def searched() -> tuple:
        positions, tilt = present(lists, side)
        new = outer_pairs(positions, grains, side, tilt), at_rest, positions, tilt
        return where_active(search, new, kept)

    kept = lists.outer, lists.frame, lists.positions, lists.tilt
    outer, frame, positions, tilt = lax.cond(any_replica(search), searched, lambda: kept)
    skin = jnp.minimum(nominal, jnp.where(search, outer.skin, remaining))
    near = _near_pairs(outer, frame, skin, grains)
    return where_active(stale, PairLists(outer, near, frame, frame, positions, tilt), lists)


def _nominal_skin(pairs_per_grain: int, grains: Grains, side: Array) -> Float[Array, ""]:
    """The skin at which a homogeneous flow fills a buffer to its expected share; at most half the
    cell.
    """
    density = grains.radii.size / side**2
    reach = jnp.sqrt(2 * _FILL * pairs_per_grain / (jnp.pi * density))
    return jnp.minimum(reach - 1, widest_skin(grains, side))


def widest_skin(grains: Grains, side: Array) -> Float[Array, ""]:
    """The largest skin of lists of these grains: nearest images are unique, and the grid of cells
    is fine enough.
    """
    count, cutoff = grains.radii.size, side / 2
    if count > ALL_PAIRS_LIMIT:
        grid_cutoff = largest_cutoff(count, side, _capacity(OUTER_PAIRS_PER_GRAIN, count))
        cutoff = jnp.minimum(cutoff, grid_cutoff)
    return cutoff - 2 * jnp.max(grains.radii)


def _capacity(pairs_per_grain: int, count: int) -> int:
    return min(pairs_per_grain * count, count * (count - 1) // 2)


def _select(
    gaps: Float[Array, " m"], largest_skin: Array, capacity: int
) -> tuple[Int[Array, " pairs"], Bool[Array, " pairs"], Array, Array]:
    """Pairs with a gap within the largest skin for which a buffer has room: the first skin tried
    nearly always fits.

    Returns:
      Where the pairs stand among the gaps, which slots of the buffer they fill, the skin, and
      whether even the smallest skin leaves pairs out.
    """
    # the choice of pairs has no derivative
    gaps, largest_skin = lax.stop_gradient((gaps, largest_skin))

    def crowded(now: tuple[Array, Array]) -> Array:
        skin, words = now
        return (count_bits(words) > capacity) & (skin > _LEAST_SHARE * largest_skin)

    def narrower(now: tuple[Array, Array]) -> tuple[Array, Array]:
        skin = _NARROWER * now[0]
        return where_active(crowded(now), (skin, pack_bits(gaps <= skin)), now)

    widest = largest_skin, pack_bits(gaps <= largest_skin)
    skin, words = lax.while_loop(lambda now: any_replica(crowded(now)), narrower, widest)
    index = bit_positions(words, capacity, gaps.size)
    filled = index < gaps.size
    return jnp.where(filled, index, 0), filled, skin, count_bits(words) > capacity


def _pair_list(i, j, separations, filled, grains: Grains, skin, overflow) -> PairList:
    """The pairs i, j with their separations; a slot that is not filled is empty."""
    i, j = jnp.where(filled, i, 0), jnp.where(filled, j, 0)
    far = jnp.asarray([[_FAR, 0]], separations.dtype)
    return PairList(
        i=i,
        j=j,
        separations=jnp.where(filled[:, None], separations, far),
        reach=jnp.where(filled, taken(grains.radii, i) + taken(grains.radii, j), 0),
        skin=skin,
        overflow=overflow,
    )


def _near_pairs(outer: PairList, frame: Frame, largest_skin: Array, grains: Grains) -> PairList:
    """The pairs of the outer list within the largest skin now, with the frozen separations of the
    outer list.
    """
    gaps = _lengths(separations_now(outer, frame)) - outer.reach
    capacity = _capacity(NEAR_PAIRS_PER_GRAIN, grains.radii.size)
    index, filled, skin, overflow = _select(gaps, largest_skin, capacity)
    i, j, separations = (taken(x, index) for x in (outer.i, outer.j, outer.separations))
    return _pair_list(i, j, separations, filled, grains, skin, overflow | outer.overflow)


def outer_pairs(
    positions: Float[Array, "grains 2"], grains: Grains, side: Array, tilt: Array
) -> PairList:
    """All pairs within the outer skin, by comparing all pairs or, for many grains, through a cell
    list.
    """
    count = positions.shape[0]
    capacity = _capacity(OUTER_PAIRS_PER_GRAIN, count)
    largest_skin = _nominal_skin(OUTER_PAIRS_PER_GRAIN, grains, side)
    if count > ALL_PAIRS_LIMIT:
        cutoff = largest_skin + 2 * jnp.max(grains.radii)
        i, j, incomplete = cell_list_pairs(positions, side, tilt, cutoff, capacity)
        separations = displacement(taken(positions, i), taken(positions, j), side, tilt)
        reach = jnp.where(i == j, -jnp.inf, taken(grains.radii, i) + taken(grains.radii, j))
        gaps = _lengths(separations) - reach
        index, filled, skin, overflow = _select(gaps, largest_skin, capacity)
        i, j, overflow = taken(i, index), taken(j, index), overflow | incomplete
    else:
        separations = displacement(positions[:, None], positions[None, :], side, tilt)
        gaps = _lengths(separations) - grains.radii[:, None] - grains.radii[None, :]
        gaps = jnp.where(jnp.triu(jnp.ones((count, count), bool), 1), gaps, jnp.inf).reshape(-1)
        index, filled, skin, overflow = _select(gaps, largest_skin, capacity)
        # without the cases of negative numbers
        i, j = lax.div(index, jnp.int32(count)), lax.rem(index, jnp.int32(count))
    separations = displacement(taken(positions, i), taken(positions, j), side, tilt)
    return _pair_list(i, j, separations, filled, grains, skin, overflow)


def _lengths(separations: Float[Array, "*pairs 2"]) -> Float[Array, "*pairs"]:
    return jnp.sqrt(jnp.sum(separations**2, axis=-1))
