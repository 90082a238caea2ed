"""Averages of a large system: parts of errors follow from laws, which hold for measured ones."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import binom

from jaxgran.sampling.budget import (
    ERROR_SOURCES,
    LARGE_SYSTEM,
    SIZE_LAWS,
    SizeLaw,
    jamming_error,
    large_system,
    sampling_target,
)
from jaxgran.sampling.timestep import JAMMING, stress_error

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


def large(stderr=0.0, timestep=0.0, tolerance=0.0, grains=1e60):
    return large_system(
        MEASURED, dict.fromkeys(MEASURED, stderr), 0.5, 0.6, grains, timestep, tolerance
    )


def test_every_part_alone_is_the_whole_error():
    for name in LARGE_SYSTEM:
        value = MEASURED[name]
        assert large()[name].value == pytest.approx(value) and large()[name].total < 1e-9
        assert large(stderr=0.01)[name].total == pytest.approx(0.0196, rel=1e-4)
        bound = float(stress_error(1e-3 * np.sqrt(0.4), 0.6, 1e60)) * value
        step = 0.0 if name == "force_ratio" else bound
        assert large(timestep=1e-3)[name].total == pytest.approx(step, rel=1e-4, abs=1e-7)
        assert large(tolerance=1e-4)[name].total == pytest.approx(34e-4 * 0.75 * value, rel=1e-3)


def test_parts_add_as_squares():
    parts = large(0.01, 1e-3, 1e-4, 256)["pressure"]
    assert parts.sources.keys() == ERROR_SOURCES.keys() and min(parts.sources.values()) > 0
    assert parts.total == pytest.approx(np.linalg.norm([*parts.sources.values()]))


def test_an_average_less_what_is_missing_is_the_one_at_its_number_of_grains() -> None:
    """The correction is undone by the law, and an error of the average grows by its slope."""
    estimates = large(stderr=0.01, grains=256)
    present = {name: 1 - float(law.missing(0.5, 0.6, 256)) for name, law in SIZE_LAWS.items()}
    for name, part in present.items():
        assert estimates[name].value * part == pytest.approx(MEASURED[name])
        assert estimates[name].sources["sampling"] * part == pytest.approx(0.0196, rel=1e-4)
    excess = estimates["force_ratio"].value - 1
    assert excess * present["pressure"] == pytest.approx(MEASURED["force_ratio"] - 1)
    friction = estimates["shear_stress"].value / estimates["pressure"].value
    assert estimates["macroscopic_friction"].value == pytest.approx(friction)


def test_size_errors_of_force_ratio_and_friction_are_shares_of_that_of_the_pressure() -> None:
    """The excess of a force ratio has 1.2 times the pressure's and another tenth, friction 0.9."""
    estimates = large(grains=256)
    share = estimates["pressure"].sources["size"] / estimates["pressure"].value
    excess, friction = (estimates[name] for name in ("force_ratio", "macroscopic_friction"))
    assert excess.sources["size"] == pytest.approx(1.2 * share * (excess.value - 1 + 0.1))
    assert friction.sources["size"] == pytest.approx(0.9 * share * friction.value)


def test_error_of_a_correction_falls_with_the_number_of_grains() -> None:
    sizes = 256 * 4 ** np.arange(6)
    for name in SIZE_LAWS:
        for alpha in (0.1, 0.5, 0.98):
            for nu in (0.1, 0.6, 0.75, 0.82):
                errors = SIZE_LAWS[name].error(alpha, nu, sizes)
                assert np.all(np.diff(errors) < 0) and 0 < errors[-1] < errors[0] < 1.5


def test_error_of_jamming_falls_with_the_number_of_grains_and_the_distance_to_jamming() -> None:
    near, far = JAMMING - 0.01, JAMMING - 0.1
    assert jamming_error(far, 100) == pytest.approx(0.07)
    assert jamming_error(near, 1600) == pytest.approx(10 * 0.07 / 32)


def test_sampling_takes_what_the_other_parts_of_an_error_leave() -> None:
    """A sample at its target has the requested error, and one that cannot has a negative target."""
    values = MEASURED | {"contact_stress": 2.0 * np.eye(2), "shear_stress": 2 * 0.4}
    tolerance, dt = 1e-3, 1e-3
    target = float(sampling_target(0.1, 0.5, 0.6, 1024, dt * np.sqrt(0.4), tolerance))
    errors = {name: target * np.asarray(x) for name, x in values.items()}
    reached = large_system(values, errors, 0.5, 0.6, 1024, dt, tolerance)
    shares = [reached[name].total / reached[name].value for name in ("pressure", "shear_stress")]
    assert max(shares) == pytest.approx(0.1, rel=1e-3) and min(shares) > 0.08
    assert sampling_target(0.01, 0.5, 0.6, 1024, dt * np.sqrt(0.4), tolerance) < 0


@pytest.mark.parametrize("average", SIZE_LAWS)
def test_law_of_the_size_is_the_fitted_one_and_its_bound_holds(average: str) -> None:
    """Ratios of averages at two N, fitted and not, are those of the law within errors and spread,
    as often as 95 % intervals hold. They hold no more, except those of the local temperature,
    whose boxes have more grains at some N.
    """
    fitted = json.loads((RESULTS / "size_limits.json").read_text())["laws"][average]["law"]
    assert SIZE_LAWS[average][:4] == pytest.approx(fitted["constants"], rel=2e-3, abs=1e-4)
    rows = [(fitted["differences"], fitted["within"])]
    rows += [(row["flows"], row["within"]) for row in checks_of(average)]
    ratios, within = (
        round(sum(x)) for x in zip(*((n, n * share) for n, share in rows), strict=True)
    )
    assert ratios > 200
    assert binom.cdf(within, ratios, 0.95) > 0.025
    assert binom.cdf(within, ratios, 0.95) < 0.975 or average.startswith("local")


def checks_of(average: str) -> list[dict]:
    results = json.loads((RESULTS / "size_limits.json").read_text())
    return [row for row in results["checks"] if row["average"] == average]


@pytest.mark.parametrize("average", LARGE_SYSTEM)
def test_flows_with_more_grains_are_within_the_intervals(average: str) -> None:
    """Ratios of averages that the law was not fitted to, as often as in intervals of 95 %."""
    checks = checks_of(average)
    flows = sum(row["flows"] for row in checks)
    within = sum(row["flows"] * row["within"] for row in checks)
    assert flows == 2 * 16
    assert binom.cdf(round(within), flows, 0.95) > 0.025


@pytest.mark.parametrize("average", LARGE_SYSTEM)
def test_corrected_averages_are_those_of_flows_with_more_grains(average: str) -> None:
    """The correction helps, and the intervals are not much wider than what they bound."""
    checks = checks_of(average)
    assert [row["grains"] for row in checks] == [256, 1024]
    for row in checks:
        assert row["corrected"] < row["as_it_is"] or row["as_it_is"] < 0.015
        assert row["half_width"] < 5 * row["corrected"]


def test_missing_part_is_that_of_its_formula():
    law = SizeLaw(exponent=0.5, strength=0.1, density=1.0, end=0.82, spread=0.5)
    assert law.missing(0.4, 0.77, 400) == pytest.approx(0.1 * 0.84 * np.exp(0.27) * 0.5 * 2)
