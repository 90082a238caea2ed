"""The charts of speed against accuracy are made by one command, and what they judge by is right."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import run_chart
import timestep_study

BENCHMARKS = Path(run_chart.__file__).parent


@pytest.mark.slow
def test_quick_charts_are_made_by_one_command(tmp_path: Path) -> None:
    words = [sys.executable, str(BENCHMARKS / "speed_vs_accuracy.py"), "--quick", "--output", str(tmp_path)]
    made = subprocess.run(words, capture_output=True, text=True)
    assert made.returncode == 0, made.stderr
    for name in ("methods", "runs", "throughput"):
        assert json.loads((tmp_path / f"{name}_quick.json").read_text())["hardware"]["processor"]
        assert (tmp_path / f"{name}_quick.png").stat().st_size > 10_000
    rows = json.loads((tmp_path / "runs_quick.json").read_text())["flows"][0]["rows"]
    assert len(rows) == len(run_chart.QUICK.configs)
    assert all(row["seconds_per_strain"] > 0 for row in rows)


def config(seconds: float, error: float, noise: float, status: str = "ok") -> dict:
    return {"seconds_per_strain": seconds, "status": status, "errors": {"pressure": (error, noise)}}


def test_front_is_what_nothing_beats_in_cost_and_beyond_noise_in_error() -> None:
    rows = [
        config(1.0, 0.10, 0.01),
        config(2.0, -0.01, 0.005),
        config(3.0, 0.012, 0.005),  # dearer than the second, no worse within the noise
        config(4.0, 0.05, 0.005),  # dearer and worse than the second
        config(0.5, 0.0, 0.001, "deep_overlap"),  # beats nothing, and is on no front
    ]
    assert [run_chart.on_front(row, rows, "pressure") for row in rows] == [True, True, True, False, False]
    assert run_chart.staircase(rows, "pressure") == rows[:2]


def test_extrapolation_finds_the_limit_of_two_power_laws_within_its_interval() -> None:
    dt, rng = 10.0 ** -(6 - 0.5 * np.arange(7)), np.random.default_rng(0)
    for limit, exponents in ((0.0, (0.5, 1.0)), (0.7, (0.3, 0.4)), (2.0, (0.8, 0.6))):
        exact = [limit + amplitude * dt**power for amplitude, power in zip((3.0, 5.0), exponents, strict=True)]
        data = [(dt, rng.normal(excess, 0.01 * excess), 0.01 * excess) for excess in exact]
        (best, low, high), powers = timestep_study.joint_fit(data)
        width = high - low
        assert low <= best <= high
        assert low - width <= limit <= high + width
        if width < 0.1 * (1 + limit):
            np.testing.assert_allclose(powers, exponents, atol=0.15)
