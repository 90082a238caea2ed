"""Kinetics of known velocities and of points at random is found again; that of a flow agrees with its contacts."""

import numpy as np
import pytest
from flows import GRAINS
from scipy.special import ndtr
from synthetic import SNAPSHOTS, assert_within_errors, snapshot_of

from jaxgran.analysis.velocity_correlations import near_contact, velocity_distribution
from jaxgran.contact.projected_methods import BarzilaiBorwein
from jaxgran.dynamics.snapshots import snapshot_series
from jaxgran.model.flow import ShearFlow
from jaxgran.sampling.averages import averages
from jaxgran.theory.gaussian_moments import gaussian_moments
from jaxgran.theory.mixture import mixture_contact_value

STRAIN = 40.0


def moving(velocities, radii):
    """Grains with velocities (times, grains, 2) at one place each."""
    return snapshot_of(np.zeros_like(velocities), velocities=velocities, radii=radii)


def test_gaussian_velocities_of_grains_of_any_mass_have_no_kurtosis() -> None:
    rng = np.random.default_rng(0)
    radii = rng.uniform(0.3, 0.7, 100)
    velocities = rng.normal(size=(1000, 100, 2)) * np.sqrt(3.0) / (2 * radii[:, None])
    found = velocity_distribution(moving(velocities, radii))
    assert_within_errors(found.temperature, 3.0)
    assert_within_errors(found.tensor, 3.0 * np.eye(2))
    for zero in (found.sonine, found.sonine_excess, found.anisotropy, found.shear):
        assert_within_errors(zero, 0.0)
        assert zero.error < 0.02
    assert_within_errors(found.size_temperatures, 3.0)


def test_anisotropic_gaussian_has_the_kurtosis_of_its_tensor_and_no_more() -> None:
    tensor = np.array([[1.5, -0.4], [-0.4, 0.5]])
    velocities = np.random.default_rng(1).normal(size=(1000, 100, 2)) @ np.linalg.cholesky(tensor).T
    found = velocity_distribution(moving(velocities, 0.5))
    assert_within_errors(found.tensor, tensor)
    assert_within_errors(found.anisotropy, 0.5)
    assert_within_errors(found.shear, -0.4)
    assert_within_errors(found.sonine, (0.5**2 + 0.4**2) / 2)
    assert_within_errors(found.sonine_excess, 0.0)


def test_equal_speeds_have_the_sonine_coefficient_of_a_circle() -> None:
    angle = np.random.default_rng(2).uniform(0, 2 * np.pi, (100, 50))
    found = velocity_distribution(moving(np.stack([np.cos(angle), np.sin(angle)], axis=-1), 0.5))
    np.testing.assert_allclose(found.sonine.value, -0.5)


def test_temperatures_of_size_classes_are_those_of_their_grains() -> None:
    rng = np.random.default_rng(3)
    radii = rng.permutation(np.repeat([0.4, 0.5, 0.6], 20))
    temperatures = np.where(radii == 0.4, 1.0, np.where(radii == 0.5, 2.0, 4.0))
    velocities = rng.normal(size=(500, 60, 2)) * (np.sqrt(temperatures) / (2 * radii))[:, None]
    found = velocity_distribution(moving(velocities, radii))
    np.testing.assert_allclose(found.size_classes, [0.8, 1.0, 1.2])
    assert_within_errors(found.size_temperatures, [1.0, 2.0, 4.0])


@pytest.fixture(scope="module")
def points():
    """Points at random with Gaussian velocities of one temperature tensor, in a shear of comparable speed."""
    rng, grains, side = np.random.default_rng(4), 40, 9.0
    radii = rng.uniform(0.37, 0.63, grains)
    tensor = np.array([[1.2, -0.3], [-0.3, 0.8]])
    velocities = rng.normal(size=(3000, grains, 2)) @ np.linalg.cholesky(tensor).T / (2 * radii[:, None])
    positions = rng.uniform(0, side, (3000, grains, 2))
    return snapshot_of(positions, velocities=velocities, radii=radii, side=side, tilt=0.2), radii, tensor


