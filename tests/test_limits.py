"""Fits of the limits of large systems and of dense flow recover the laws that made the points."""

import numpy as np
import pytest

from benchmarks.size_limits import (
    AVERAGES,
    Flow,
    exponents,
    flows_of,
    law_of,
    limits_of,
    missing_part,
)

GRAINS = (400, 1600, 6400, 25600)
LAW = (0.45, 0.1, 0.8, 0.82)  # s, b, m, ν_w


def study(noise: float, seed: int = 0) -> list[dict]:
    """Twenty flows whose averages approach 2 by one law, with noise of the stated errors."""
    rng, rows = np.random.default_rng(seed), []
    for alpha in (0.1, 0.3, 0.5, 0.7, 0.9):
        for nu in (0.2, 0.5, 0.7, 0.75):
            flow = Flow("", alpha, nu, np.array(GRAINS, float), np.array(()), np.array(()))
            for grains, missing in zip(GRAINS, missing_part(np.array(LAW), flow), strict=True):
                value = 2 * (1 - missing)
                row = {x: [value * (1 + noise * rng.normal()), 2 * noise] for x in AVERAGES}
                row |= {"restitution": alpha, "packing_fraction": nu, "grains": grains}
                rows.append(row | {"source": "loose"})
    return rows


def test_the_law_that_made_the_averages_is_found_within_its_errors() -> None:
    law = law_of(flows_of(study(1e-3), AVERAGES[0]), spread=0.5)
    assert np.all(abs(np.array(law["constants"]) - LAW) < 4 * np.array(law["stderrs"]))
    assert law["chi_squared"] / law["freedom"] == pytest.approx(
        1, abs=4 * np.sqrt(2 / law["freedom"])
    )


def test_the_shared_exponent_is_in_its_interval_and_chi_squared_excludes_a_logarithm() -> None:
    flows = [flow for flow in flows_of(study(1e-3), AVERAGES[0]) if flow.packing_fraction <= 0.7]
    fit = exponents(flows)
    assert fit["freedom"] == 30
    assert fit["interval"][0] < LAW[0] < fit["interval"][1]
    assert fit["chi_squared"]["ln N"] > fit["best"][1] + 50
    for flow, limit in zip(flows, limits_of(flows, fit["interval"]), strict=True):
        assert limit["interval"][0] - 4e-3 < 2 < limit["interval"][1] + 4e-3, flow
