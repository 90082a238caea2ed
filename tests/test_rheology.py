"""Dense flow obeys the fitted laws: known parameters come back within their errors, and too few points are refused."""

import numpy as np
import pytest
import xarray as xr
from made_up_maps import FRACTION, FRICTION, dense_map, power
from synthetic import refused

from jaxgran.inference import friction_law as module
from jaxgran.inference.friction_law import FrictionLaw, dense_points, friction_law


def fit(data: xr.Dataset) -> FrictionLaw:
    return friction_law(data, largest_inertial_number=1.0)


def test_law_without_noise_is_found() -> None:
    law = fit(dense_map(seed=None, noise=1e-3))
    np.testing.assert_allclose(law.friction.parameters, FRICTION, rtol=1e-4)
    np.testing.assert_allclose(law.packing_fraction.parameters, FRACTION, rtol=1e-4)
    assert law.friction.chi_squared < 1e-6
    assert law.friction.points == law.packing_fraction.points == 16
    number = np.array([0.01, 0.1])
    np.testing.assert_allclose(law.friction(number), power(number, FRICTION), rtol=1e-5)


@pytest.mark.parametrize("correlation", [0.9, -0.9])
def test_parameters_lie_within_a_standard_error_as_often_as_gaussian_ones(correlation: float, monkeypatch) -> None:
    """Of all points; laws of each restitution are left out, as they take three times as long."""
    monkeypatch.setattr(module, "enough", lambda points: len(np.unique(points.restitution)) > 1)
    seeds = 40
    pulls, squares = [], []
    for seed in range(seeds):
        law = fit(dense_map(seed, alphas=(0.2, 0.5, 0.8), correlation=correlation))
        for part, true in ((law.friction, FRICTION), (law.packing_fraction, FRACTION)):
            pulls.append((part.parameters - true) / part.standard_errors)
            squares.append(part.chi_squared)
    within = np.mean(np.abs(pulls) < 1.0, axis=0)
    # errors grow with χ² > 1 and never shrink, so a few more than 68 % are within; four standard errors either side
    spread = 4.0 * np.sqrt(0.68 * 0.32 / (2 * seeds))
    assert np.all((within > 0.68 - spread) & (within < 0.72 + spread)), within
    assert np.abs(np.mean(pulls, axis=0)).max() < 4.0 / np.sqrt(2 * seeds) + 0.15  # no bias that matters
    assert np.mean(squares) == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / 21.0 / (2 * seeds)) + 0.05)


def test_variance_of_a_point_is_that_of_friction_and_of_inertial_number_times_squared_slope() -> None:
    data = dense_map(seed=None)
    number, error = data.inertial_number.values.ravel(), data.macroscopic_friction_stderr.values.ravel()
    slope = FRICTION[1] * FRICTION[2] * number ** (FRICTION[2] - 1.0)
    deviation = np.hypot(error, slope * 5.0 * data.inertial_number_stderr.values.ravel())
    law = fit(data.assign(inertial_number_stderr=5.0 * data.inertial_number_stderr)).friction
    power_of = number ** FRICTION[2]
    slopes = np.stack([np.ones_like(number), power_of, FRICTION[1] * power_of * np.log(number)]) / deviation
    np.testing.assert_allclose(law.covariance, np.linalg.inv(slopes @ slopes.T), rtol=1e-3)


def test_each_restitution_has_its_own_law() -> None:
    law = fit(dense_map(noise=2e-3, shift=0.1))
    assert list(law.by_restitution) == [0.2, 0.5]
    for alpha, offset in ((0.2, 0.10), (0.5, 0.20)):
        part = law.by_restitution[alpha].friction
        assert part.points == 8
        assert abs(part.parameters[0] - offset) < 3.0 * part.standard_errors[0]
    assert not law.by_restitution[0.2].by_restitution
    assert law.friction.chi_squared > 100.0  # one law for both is wrong, and says so


