"""Stratified sample of the size distribution."""

import jax
import numpy as np
import pytest

from jaxgran.model.grains import own_grains, polydisperse

EPS = np.finfo(float).eps


@pytest.mark.parametrize("count", [16, 17, 1000])
@pytest.mark.parametrize("polydispersity", [0.0, 0.26, 0.5])
def test_sample_is_a_stratified_uniform_distribution(count, polydispersity):
    grains = polydisperse(count, polydispersity, jax.random.key(0))
    diameters = 2 * np.asarray(grains.radii)
    # exactly one, but for the rounding of single diameters
    assert abs(np.mean(diameters) - 1) <= 2 * EPS
    np.testing.assert_array_equal(grains.masses, diameters**2)
    edges = 1 + polydispersity * np.linspace(-1, 1, count + 1)
    middles = (edges[1:] + edges[:-1]) / 2
    np.testing.assert_allclose(np.sort(diameters), middles, rtol=0, atol=4 * EPS)


def test_key_permutes_the_sizes_and_nothing_else():
    first, second, again = (
        np.asarray(polydisperse(64, 0.26, jax.random.key(seed)).radii) for seed in (0, 1, 0)
    )
    np.testing.assert_array_equal(first, again)
    np.testing.assert_array_equal(np.sort(first), np.sort(second))
    assert np.mean(first == second) < 0.2
    neighbours = np.corrcoef(first[1:], first[:-1])[0, 1]
    # standard error of a correlation of independent numbers
    assert abs(neighbours) < 4 / np.sqrt(63)


def test_own_grains_are_in_units_of_their_mean_diameter_and_weigh_what_they_are_given():
    diameters = np.array([2.0, 4.0, 6.0])
    grains = own_grains(diameters)
    np.testing.assert_allclose(2 * grains.radii, [0.5, 1.0, 1.5])
    np.testing.assert_allclose(grains.masses, [0.25, 1.0, 2.25])
    np.testing.assert_array_equal(own_grains([2, 4, 6], [7, 8, 9]).masses, [7.0, 8.0, 9.0])
