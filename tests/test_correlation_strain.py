"""Correlation strain: the longer of heating by the shear and of a sound wave across the cell."""

from dataclasses import replace

import numpy as np
import pytest
from synthetic import random_tally, sample_of_tally
from test_statistics import ar1

from jaxgran.model.flow import ShearFlow
from jaxgran.sampling.correlation_strain import flow_correlation_strain
from jaxgran.sampling.sample import correlation_strains
from jaxgran.sampling.thresholds import RELAXATION_STRAIN


def correlation_strain(
    temperature=1.0, pressure=1.0, shear_stress=1.0, grains=400, side=20.0, shear_rate=1.0
):
    averages = {
        "granular_temperature": temperature,
        "pressure": pressure,
        "shear_stress": shear_stress,
    }
    return flow_correlation_strain(averages, grains, grains, side**2, shear_rate)


def test_correlation_strain_is_the_longer_of_heating_and_waves():
    assert correlation_strain(temperature=30.0, shear_stress=2.0, pressure=100.0) == pytest.approx(
        15.0
    )
    assert correlation_strain(temperature=1e-3, pressure=0.25) == pytest.approx(0.35 * 20 * 2)


def test_correlation_strain_of_a_faster_shear_is_the_same():
    """Bagnold: stresses and temperature grow as the square of the shear rate."""
    slow = correlation_strain(2.0, 0.5, 0.3)
    assert correlation_strain(2.0 * 9, 0.5 * 9, 0.3 * 9, shear_rate=3.0) == pytest.approx(
        float(slow)
    )


def test_correlation_strain_is_never_below_that_of_the_contact_network():
    assert correlation_strain(temperature=0.0, pressure=1e9) == RELAXATION_STRAIN
    np.testing.assert_array_equal(
        correlation_strain(temperature=np.full(2, np.nan), pressure=np.nan), RELAXATION_STRAIN
    )


def test_correlation_strain_of_seeds_of_unequal_length_is_that_of_their_flow():
    """A temperature that is correlated over 40 units of strain, so that 80 are one sample."""
    rng, found = np.random.default_rng(0), []
    for _ in range(20):
        seeds = []
        for length in (1, 1, 1, 8):
            series = 10 + ar1(rng, (1, 256 * length), np.exp(-1 / 40)).reshape(256, -1).mean(axis=1)
            moment = length * series[:, None, None] * np.eye(2)
            tally = replace(
                random_tally(rng, 256), duration=np.full(256, float(length)), kinetic_moment=moment
            )
            seeds.append(sample_of_tally(tally, ShearFlow(100, 0.5, 0.6, 1e-3)))
        found.append(correlation_strains(seeds)["granular_temperature"])
    # 8 % standard error; a short series shows less
    assert np.mean(found) == pytest.approx(80, rel=0.25)