def test_points_at_random_obey_molecular_chaos(points) -> None:
    seen, radii, tensor = points
    found = near_contact(seen, shell=0.5)
    assert_within_errors(found.contact_value, 1.0)
    nu = np.pi * np.sum(radii**2) / 81
    assert_within_errors(
        found.contact_ratio,
        1 / mixture_contact_value(1.0, 1.0, nu, 2 * radii.mean(), 4 * np.mean(radii**2)),
        least=0.02,
    )
    assert_within_errors(found.speed_ratio, 1.0)
    assert_within_errors(found.velocity_correlation, 0.0)
    assert (
        found.contact_value.error < 0.05 and found.speed_ratio.error < 0.05 and found.velocity_correlation.error < 0.1
    )
    # the stress by brute force: the integral over the directions and normal velocities of every pair
    angle = (np.arange(30) + 0.5) * np.pi / 30
    n = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    i, j = np.triu_indices(len(radii), 1)
    d, mi, mj = radii[i] + radii[j], 4 * radii[i] ** 2, 4 * radii[j] ** 2
    spread = np.sqrt((1 / mi + 1 / mj)[:, None] * np.einsum("ka,ab,kb->k", n, tensor, n))
    grid = np.linspace(-10, 0, 201)
    density = np.diff(ndtr((grid - d[:, None, None] * (n[:, 0] * n[:, 1])[:, None]) / spread[..., None]), axis=-1)
    square = density @ ((grid[1:] + grid[:-1]) / 2) ** 2
    impulse = 1.5 * mi * mj / (mi + mj)
    exact = np.einsum("p,pk,ka,kb->ab", impulse * d**2, square, n, n) * 2 * np.pi / 30 / 81**2
    assert_within_errors(found.binary_stress, exact)


def test_grains_that_move_together_are_fully_correlated(points) -> None:
    seen, radii, _ = points
    common = np.random.default_rng(5).normal(size=(300, 1, 2))
    velocities = np.broadcast_to(common, (300, len(radii), 2))
    positions = seen.state.positions[:300]
    together = snapshot_of(positions, velocities=velocities, radii=0.5, side=9.0, shear_rate=1e-3)
    found = near_contact(together, shell=0.5)
    assert_within_errors(found.velocity_correlation, 1.0)
    assert found.speed_ratio.value < 1e-3


def test_grains_at_rest_have_no_ratios_and_no_warnings(points) -> None:
    found = near_contact(snapshot_of(points[0].state.positions[:3], side=9.0))
    assert found.collision_rate.value > 0  # the shear alone
    assert np.isnan(found.speed_ratio.value) and np.isnan(found.velocity_correlation.value)


def test_enskog_rate_is_that_of_kinetic_theory_at_its_temperature() -> None:
    """Grains with the sizes and the temperature that theory predicts, nearly isotropic: the same rate within 2 %."""
    alpha, nu = 0.95, 0.4
    theory = gaussian_moments(alpha, nu)
    diameters = 1 + 0.26 * (2 * (np.arange(60) + 0.5) / 60 - 1)
    side = float(np.sqrt(np.sum(np.pi * diameters**2 / 4) / nu))
    rng = np.random.default_rng(6)
    velocities = rng.normal(size=(200, 60, 2)) * np.sqrt(float(theory.granular_temperature)) / diameters[:, None]
    positions = rng.uniform(0, side, (200, 60, 2))
    found = near_contact(snapshot_of(positions, velocities=velocities, radii=diameters / 2, side=side), shell=0.3)
    expected = float(theory.collision_rate) * 59 / 60  # a grain does not collide with itself
    np.testing.assert_allclose(found.collision_rate.value / found.rate_ratio.value, expected, rtol=0.02)


def test_binary_stress_and_collision_rate_of_a_flow_follow_from_its_pairs(flowing, run) -> None:
    """Where collisions are binary, what pairs are about to do is what contacts then do."""
    flow = ShearFlow(GRAINS, 0.9, 0.6, 1e-3)
    state = flowing(0.6)
    seen = snapshot_series(flow, state, STRAIN, SNAPSHOTS)[1]
    _, tally = run(flow, state, round(STRAIN / flow.timestep), solver=BarzilaiBorwein())
    by_contacts = averages(tally, state.side**2, GRAINS, 1.0)
    np.testing.assert_allclose(by_contacts["force_ratio"], 1, atol=0.02)
    found = near_contact(seen, shell=0.08)
    assert_within_errors(found.binary_stress, np.asarray(by_contacts["binary_stress"]), errors=3)
    assert_within_errors(found.collision_rate, float(by_contacts["collision_rate"]), errors=3)
    pressure = np.trace(found.binary_stress.value) / 2
    assert np.all(np.diag(found.binary_stress.error) < 0.1 * pressure)
    assert found.collision_rate.error < 0.05 * found.collision_rate.value
    assert_within_errors(found.contact_ratio, 1.0, least=0.2)
