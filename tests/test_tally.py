"""Tally: what joins two samples."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxgran.dynamics.tally import EXTREMES, Tally, empty_tally
from jaxgran.model.status import Status


def random_tally(seed: int) -> Tally:
    rng = np.random.default_rng(seed)
    empty = empty_tally(jnp.dtype(float))
    return jax.tree.map(lambda leaf: jnp.asarray(rng.integers(0, 7, leaf.shape), leaf.dtype), empty)


def test_joined_sample_has_the_sums_and_the_larger_of_each_extreme():
    for seed in range(5):
        one, two = random_tally(seed), random_tally(seed + 100)
        joined = one + two
        for name in Tally.__dataclass_fields__:
            expected = np.maximum if name in EXTREMES else np.add
            np.testing.assert_array_equal(getattr(joined, name), expected(getattr(one, name), getattr(two, name)))
            assert getattr(joined, name).dtype == getattr(one, name).dtype


def test_tally_of_no_time_is_neutral():
    empty = empty_tally(jnp.dtype(float))
    jax.tree.map(np.testing.assert_array_equal, random_tally(0) + empty, random_tally(0))
    assert empty.status == Status.ok and empty.status.dtype == np.int32


def test_batches_of_tallies_join_replica_by_replica():
    ones, twos = (
        jax.tree.map(lambda *leaves: jnp.stack(leaves), *map(random_tally, seeds)) for seeds in ((0, 1), (2, 3))
    )
    joined = ones + twos
    second = jax.tree.map(lambda leaf: leaf[1], joined)
    jax.tree.map(np.testing.assert_array_equal, second, random_tally(1) + random_tally(3))
