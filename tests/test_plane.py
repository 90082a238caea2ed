"""The error of linear interpolation is zero at the points and for planes, and that of a parabola is
exact.
"""

import numpy as np
import xarray as xr
from made_up_maps import ratio_dataset

from jaxgran.plotting.plane import interpolated, interpolation_error, refined_axes


def uneven_map() -> tuple[xr.Dataset, np.ndarray, np.ndarray]:
    """A map on an uneven grid, with 1 − α and ν at its points."""
    data = ratio_dataset(5, 4).assign_coords(
        restitution=[0.1, 0.2, 0.5, 0.6, 0.9], packing_fraction=[0.3, 0.4, 0.7, 0.8]
    )
    return data, *np.meshgrid(1 - data.restitution.values, data.packing_fraction.values)


def test_a_plane_has_no_error() -> None:
    data, x, y = uneven_map()
    np.testing.assert_allclose(interpolation_error(data, 2 + 3 * x - 5 * y), 0.0, atol=1e-13)


def test_error_of_a_parabola_is_that_of_its_interpolation() -> None:
    data, x, y = uneven_map()
    fine_x, fine_y = np.meshgrid(*refined_axes(data))
    error = np.abs(interpolated(3 * x**2 + 2 * y**2) - 3 * fine_x**2 - 2 * fine_y**2)
    np.testing.assert_allclose(interpolation_error(data, 3 * x**2 + 2 * y**2), error, atol=1e-13)
    assert error.max() > 0.05
