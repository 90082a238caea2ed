"""The estimate for a large system contains the limit where there is one, and says where none is seen."""

import numpy as np
import pytest

from jaxgran.maps.large_system import BOUNDS, CONVERGED, large_system_estimate, large_system_variables
from jaxgran.maps.points import PointGrid, point_averages
from jaxgran.maps.settings import MapSettings

SIZES = np.array([100, 400, 1600])
SEEN, NOT_SEEN, TOO_FEW = (CONVERGED[name] for name in ("converged", "not_converged", "too_few_sizes"))

PRESSURES = {  # measured at N = 100, 400, 1600, and the largest N: 25600, and 6400 at ν = 0.8; by α and ν
    (0.2, 0.2): (0.302, 0.349, 0.367, 0.392),
    (0.2, 0.6): (1.02, 1.154, 1.279, 1.353),
    (0.5, 0.6): (1.277, 1.393, 1.466, 1.554),
    (0.8, 0.2): (1.761, 1.829, 1.887, 1.916),
    (0.8, 0.6): (4.10, 4.19, 4.32, 4.37),
    (0.95, 0.6): (21.2, 21.4, 21.65, 21.9),
    (0.2, 0.8): (66.8, 58.7, 57.4, 57.8),
    (0.8, 0.8): (81.0, 72.1, 73.3, 73.4),
}


def growth(grains: np.ndarray, last: float = np.inf) -> np.ndarray:
    """An average that grows by 0.1 for each factor of four in N, up to a last N."""
    return 1 + 0.1 * np.log(np.minimum(grains, last) / 100) / np.log(4)


@pytest.mark.parametrize("flow", PRESSURES)
def test_pressure_of_much_larger_systems_is_in_the_interval(flow: tuple[float, float]) -> None:
    *values, expected = PRESSURES[flow]
    found = large_system_estimate(SIZES, np.array(values), 0.01 * np.array(values), BOUNDS["pressure"])
    assert found.converged == SEEN and found.value == values[-1]
    assert abs(expected - found.value) < found.error < 0.21 * found.value


def test_constant_is_its_own_limit_within_its_errors() -> None:
    found = large_system_estimate(SIZES, np.full(3, 5.0), np.full(3, 0.05), 2.0)
    assert found.value == 5 and found.converged == SEEN
    assert found.error == pytest.approx(0.05 * np.sqrt(1.96**2 + 2**2 * 2))
    assert large_system_estimate(SIZES, np.full(3, 5.0), np.zeros(3), 2.0) == (5.0, 0.0, SEEN)


def test_noise_alone_is_rarely_taken_for_growth_without_a_limit() -> None:
    noise = np.random.default_rng(0).normal(size=(1000, 3))
    found = [large_system_estimate(SIZES, 1 + 0.01 * x, np.full(3, 0.01), 2.0).converged for x in noise]
    assert np.mean(np.array(found) == NOT_SEEN) < 0.03


def test_growth_that_has_stopped_has_a_limit_and_that_which_goes_on_has_none() -> None:
    errors = np.full(3, 2e-3)
    stopped = large_system_estimate(SIZES, growth(SIZES, last=500), errors, 2.0)
    assert stopped.converged == SEEN and abs(growth(np.array(1e6), last=500) - stopped.value) < stopped.error
    unlimited = large_system_estimate(SIZES, growth(SIZES), errors, 2.0)
    assert unlimited.converged == NOT_SEEN and np.isnan(unlimited.value) and np.isnan(unlimited.error)
    assert large_system_estimate(SIZES, growth(SIZES), np.full(3, 0.1), 2.0).converged == SEEN  # hidden by the errors


@pytest.mark.parametrize("power", [0.5, 1.0])
def test_power_of_the_size_of_the_system_has_its_limit_in_the_interval(power: float) -> None:
    found = large_system_estimate(SIZES, 2 - (SIZES / 10) ** -power, np.full(3, 1e-4), 2.0)
    assert found.converged == SEEN and abs(2 - found.value) < found.error


@pytest.mark.parametrize("sizes", [[64, 1600], [100, 200, 400, 800, 1600], [800, 1000, 1600], [256, 1000, 4000]])
def test_difference_is_that_of_a_factor_of_four_for_any_sizes(sizes: list[int]) -> None:
    found = large_system_estimate(np.array(sizes), growth(np.array(sizes)), np.full(len(sizes), 0.2), 0.0)
    assert found.error == pytest.approx(1.96 * 0.2)  # K = 0 leaves the sampling error
    few = np.array([sizes[0], sizes[-1]])
    found = large_system_estimate(few, growth(few), np.zeros(2), 3.0)
    assert found.error == pytest.approx(3 * 0.1) and found.converged == TOO_FEW


def test_limit_is_judged_alike_for_any_factor_between_the_sizes() -> None:
    """Steps that shrink by q at a factor of four are bounded by K of them if q < K/(1 + K)."""
    for factor in (2, 4, 10):
        sizes = 100 * factor ** np.arange(4)
        for q, expected in ((0.64, SEEN), (0.69, NOT_SEEN)):
            values = 1 - q ** (np.log(sizes) / np.log(4))
            assert large_system_estimate(sizes, values, np.full(4, 1e-6), 2.0).converged == expected


def test_order_of_the_sizes_and_sizes_without_a_value_do_not_matter() -> None:
    expected = large_system_estimate(SIZES, growth(SIZES, 500), np.full(3, 0.01), 2.0)
    sizes, values, errors = np.array([1600, 400, 100]), growth(SIZES, 500)[::-1], np.full(3, 0.01)
    assert large_system_estimate(sizes, values, errors, 2.0) == expected
    more = np.append(sizes, 6400), np.append(values, np.nan), np.append(errors, 0.01)
    assert large_system_estimate(*more, 2.0) == expected
    alone = large_system_estimate(SIZES[:1], np.ones(1), np.ones(1), 2.0)
    assert np.isnan(alone.value) and alone.converged == TOO_FEW


def test_variables_of_a_map_stand_at_their_points() -> None:
    settings = MapSettings((0.5, 0.9), (0.5, 0.6), grains=tuple(SIZES.tolist()), strain=2.0)
    values = (growth(SIZES, 500)[:, None] * np.arange(1.0, 5.0)).ravel()
    averages = point_averages(settings, {})
    for name in BOUNDS:
        averages.values[name][:], averages.stderrs[name][:] = values, 0.01 * values
    variables = large_system_variables(settings, PointGrid.of(settings), averages)
    assert set(variables) == {f"{name}{end}" for name in BOUNDS for end in ("", "_ci95", "_converged")}
    for name, variable in variables.items():
        assert variable.dims == ("packing_fraction", "restitution") and variable.attrs["long_name"]
        assert ("flag_values" in variable.attrs) == name.endswith("_converged") == ("units" not in variable.attrs)
    np.testing.assert_array_equal(variables["pressure"], values.reshape(-1, 2, 2)[-1])
    wider = variables["granular_temperature_ci95"] / variables["pressure_ci95"]
    assert np.all((wider > 1.4) & (wider < 1.5))  # K is 3 and not 2
    flags = variables["pressure_converged"].attrs
    assert dict(zip(flags["flag_meanings"].split(), flags["flag_values"].tolist(), strict=True)) == CONVERGED
