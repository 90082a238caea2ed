"""The error budget: its parts follow from laws, and the laws bound what the study of sizes
measured.
"""

import json
from pathlib import Path

import numpy as np
import pytest

from jaxgran.sampling.budget import (
    BUDGET,
    SHARES,
    SIZE_LAWS,
    SizeLaw,
    error_budget,
    fewest_grains,
    size_error,
)
from jaxgran.sampling.timestep import stress_error

RESULTS = Path(__file__).parents[1] / "benchmarks" / "results"
MEASURED = {
    "force_ratio": 1.3,
    "pressure": 2.0,
    "contact_stress": np.array([[1.7, -0.5], [-0.5, 1.3]]),
    "shear_stress": 0.8,
    "granular_temperature": 0.4,
    "local_granular_temperature": 0.3,
    "macroscopic_friction": 0.4,
}


def budget_of(stderr=0.0, timestep=0.0, tolerance=0.0, grains=1e60):
    return error_budget(
        MEASURED, dict.fromkeys(MEASURED, stderr), 0.5, 0.6, grains, timestep, tolerance
    )


def test_every_part_alone_is_the_whole_error():
    for name, value in MEASURED.items():
        if name not in BUDGET:
            continue
        assert budget_of(stderr=0.01)[name]["total"] == pytest.approx(0.0196, rel=1e-4)
        step = (
            0.0 if name == "force_ratio" else float(stress_error(1e-3 * np.sqrt(0.4), 0.6)) * value
        )
        assert budget_of(timestep=1e-3)[name]["total"] == pytest.approx(step, rel=1e-4, abs=1e-7)
        assert budget_of(tolerance=1e-4)[name]["total"] == pytest.approx(
            34e-4 * 0.75 * value, rel=1e-3
        )


def test_parts_add_as_squares():
    parts = budget_of(0.01, 1e-3, 1e-4, 256)["pressure"]
    squares = (
        (1.96 * 0.01) ** 2 + parts["timestep"] ** 2 + parts["size"] ** 2 + parts["tolerance"] ** 2
    )
    assert parts["total"] ** 2 == pytest.approx(squares)


def test_error_of_the_size_of_a_force_ratio_is_a_share_of_its_excess():
    assert budget_of(grains=256)["force_ratio"]["size"] == pytest.approx(
        0.33 / (1 / float(size_error(0.5, 0.6, 256)) - 1)
    )


def test_chosen_grains_are_the_fewest_of_their_series():
    for alpha in (0.1, 0.5, 0.98):
        for nu in (0.1, 0.6, 0.75, 0.82):
            grains = fewest_grains(alpha, nu, 0.02)
            assert size_error(alpha, nu, grains) <= 0.02
            assert grains == 256 or size_error(alpha, nu, round(grains / 2**0.5)) > 0.02


@pytest.mark.parametrize("average", SIZE_LAWS)
def test_law_of_the_size_is_the_fitted_one_and_its_bound_holds(average: str) -> None:
    """Ratios of values at two N are those of the law within errors and spread, as often as 95 %
    intervals hold.
    """
    found = json.loads((RESULTS / "size_limits.json").read_text())["laws"][average]["law"]
    assert tuple(SIZE_LAWS[average]) == pytest.approx(found["constants"], rel=2e-3, abs=1e-4)
    assert found["differences"] > 80
    assert found["within"] >= 0.95 - 2 * np.sqrt(0.95 * 0.05 / found["differences"])


def test_shares_of_an_error_add_up_to_it():
    assert sum(share**2 for share in SHARES.values()) == pytest.approx(1, rel=1e-12)


def test_missing_part_is_that_of_its_formula():
    law = SizeLaw(exponent=0.5, elastic=0.01, dissipative=0.1, density=1.0, end=0.82)
    assert law.missing(0.4, 0.77, 400) == pytest.approx((0.01 + 0.06) * np.exp(0.27) * 0.5 * 2)
