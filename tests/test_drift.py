"""A point is steady if its seeds together do not drift; what one seed does for itself is noise."""

from dataclasses import replace

import numpy as np
from synthetic import random_tally, sample_of_tally

from jaxgran.model.flow import ShearFlow
from jaxgran.sampling import drift
from jaxgran.sampling.drift import is_drifting
from jaxgran.sampling.sample import BLOCKS, Sample
from jaxgran.sampling.thresholds import DRIFT_BLOCKS

LATE = np.arange(BLOCKS) >= BLOCKS // 2


def sample_of(seed: int, growth: float) -> Sample:
    """A sample whose pressure and temperature are larger by a factor in the second half."""
    tally = random_tally(np.random.default_rng(seed), BLOCKS)
    factor = np.where(LATE, growth, 1.0)[:, None, None]
    even = np.broadcast_to(np.array([[40.0, -10.0], [-10.0, 40.0]]), (BLOCKS, 2, 2))
    noise = np.exp(0.05 * np.random.default_rng(seed).normal(size=(BLOCKS, 1, 1)))
    moments = dict.fromkeys(("contact_moment", "kinetic_moment"), factor * noise * even)
    tally = replace(tally, duration=np.full(BLOCKS, 1.0), **moments)
    return sample_of_tally(tally, ShearFlow(64, 0.5, 0.6, 1e-3))


def test_a_drift_that_all_seeds_share_is_one() -> None:
    assert is_drifting([sample_of(seed, 1.6) for seed in range(4)], correlation_strain=1.0)
    assert is_drifting([sample_of(0, 1.6)], correlation_strain=1.0)
    # less than is accepted
    assert not is_drifting([sample_of(seed, 1.1) for seed in range(4)], correlation_strain=1.0)


def test_seeds_that_drift_against_each_other_are_steady_together() -> None:
    opposite = [sample_of(seed, growth) for seed, growth in enumerate((1.6, 1 / 1.6, 1.6, 1 / 1.6))]
    assert all(is_drifting([one], correlation_strain=1.0) for one in opposite)
    assert not is_drifting(opposite, correlation_strain=1.0)


def test_a_flow_of_long_correlation_may_wander() -> None:
    assert not is_drifting([sample_of(0, 1.3)], correlation_strain=100.0)


def test_blocks_are_correlated_over_half_of_the_correlation_strain(monkeypatch) -> None:
    """Of 16 blocks of a strain of one, and over a strain of one at least."""
    given = []
    monkeypatch.setattr(drift, "drift", lambda series, least: given.append(least) or (0.0, 0.0))
    for strain in (0.5, 100.0):
        assert not is_drifting([sample_of(0, 1.0)], strain)
    blocks = BLOCKS / DRIFT_BLOCKS
    expected = np.repeat(np.exp([-blocks, -blocks / 50]), 2)
    np.testing.assert_allclose(given, expected)


def test_a_sample_that_is_not_finite_drifts() -> None:
    sample = sample_of(0, 1.0)
    sample.tally.kinetic_moment[3] = np.nan
    assert is_drifting([sample], correlation_strain=1.0)
