"""Approach speeds of collisions: those of independent velocities, their moments, and what follows from the sums."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flows import GRAINS, flow_of
from hypothesis import given
from hypothesis import strategies as st

import jaxgran as jg
from benchmarks.approach_speeds import (
    EDGES,
    SLOW,
    SPEEDS,
    by_speed,
    estimate,
    exponent,
    independent,
    midpoints,
    observe,
    pairs_of_theory,
    sums_of,
)
from jaxgran.statistics import standard_errors
from jaxgran.theory.enskog import collisional_transfer

TENSOR = np.array([[1.3, -0.35], [-0.35, 0.8]])
RAYLEIGH = np.sqrt(np.pi / 2) * np.array([0, 1, 0, 3]) + np.array([1, 0, 2, 0])  # moments of x exp(−x²/2)


@pytest.mark.parametrize("temperature", [0.3, 40.0])
def test_speeds_without_shear_are_those_of_equilibrium_for_any_sizes(temperature) -> None:
    found = independent(temperature * np.eye(2), 0.6, shear_rate=0.0)
    x = found["x"]
    np.testing.assert_allclose(found["density"], x * np.exp(-(x**2) / 2), atol=1e-9)
    np.testing.assert_allclose(pairs_of_theory(found, found["powers"][0]), 1, rtol=1e-5)
    moments = found["powers"] / found["powers"][0]
    np.testing.assert_allclose(moments, RAYLEIGH * temperature ** (np.arange(4) / 2), rtol=1e-5)


def test_speeds_of_an_anisotropic_sheared_gas_are_those_of_pairs_drawn_at_random() -> None:
    """Equal discs: directions and relative velocities are drawn, and a pair collides at a rate of its speed."""
    rng, pairs = np.random.default_rng(0), 400_000
    angle = rng.uniform(0, 2 * np.pi, pairs)
    n = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    first, second = rng.multivariate_normal([0, 0], TENSOR, (2, pairs))
    w = -np.sum((first - second) * n, axis=1) - n[:, 0] * n[:, 1]
    w = np.maximum(w, 0) / np.sqrt(2)  # times the root of the reduced mass
    found = independent(TENSOR, 0.5, polydispersity=0.0)["powers"]
    for k in (1, 2, 3):
        weighted = w ** (k + 1) - found[k] / found[0] * w
        assert abs(weighted.mean()) < 4 * weighted.std() / np.sqrt(pairs)


def test_dissipation_of_independent_velocities_is_enskogs() -> None:
    alpha, nu = 0.7, 0.6
    square = independent(TENSOR, nu)["powers"][2]
    enskog = collisional_transfer(jnp.asarray(TENSOR), alpha, nu).dissipation_rate
    assert (1 - alpha**2) / 2 * square == pytest.approx(float(enskog), rel=1e-5)


def test_collisions_of_equilibrium_are_those_of_its_pairs_at_any_speed() -> None:
    temperature, area, duration, count = 0.7, 50.0, 3.0, 1e6
    x = EDGES / np.sqrt(temperature)
    histogram = -count * np.diff(np.exp(-(x**2) / 2))  # of the density x exp(−x²/2)
    sums = {"histogram": histogram, "duration": np.float64(duration)}
    found = by_speed(area, np.sqrt(temperature), count / (area * duration), sums)
    fastest, width = (
        SPEEDS[-1][-1],
        np.log(EDGES[1] / EDGES[0]),
    )  # a bin is (x · width)² wide in x²
    np.testing.assert_allclose(found["pairs_over_equilibrium"], 1, atol=(fastest * width) ** 2 / 12)
    assert found["slow_share_of_collisions"] == pytest.approx(1 - np.exp(-(SLOW**2) / 2), rel=0.1)


@given(st.floats(0.3, 8.0), st.floats(0.1, 10.0))
def test_exponent_of_a_density_is_found_from_its_moments_at_any_scale(beta, scale) -> None:
    x = np.concatenate([[0], np.geomspace(1e-9, 1e6, 20_000)])
    collisions = scale * x * np.exp(-(x**beta))
    m0, m1, m2, m3 = (np.trapezoid(collisions * x**k, x) for k in range(4))
    assert m0 > 0
    assert exponent(m3 * m1 / m2**2) == pytest.approx(beta, rel=1e-3)


def measured(flow: jg.ShearFlow, state: jg.State, strain: float) -> tuple[jg.Sample, dict, dict]:
    _, sample = jg.sample(flow, state, strain, observe=observe)
    found = partial(estimate, float(flow.restitution), flow.grains, float(sample.area))
    return sample, *standard_errors(found, sums_of([sample]))


def test_collisions_and_dissipation_are_those_of_the_running_sums(flowing) -> None:
    """The sums exactly, the histogram within the width of its bins."""
    sample, value, _ = measured(flow_of(0.6), flowing(0.6), 4.0)
    histogram = np.asarray(sample.observed_sums["histogram"])
    assert histogram.sum() == sample.tally.collisions.sum() > 0
    np.testing.assert_allclose(value["dissipation_rate"], sample.binary_dissipation_rate, rtol=1e-9)
    np.testing.assert_allclose(2 * value["collisions"] * sample.area / GRAINS, sample.collision_rate, rtol=1e-9)
    widest = (EDGES[1] / EDGES[0]) - 1
    assert abs(value["binned_over_summed_energy"] - 1) < widest
    assert np.sum(value["density"] * np.diff(EDGES)) == pytest.approx(1)
    assert np.all(midpoints() > EDGES[:-1])


def test_elastic_gas_collides_with_the_speeds_of_equilibrium() -> None:
    """Hot enough that the shear across a contact is nothing. Energy is that of the gas, so speeds are by 1/N slower."""
    flow = jg.ShearFlow(256, restitution=1.0, packing_fraction=0.3, timestep=1e-5)
    state = jg.heated(flow, jax.random.key(1), temperature=400.0)
    _, value, error = measured(flow, state, 0.25)
    expected = {
        "shape": 3 * np.pi / 8,
        "collisional_over_granular": 1 + 1 / 255,
        "velocity_kurtosis": 3 * 256 / 258,
    }
    for name, exact in expected.items():
        assert error[name] < 0.05 * exact
        assert abs(value[name] - exact) < 4 * error[name]
