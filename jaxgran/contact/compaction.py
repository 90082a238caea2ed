"""Compaction: the places of the True entries of a mask, in a buffer of a fixed size.

The mask is packed into words of 32 bits. The word that holds the set bit of a rank follows from the
running number of set bits, and its place in the word from the set bits up to each place. Inside a
step this costs a tenth of ``jnp.nonzero``.
"""

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Int, UInt32

from jaxgran.model.indexing import taken

WORD = 32  # bits
_FEW_WORDS = 64  # up to which sums over all words compile and run faster than scans
_BITS = np.uint32(1) << np.arange(WORD, dtype=np.uint32)


def pack_bits(mask: Bool[Array, " m"]) -> UInt32[Array, " words"]:
    """The mask in words of 32 bits, the first entry in the lowest bit."""
    words = -(-mask.size // WORD)
    bits = jnp.pad(mask, (0, words * WORD - mask.size)).reshape(words, WORD)
    return jnp.sum(jnp.where(bits, _BITS[None, :], np.uint32(0)), axis=1, dtype=jnp.uint32)


def count_bits(words: UInt32[Array, " words"]) -> Int[Array, ""]:
    """How many bits are set."""
    return jnp.sum(lax.population_count(words).astype(jnp.int32), dtype=jnp.int32)


def bit_positions(words: UInt32[Array, " words"], size: int, length: int) -> Int[Array, " size"]:
    """Positions of the first ``size`` set bits, padded with ``length``.

    Examples:
      >>> words = pack_bits(jnp.array([False, True, True, False, True]))
      >>> bit_positions(words, 4, 5).tolist()
      [1, 2, 4, 5]
    """
    word, place, is_set = locate_bits(words, size)
    return jnp.where(is_set, word * WORD + place, length)


def locate_bits(
    words: UInt32[Array, " words"], size: int
) -> tuple[Int[Array, " size"], Int[Array, " size"], Bool[Array, " size"]]:
    """Words of the first ``size`` set bits, their places in them, and which slots are filled."""
    counts = lax.population_count(words).astype(jnp.int32)
    rank = jnp.arange(size, dtype=jnp.int32)
    if words.size <= _FEW_WORDS:
        up_to = np.tri(words.size, dtype=bool)
        ends = jnp.sum(jnp.where(up_to, counts[None, :], np.int32(0)), axis=1, dtype=jnp.int32)
        starts = ends - counts
        full = jnp.sum(ends[None, :] <= rank[:, None], axis=1, dtype=jnp.int32)
        word = jnp.minimum(full, words.size - 1)
    else:
        ends = jnp.cumsum(counts, dtype=jnp.int32)
        starts = ends - counts
        # of the words that start at a rank only the last is not empty
        number = jnp.arange(words.size, dtype=jnp.int32)
        word = lax.cummax(jnp.zeros(size, jnp.int32).at[starts].max(number, mode="drop"))
    place = _place_in_word(taken(words, word), rank - taken(starts, word))
    return word, place, rank < ends[-1]


def _place_in_word(words: UInt32[Array, " n"], rank: Int[Array, " n"]) -> Int[Array, " n"]:
    """Place of the set bit of a rank (from 0) in each word: that of the first with more set bits up
    to it.
    """
    up_to = np.uint32(2) * _BITS - np.uint32(1)
    set_up_to = lax.population_count(words[:, None] & up_to[None, :]).astype(rank.dtype)
    return jnp.sum(set_up_to <= rank[:, None], axis=1, dtype=rank.dtype)
