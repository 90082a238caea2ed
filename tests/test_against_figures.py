"""Figures against the number of grains and the time step show the averages of chosen flows; other
figures show the largest N and the shortest time step.
"""

import numpy as np
import pytest
import xarray as xr
from made_up_maps import ratio_dataset, with_grains, with_timesteps
from matplotlib.container import ErrorbarContainer
from matplotlib.figure import Figure

from jaxgran.maps.schema import parts
from jaxgran.plotting.against import MOST_CURVES, averages_against_grains, ratio_against_timestep

SIZES = (256, 1000, 4000)
NAMES = ("pressure", "granular_temperature", "force_ratio")


def curves_of(figure: Figure) -> list:
    return [container for axes in figure.axes for container in axes.containers]


def lengths(container: ErrorbarContainer) -> np.ndarray:
    """Return the lengths of the error bars of a curve."""
    return np.array([np.ptp(segment[:, 1]) for segment in container.lines[2][0].get_segments()])


@pytest.mark.parametrize(("alphas", "nus"), [(2, 2), (4, 3)])
def test_averages_are_drawn_over_those_at_the_largest_number_of_grains(alphas, nus) -> None:
    data = with_grains(ratio_dataset(alphas, nus), *SIZES)
    curves = curves_of(averages_against_grains(data.isel(grains=[1, 2, 0])))
    expected = [(name, *point) for name in NAMES for point in chosen(data)]
    for container, (name, nu, alpha) in zip(curves, expected, strict=True):
        point = data.sel(packing_fraction=nu, restitution=alpha)
        largest, errors = point[name].values[-1], point[f"{name}_stderr"]
        x, y = container.lines[0].get_xydata().T
        np.testing.assert_allclose(y, point[name] / largest)
        np.testing.assert_allclose(x, SIZES, rtol=0.1)
        np.testing.assert_allclose(lengths(container), 2 * errors / largest, rtol=1e-9)


def chosen(data: xr.Dataset) -> list[tuple[float, float]]:
    """Return ν and α of the curves of a map of few or many points."""
    if data.sizes["restitution"] * data.sizes["packing_fraction"] > MOST_CURVES:
        data = data.isel(restitution=[0, 2, -1], packing_fraction=[0, -1])
    return [(nu, alpha) for nu in data.packing_fraction.values for alpha in data.restitution.values]


@pytest.mark.parametrize(("alphas", "nus"), [(2, 3), (4, 3)])
def test_points_are_curves_against_the_time_step_with_their_errors(alphas, nus) -> None:
    data = with_timesteps(ratio_dataset(alphas, nus), 1e-3, 1e-4, 1e-5)
    curves = curves_of(ratio_against_timestep(data))
    for container, (nu, alpha) in zip(curves, chosen(data), strict=True):
        point = data.sel(packing_fraction=nu, restitution=alpha).sortby("timestep")
        expected = np.stack([point.timestep, point.force_ratio], -1)
        np.testing.assert_array_equal(container.lines[0].get_xydata(), expected)
        np.testing.assert_allclose(lengths(container), 2.0 * point.force_ratio_stderr, rtol=1e-9)


def test_parts_are_the_maps_at_every_number_of_grains_and_time_step() -> None:
    data = ratio_dataset(2, 2)
    several = with_timesteps(with_grains(data, *SIZES), 1e-3, 1e-4)
    found = [(part.attrs["grains"], part.attrs["timestep"]) for part in parts(several)]
    assert found == [(n, dt) for n in SIZES for dt in (1e-3, 1e-4)]
    assert parts(data)[0].identical(data)
