"""The fits of the dense limit find the laws of exact points."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.dense_limit import fit, free_fit

NUMBER = np.geomspace(0.01, 0.2, 12)
ERROR = 0.01 * NUMBER


@pytest.mark.parametrize(
    ("exponent", "amplitude", "critical"), [(0.35, 0.1, 0.845), (0.5, 0.2, 0.84), (0.81, 0.3, 0.83)]
)
def test_a_power_law_with_a_free_exponent_is_found(exponent: float, amplitude: float, critical: float) -> None:
    """Within half a step of the exponents that are tried."""
    points = {
        "inertial_number": NUMBER,
        "inertial_number_stderr": ERROR,
        "packing_fraction": critical - amplitude * NUMBER**exponent,
    }
    found = free_fit(points, "packing_fraction")
    (value, error), (offset, offset_error) = found["exponent"], found["offset"]
    assert abs(value - exponent) <= max(error, 0.0026)
    assert abs(offset - critical) <= max(offset_error, 1e-4)


@given(st.floats(0.05, 0.3), st.floats(-0.3, 0.3))
def test_a_correction_to_scaling_is_found_exactly(leading: float, correction: float) -> None:
    friction = 0.1 + leading * NUMBER**0.4 + correction * NUMBER
    found = fit(NUMBER, ERROR, friction, np.full_like(NUMBER, 1e-3), 0.4, 1.0)
    assert found.offset == pytest.approx(0.1, abs=1e-9)
    assert found.coefficients == pytest.approx((leading, correction), abs=1e-7)
    assert found.reduced_chi_squared < 1e-9