def test_errors_grow_where_the_scatter_is_larger_than_they_say() -> None:
    data = dense_map(seed=3, noise=0.02)
    less = [name for name in data if str(name).endswith("_stderr")]
    proud = data.assign({name: data[name] / 10.0 for name in less})
    modest, scaled = fit(data).friction, fit(proud).friction
    assert scaled.chi_squared == pytest.approx(100.0 * modest.chi_squared, rel=1e-3)
    expected = modest.standard_errors * np.sqrt(min(1.0, modest.chi_squared))
    np.testing.assert_allclose(scaled.standard_errors, expected, rtol=1e-3)


def test_only_dense_points_of_good_status_with_errors_count() -> None:
    data = dense_map(nus=10)
    data.status[9, 0] = 2
    data.macroscopic_friction[8, 1] = np.nan
    data.inertial_number_stderr[7, 0] = np.nan
    used = dense_points(data, largest_inertial_number=0.25, smallest_packing_fraction=0.76)
    flat = data.stack(point=("packing_fraction", "restitution"), create_index=False)
    expected = (flat.inertial_number <= 0.25) & (flat.packing_fraction >= 0.76) & (flat.status == 0)
    expected &= np.isfinite(flat.macroscopic_friction) & np.isfinite(flat.inertial_number_stderr)
    np.testing.assert_array_equal(used.inertial_number, flat.inertial_number[expected.values])
    law = friction_law(data, 0.25, 0.76)
    assert law.friction.points == used.sizes["point"]
    assert law.friction.span == (float(used.inertial_number.min()), float(used.inertial_number.max()))


def test_hot_dilute_flows_are_not_dense() -> None:
    data = dense_map()
    hot = data.assign_coords(packing_fraction=data.packing_fraction - 0.5)
    assert dense_points(hot).sizes["point"] == 0


@pytest.mark.parametrize(("alphas", "nus"), [((0.2,), 3), ((0.1, 0.2, 0.3, 0.4, 0.5), 2)])
def test_too_few_points_are_refused(alphas: tuple[float, ...], nus: int) -> None:
    with refused(rf"at least 4 points .* has {len(alphas) * nus} at {nus}\.$"):
        fit(dense_map(alphas=alphas, nus=nus))


def test_falling_friction_does_not_determine_a_law() -> None:
    data = dense_map(noise=1e-4)
    law = fit(data.assign(macroscopic_friction=0.2 - 0.1 * data.inertial_number)).friction
    assert not law.determined
    assert np.isinf(law.standard_errors).all()


@pytest.mark.parametrize("seed", range(0, 8, 2))
def test_points_without_a_law_are_fitted_without_complaint(seed: int) -> None:
    random = np.random.default_rng(seed)
    data = dense_map(alphas=(0.5,), nus=5)
    number = random.uniform(0.1, 0.12 + 0.02 * seed, data.inertial_number.shape)
    noisy = {"inertial_number": number, "macroscopic_friction": random.normal(0.3, 0.1, number.shape)}
    errors = ("inertial_number_stderr", "macroscopic_friction_stderr")
    small = {name: np.full(number.shape, 10.0**-seed) for name in errors}
    law = fit(data.assign({name: (data.inertial_number.dims, value) for name, value in (noisy | small).items()}))
    for part in (law.friction, law.packing_fraction):
        assert np.isfinite(part.parameters).all() and not np.isnan(part.covariance).any()


def test_shortest_time_step_is_fitted() -> None:
    data = dense_map()
    other = data.assign(macroscopic_friction=data.macroscopic_friction + 0.3)
    several = xr.concat([other, data], xr.Variable("timestep", [1e-3, 1e-4]))
    np.testing.assert_allclose(fit(several).friction.parameters, fit(data).friction.parameters)


def test_law_does_not_depend_on_the_order_of_the_map() -> None:
    data = dense_map()
    turned = data.isel(restitution=[1, 0], packing_fraction=slice(None, None, -1)).transpose()
    np.testing.assert_allclose(fit(turned).friction.parameters, fit(data).friction.parameters, rtol=1e-4)
