"""The error budget: its parts follow from laws, and the laws bound what the study of sizes measured."""

import json
from pathlib import Path

import numpy as np
import pytest

from jaxgran.sampling.budget import BUDGET, error_budget, fewest_grains, size_error
from jaxgran.sampling.timestep import stress_error

STUDY = Path(__file__).parents[1] / "benchmarks" / "results" / "size_study.json"
MEASURED = {
    "force_ratio": 1.3,
    "pressure": 2.0,
    "contact_pressure": 1.5,
    "shear_stress": 0.8,
    "granular_temperature": 0.4,
    "local_granular_temperature": 0.3,
    "macroscopic_friction": 0.4,
}


def budget_of(stderr=0.0, timestep=0.0, tolerance=0.0, grains=10**16):
    return error_budget(MEASURED, dict.fromkeys(MEASURED, stderr), 0.5, 0.6, grains, timestep, tolerance)


def test_every_part_alone_is_the_whole_error():
    for name, value in MEASURED.items():
        if name not in BUDGET:
            continue
        assert budget_of(stderr=0.01)[name]["total"] == pytest.approx(0.0196, rel=1e-4)
        step = 0.0 if name == "force_ratio" else float(stress_error(1e-3 * np.sqrt(0.4), 0.6)) * value
        assert budget_of(timestep=1e-3)[name]["total"] == pytest.approx(step, rel=1e-4, abs=1e-7)
        assert budget_of(tolerance=1e-4)[name]["total"] == pytest.approx(34e-4 * 0.75 * value, rel=1e-3)


def test_parts_add_as_squares():
    parts = budget_of(0.01, 1e-3, 1e-4, 256)["pressure"]
    squares = (1.96 * 0.01) ** 2 + parts["timestep"] ** 2 + parts["size"] ** 2 + parts["tolerance"] ** 2
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


def test_bound_of_the_size_holds_in_the_study():
    """Differences from the largest N of each flow, less two standard errors; two in a hundred may be larger."""
    rows = json.loads(STUDY.read_text())["flows"]
    largest = {(row["restitution"], row["packing_fraction"]): row for row in rows}  # the last one of each flow
    inside = []
    for row in (row for row in rows if row not in largest.values()):
        flow = row["restitution"], row["packing_fraction"]
        values = {name: row[name][0] for name in BUDGET} | {"contact_pressure": row["pressure"][0]}
        budget = error_budget(values, dict.fromkeys(values, 0.0), *flow, row["grains"], 0.0, 0.0)
        for name in BUDGET:
            (value, error), (limit, limit_error) = row[name], largest[flow][name]
            inside.append(abs(value - limit) <= budget[name]["size"] + 2 * np.hypot(error, limit_error))
    assert len(inside) >= 200 and np.mean(inside) >= 0.98
