"""Fits of the limits of large systems and of dense flow recover the laws that made the points."""

import numpy as np
import pytest

from benchmarks.dense_limit import fit, ratio_exponent
from benchmarks.size_limits import AVERAGES, law_totals, limits

GRAINS = (400, 1600, 6400, 25600)


def study(exponent: float, noise: float, seed: int = 0) -> list[dict]:
    """Ten flows whose averages approach 2 as N^(−exponent), with noise of the stated errors."""
    rng = np.random.default_rng(seed)
    rows = []
    for k in range(10):
        for grains in GRAINS:
            value = 2 - 3 * grains**-exponent
            row = {"restitution": 0.05 * k, "packing_fraction": 0.5, "grains": grains}
            rows.append(row | {name: [value + noise * rng.normal(), noise] for name in AVERAGES})
    return rows


@pytest.mark.parametrize(("law", "exponent"), [("N^(-1/3)", 1 / 3), ("N^(-1/2)", 1 / 2)])
def test_limits_scatter_as_their_errors_and_chi_squared_knows_the_law(law, exponent) -> None:
    rows = limits(study(exponent, 1e-3))
    deviations = [(row["limit"][law][0] - 2) / row["limit"][law][1] for row in rows]
    assert np.std(deviations) == pytest.approx(1, abs=4 / np.sqrt(2 * len(rows)))
    assert all(
        low < 2 < high for low, high in (row["interval"] for row in rows if abs(row["limit"][law][0] - 2) < 1e-3)
    )
    for test in law_totals(rows):
        assert test["freedom"] == 20
        assert test["probability"][law] > 1e-3 and test["probability"]["ln N"] < 1e-6


def test_dense_fit_with_a_correction_finds_the_limit_within_its_error() -> None:
    rng, number = np.random.default_rng(1), np.geomspace(0.02, 0.17, 16)
    found = []
    for _ in range(200):
        measured = number * (1 + 0.02 * rng.normal(size=16))
        fraction = 0.8435 - 0.06 * number**0.4 - 0.17 * number
        found.append(fit(measured, 0.02 * measured, fraction, np.zeros(16), 0.4, 1.0))
    offsets, errors = np.array([one[:2] for one in found]).T
    assert offsets.mean() == pytest.approx(0.8435, abs=0.3 * errors.mean())
    assert 0.7 < offsets.std() / errors.mean() < 1.3
    assert np.mean([one.reduced_chi_squared for one in found]) == pytest.approx(1, abs=0.15)


def test_exponent_of_pressure_over_temperature_is_that_of_the_points() -> None:
    nu = np.linspace(0.79, 0.83, 8)
    points = {
        "packing_fraction": nu,
        "pressure": (0.84 - nu) ** -3.5,
        "granular_temperature": (0.84 - nu) ** -1.5,
        "pressure_stderr": 0.01 * (0.84 - nu) ** -3.5,
        "granular_temperature_stderr": 0.01 * (0.84 - nu) ** -1.5,
    }
    exponent, error = ratio_exponent(points, 0.84)
    assert exponent == pytest.approx(2)
    assert 0 < error < 0.05
