"""The thresholds of what is decided without the user have the rates that are stated beside them."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from jaxgran.dynamics.batch import stack
from jaxgran.dynamics.engine import Numerics
from jaxgran.model.flow import ShearFlow
from jaxgran.model.status import Status
from jaxgran.sampling import steady_state
from jaxgran.sampling.blocks import Batch
from jaxgran.sampling.drift import is_level, is_level_noise
from jaxgran.sampling.thresholds import (
    DRIFT_BLOCKS,
    FEWEST_CHUNKS,
    MOST_CHUNKS,
    SAMPLE_DRIFT,
    STEADY,
    STEADY_AT_LAST,
)
from jaxgran.statistics import drift

# correlation of neighbours a quarter of the correlation strain apart
OF_CHUNKS = float(np.exp(-0.5))


def noise(seed: int, count: int, length: int, correlation: float) -> np.ndarray:
    """First-order autoregressive series (count, length) of variance one."""
    fresh = np.random.default_rng(seed).normal(size=(count, length))
    fresh[:, 1:] *= np.sqrt(1 - correlation**2)
    for k in range(1, length):
        fresh[:, k] += correlation * fresh[:, k - 1]
    return fresh


def holds(rate: float, outcomes: Any) -> bool:
    """Whether a share of outcomes is the stated rate, within four binomial standard deviations."""
    return abs(np.mean(outcomes) - rate) < 4 * np.sqrt(rate * (1 - rate) / len(outcomes))


def sample_drifts(series: np.ndarray, correlation: float) -> list[bool]:
    """Whether samples of this noise drift by more errors than accepted, however small that is."""
    limits = SAMPLE_DRIFT._replace(accepted=0.0)
    return [limits.are_exceeded(*drift(row, correlation)) for row in series]


@pytest.mark.parametrize("correlation_strains", [4, 6, 32])
def test_steady_samples_drift_at_the_stated_rate(correlation_strains: int) -> None:
    correlation = float(np.exp(-2 * correlation_strains / DRIFT_BLOCKS))
    series = noise(correlation_strains, 20_000, DRIFT_BLOCKS, correlation)
    assert holds(0.0013, sample_drifts(series, correlation))


def test_drifting_samples_are_found_at_the_stated_rate() -> None:
    correlation = float(np.exp(-2 * 6 / DRIFT_BLOCKS))
    series = noise(0, 2000, DRIFT_BLOCKS, correlation)
    step = np.arange(DRIFT_BLOCKS) >= DRIFT_BLOCKS // 2
    assert holds(0.86, sample_drifts(series + 4 * step, correlation))
    trends = [
        np.mean(sample_drifts(series + total * np.linspace(0, 1, DRIFT_BLOCKS), correlation))
        for total in (4, 8, 10, 14, 30)
    ]
    assert 0.15 < max(trends) < 0.19


@pytest.mark.parametrize("length", [8, 40])
def test_steady_records_are_level_at_the_stated_rate(length: int) -> None:
    differences = [drift(row, OF_CHUNKS) for row in noise(1, 4000, length, OF_CHUNKS)]
    within = [not STEADY._replace(accepted=0.0).are_exceeded(*pair) for pair in differences]
    assert holds(0.94, within)


def test_the_last_decision_has_the_stated_rates() -> None:
    series = 0.5 * noise(2, 4000, 40, OF_CHUNKS)
    assert sum(not is_level_noise(row, OF_CHUNKS) for row in series) < 4
    for total, refused in ((4, 0.39), (8, 0.99)):
        trend = 0.5 * total * np.linspace(0, 1, 40)
        assert holds(refused, [not is_level_noise(row, OF_CHUNKS) for row in series[:1000] + trend])
    for function in (is_level, is_level_noise):
        assert not function(np.full(40, np.nan))
    assert STEADY_AT_LAST.are_exceeded(np.nan, 1.0)


def prepared(monkeypatch: pytest.MonkeyPatch, series: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Chunks and statuses of preparations whose ln T and ln P are (2, replicas, chunks)."""
    chunks = iter(np.exp(series).transpose(2, 0, 1))

    def shear(batch: Batch, *_: Any) -> tuple[Batch, Any]:
        temperature, pressure = next(chunks)
        return batch, SimpleNamespace(
            averages={"granular_temperature": temperature, "pressure": pressure}
        )

    monkeypatch.setattr(steady_state, "shear_by_block", shear)
    monkeypatch.setattr(steady_state, "_with_correlation_strain", lambda batch, _: batch)
    count = series.shape[1]
    flow = stack([ShearFlow(32, 0.5, 0.6, 1e-3)] * count)
    state: Any = SimpleNamespace()
    zeros, four = np.zeros(count), np.full(count, 4.0)  # chunks of a strain of one
    end = steady_state._until_steady(
        Batch(flow, Numerics(), state, zeros.astype(int), zeros, four), steady_state.advance_batch
    )
    return end.strain, end.status


@pytest.mark.parametrize(
    ("deviation", "chunks"), [(0.05, 12.1), (0.1, 18.0), (0.15, 44.0), (0.2, 59.3)]
)
def test_steady_flows_pass_after_the_stated_number_of_chunks(
    deviation: float, chunks: float, monkeypatch
) -> None:
    series = deviation * noise(3, 300, MOST_CHUNKS, OF_CHUNKS).reshape(2, 150, -1)
    needed, status = prepared(monkeypatch, series)
    assert np.all(status == Status.ok)
    assert abs(np.mean(needed) - chunks) < 4 * np.std(needed) / np.sqrt(150) + 0.1
    assert np.min(needed) >= FEWEST_CHUNKS


@pytest.mark.parametrize("correlation_strains", [1, 2])
@pytest.mark.parametrize("deviation", [0.02, 0.1])
def test_a_relaxation_has_decayed_when_it_is_accepted(
    correlation_strains: int, deviation: float, monkeypatch
) -> None:
    series = deviation * noise(4, 200, MOST_CHUNKS, OF_CHUNKS).reshape(2, 100, -1)
    scale = 4 * correlation_strains  # in chunks
    series[0] += 2 * np.exp(-np.arange(MOST_CHUNKS) / scale)
    needed, status = prepared(monkeypatch, series)
    remainder = 2 * np.exp(-needed / scale)
    assert np.mean(status == Status.ok) > 0.97
    assert 0.002 < np.mean(remainder) < 0.02 and np.max(remainder) < 0.12
