"""Search for near pairs in the sheared cell, linear in the number of grains; the only module that
imports jax-md.

The grains are sorted into a grid of cells by ``jax_md.partition.cell_list``, in the fractional
coordinates that move with the sheared cell, s = ((x − tilt·y)/ℓ, y/ℓ). A disc of radius r covers
±√(1 + tilt²) r/ℓ of s_x and ±r/ℓ of s_y, so with square cells of the larger size, at the largest
tilt ½, all its neighbours lie in 3×3 cells. Each grain is compared with those in half of them. The
pairs found are gathered through words of 32 bits, one bit for each candidate.

jax-md's ``neighbor_list`` finds the same pairs but writes every candidate to its place. It takes
three times as long as this search for a thousand grains, and over ten times as long for ten
thousand.
"""

import math
import warnings

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxgran.contact.compaction import WORD, count_bits, locate_bits, pack_bits
from jaxgran.model.control_flow import any_replica, where_active

# About 10 grains are expected in a cell; the second is for dense clusters
_CELL_CAPACITIES = (WORD, 4 * WORD)
_MARGIN = 1.2  # of the number of pairs that the grid is made for, over the capacity
_ROOM = 2  # candidates returned, over the capacity
_LARGEST_TILT = 0.5
# The cell itself comes first
_HALF_STENCIL = np.array([[0, 0], [1, 0], [-1, 1], [0, 1], [1, 1]], np.int32)


def cell_list_pairs(
    positions: Float[Array, "grains 2"], side: Array, tilt: Array, cutoff: Array, capacity: int
) -> tuple[Int[Array, " pairs"], Int[Array, " pairs"], Bool[Array, ""]]:
    """All pairs of grains whose centres are within a cutoff, each once.

    The grid is static: it serves a cutoff within which a homogeneous flow has up to 1.2 ×
    ``capacity`` pairs, and any smaller one. Up to 2 × ``capacity`` pairs are found, with up to 128
    grains in a cell; beyond that pairs may be missing.

    Args:
      positions: (grains, 2), centres in σ.
      side, tilt: of the cell, in σ and in [−½, ½).
      cutoff: largest distance, in σ, to the nearest image.
      capacity: number of pairs to expect at most in a homogeneous flow; static.

    Returns:
      Grains i < j of each pair (2·capacity,), with i = j in an empty slot; and whether pairs may be
      missing, since the cutoff is too large for the grid, or a cell or the list of pairs is full.
    """
    # pairs are whole numbers
    positions, side, tilt, cutoff = lax.stop_gradient((positions, side, tilt, cutoff))
    cells = _cells_per_side(positions.shape[0], capacity)
    x, y = positions[:, 0], positions[:, 1]
    scaled = jnp.stack([x - tilt * y, y], axis=-1) / side
    fractional = scaled - jnp.floor(scaled)
    reach = cutoff / side + 8 * jnp.finfo(positions.dtype).eps  # the coordinates are rounded
    cells_suffice = reach * jnp.sqrt(1 + tilt**2) <= 1 / cells

    def search(cell_capacity: int):
        return _search(fractional, tilt, reach, cells, cell_capacity, _ROOM * capacity)

    first = search(_CELL_CAPACITIES[0])
    crowded = first[-1]
    i, j, too_many_pairs, too_crowded = lax.cond(
        any_replica(crowded),
        lambda: where_active(crowded, search(_CELL_CAPACITIES[1]), first),
        lambda: first,
    )
    return i, j, too_many_pairs | too_crowded | ~cells_suffice


def largest_cutoff(count: int, side: Array, capacity: int) -> Float[Array, ""]:
    """Largest cutoff, in σ, that the grid of ``cell_list_pairs`` serves at any tilt."""
    share = 1 / (_cells_per_side(count, capacity) * math.hypot(1, _LARGEST_TILT))
    return side * (share - 16 * jnp.finfo(side.dtype).eps)


def _cells_per_side(count: int, capacity: int) -> int:
    """As many cells along each side as the cutoff allows, but at least 3 and on average a grain or
    more in each.
    """
    reach = math.sqrt(2 * _MARGIN * capacity / (math.pi * count**2))  # cutoff/ℓ
    return max(3, min(int(1 / (reach * math.hypot(1, _LARGEST_TILT))), math.isqrt(count)))


def _search(
    fractional: Array, tilt: Array, reach: Array, cells_per_side: int, cell_capacity: int, size: int
):
    """Pairs (i, j), whether there are more than ``size``, and whether a cell holds more than its
    capacity.
    """
    count, words = fractional.shape[0], cell_capacity // WORD
    cells = _cell_list(fractional, cells_per_side, cell_capacity)
    members = cells.id_buffer.reshape(-1, cell_capacity)
    x, y = (cells.position_buffer.reshape(-1, cell_capacity, 2)[..., axis] for axis in (0, 1))
    columns, rows = jnp.moveaxis(
        (cells.particle_cell_id[:, None, :] + _HALF_STENCIL[None]) % cells_per_side, -1, 0
    )
    near = columns + rows * cells_per_side  # (grains, stencil)

    grain = jnp.arange(count, dtype=jnp.int32)[:, None, None]
    dx, dy = x[near] - fractional[:, 0, None, None], y[near] - fractional[:, 1, None, None]
    dx, dy = dx - jnp.round(dx), dy - jnp.round(dy)
    other = members[near]  # (grains, stencil, capacity)
    once = (other > grain) | (np.arange(len(_HALF_STENCIL)) > 0)[None, :, None]
    is_pair = ((dx + tilt * dy) ** 2 + dy**2 <= reach**2) & (other < count) & once

    bits = pack_bits(is_pair.reshape(-1))
    word, place, is_filled = locate_bits(bits, size)
    cell, member = near.reshape(-1)[word // words], word % words * WORD + place
    i = jnp.where(is_filled, word // (len(_HALF_STENCIL) * words), 0)
    j = jnp.where(is_filled, members[cell, member], 0)
    overflows = count_bits(bits) > size
    return jnp.minimum(i, j), jnp.maximum(i, j), overflows, cells.did_buffer_overflow


def _cell_list(fractional: Array, cells_per_side: int, cell_capacity: int):
    """jax-md's cell list of points in the unit square.

    Importing jax-md takes seconds and computes constants: it is imported when first needed, and
    outside the trace.
    """
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        with jax.ensure_compile_time_eval(), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            from jax_md import partition
        smallest = 1 / (cells_per_side + 0.5)  # jax-md rounds the number of cells down
        # a number will do for the box
        binning = partition.cell_list(1.0, smallest)  # pyright: ignore[reportArgumentType]
        return binning.update(fractional, cell_capacity)
