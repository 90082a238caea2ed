"""The True entries of a mask are found in their order."""

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxgran.contact.compaction import bit_positions, count_bits, pack_bits

compiled_words = jax.jit(pack_bits)
compiled_positions = jax.jit(bit_positions, static_argnums=(1, 2))


@pytest.mark.parametrize(
    ("length", "size"), [(1, 3), (31, 8), (32, 40), (33, 5), (496, 96), (5000, 64), (5000, 5500)]
)
@settings(max_examples=25)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 0.01, 0.1, 0.5, 0.99, 1.0]))
def test_positions_are_those_of_the_true_entries(length, size, seed, density):
    mask = np.random.default_rng(seed).random(length) < density
    words = compiled_words(mask)
    assert int(count_bits(words)) == np.sum(mask)
    expected = np.nonzero(mask)[0][:size]
    expected = np.concatenate([expected, np.full(size - len(expected), length)])
    np.testing.assert_array_equal(compiled_positions(words, size, length), expected)
