"""Between the points of a map a quantity is linear, and missing beside a missing point."""

import numpy as np

from jaxgran.plotting.plane import refined


def test_a_plane_is_its_own_interpolation_and_missing_points_mask_only_their_cells() -> None:
    x, y = np.array([0.1, 0.2, 0.5, 0.9]), np.array([0.3, 0.4, 0.8])
    fine = refined(x), refined(y)
    field = 2 + 3 * x - 5 * y[:, None]
    expected = 2 + 3 * fine[0] - 5 * fine[1][:, None]
    np.testing.assert_allclose(refined(field), expected, atol=1e-14)
    field[0, 0] = np.nan
    inside = (fine[0] < x[1]) & (fine[1][:, None] < y[1])
    np.testing.assert_array_equal(np.ma.getmaskarray(refined(field)), inside)
