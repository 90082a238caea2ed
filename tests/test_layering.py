"""The prediction that sheared flows form layers, and what is read from the amplitude of a wave."""

import numpy as np
import pytest
import xarray as xr

from benchmarks.layering import INTERVAL, decay_strain, slopes


def made_up_map(friction, pressure) -> xr.Dataset:
    """A map of one restitution whose friction and pressure are functions of the packing fraction."""
    nu = np.linspace(0.2, 0.4, 201)
    fields = {
        "macroscopic_friction": friction(nu),
        "pressure": pressure(nu),
        "macroscopic_friction_stderr": np.full(nu.size, 1e-3),
        "pressure_stderr": np.full(nu.size, 1e-3),
    }
    dims = ("packing_fraction", "restitution")
    return xr.Dataset(
        {name: (dims, x[:, None]) for name, x in fields.items()}, {"packing_fraction": nu, "restitution": [0.5]}
    )


@pytest.mark.parametrize("slope", [0.5, -0.5])
def test_growth_rate_is_that_of_the_linearised_balances_at_long_wavelengths(slope) -> None:
    """Eigenvalues of the balances of mass and of both components of momentum, p = f γ̇² and τ = μ f γ̇² everywhere."""

    def friction(nu):
        return 0.3 + slope * nu

    def pressure(nu):
        return 0.2 + nu**2

    data = made_up_map(friction, pressure)
    at = 100
    nu = data.packing_fraction.values[at]
    f, df, mu, rho, k = pressure(nu), 2 * nu, friction(nu), 4 / np.pi * nu, 1e-3
    stress_by_fraction, stress_by_rate = slope * f + mu * df, 2 * mu * f
    # wave e^{iky} of packing fraction, velocity along y and velocity along x, at a shear rate of one
    matrix = np.array(
        [
            [0, -1j * k * nu, 0],
            [-1j * k * df / rho, 0, k**2 * 2 * f / rho],
            [1j * k * stress_by_fraction / rho, -1, -(k**2) * stress_by_rate / rho],
        ]
    )
    values = np.linalg.eigvals(matrix)
    slow = values[np.argmin(np.abs(values))]
    assert slopes(data).rate[at, 0] * k**2 == pytest.approx(slow.real, rel=1e-3)
    assert np.sign(slow.real) == np.sign(slope)


def test_error_of_a_slope_is_that_of_a_difference_of_neighbours() -> None:
    data = made_up_map(lambda nu: nu, lambda nu: 1 + nu)
    spacing = float(np.diff(data.packing_fraction.values)[0])
    found = slopes(data)
    assert found.friction[100, 0] == pytest.approx(1)
    assert found.friction_error[100, 0] == pytest.approx(np.sqrt(2) * 1e-3 / (2 * spacing))
    assert found.rate_error[100, 0] > found.rate[100, 0] * found.friction_error[100, 0]


def test_decay_of_a_wave_is_that_of_its_random_process() -> None:
    """A complex autoregressive process that forgets by exp(−1/8) from one amplitude to the next."""
    rng, count, kept = np.random.default_rng(0), 40_000, np.exp(-1 / 8)
    noise = rng.normal(size=(count, 2)) @ [1, 1j]
    amplitude = np.zeros(count, complex)
    for step in range(1, count):
        amplitude[step] = kept * amplitude[step - 1] + noise[step]
    assert decay_strain(amplitude) == pytest.approx(8 * INTERVAL, rel=0.15)
    assert np.isnan(decay_strain(np.ones(100)))
