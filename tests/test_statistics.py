"""Standard errors are those of many repetitions, and a drift is told from noise."""

import numpy as np
import pytest

from jaxgran import statistics
from jaxgran.statistics import correlation_length, drift, jackknife

TRIALS = 400


def ratio(sums: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    return {"ratio": sums["over"] / sums["under"]}


def error_of_ratio(sums: dict[str, np.ndarray]) -> float:
    return float(jackknife(ratio, sums)[1]["ratio"])


def correlated_blocks(rng: np.random.Generator, seeds: int, blocks: int) -> dict[str, np.ndarray]:
    """Return independent blocks whose numerator and denominator are correlated."""
    under = rng.normal(10.0, 1.5, (seeds, blocks))
    return {"over": 2.0 * under + rng.normal(0.0, 2.0, (seeds, blocks)), "under": under}


def ar1(rng: np.random.Generator, shape: tuple[int, int], correlation: float) -> np.ndarray:
    """Return stationary AR(1) series of unit variance along the last axis."""
    noise = rng.normal(size=shape)
    series = np.empty(shape)
    series[:, 0] = noise[:, 0]
    for k in range(1, shape[1]):
        series[:, k] = correlation * series[:, k - 1] + np.sqrt(1 - correlation**2) * noise[:, k]
    return series


def test_error_of_a_mean_is_the_textbook_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(statistics, "BLOCK_MERGES", (1,))
    over = np.random.default_rng(0).normal(size=(3, 8))
    value, error = jackknife(ratio, {"over": over, "under": np.ones((3, 8))})
    np.testing.assert_allclose(value["ratio"], over.mean(), rtol=1e-13)
    np.testing.assert_allclose(error["ratio"], over.std(ddof=1) / np.sqrt(over.size), rtol=1e-12)


@pytest.mark.parametrize("merge", statistics.BLOCK_MERGES)
def test_error_of_a_ratio_of_sums_is_that_of_the_delta_method(merge: int, monkeypatch: pytest.MonkeyPatch) -> None:
    # Var R = Var(x − R y) / (n ⟨y⟩²); here x − R y has the standard deviation 2, and ⟨y⟩ = 10.
    monkeypatch.setattr(statistics, "BLOCK_MERGES", (merge,))
    rng, seeds, blocks = np.random.default_rng(1), 4, 32
    variances = np.array([error_of_ratio(correlated_blocks(rng, seeds, blocks)) ** 2 for _ in range(TRIALS)])
    expected = 2.0**2 / (seeds * blocks * 10.0**2)
    assert abs(variances.mean() - expected) < 4 * variances.std() / np.sqrt(TRIALS) + 0.01 * expected


def test_error_of_a_ratio_of_sums_is_the_spread_of_many_samples() -> None:
    # The largest of the errors of three merges is taken, so the error errs on the large side, by 4 to 20 %.
    rng = np.random.default_rng(2)
    samples = [jackknife(ratio, correlated_blocks(rng, 4, 16)) for _ in range(TRIALS)]
    values = np.array([value["ratio"] for value, _ in samples])
    errors = np.array([error["ratio"] for _, error in samples])
    assert abs(values.mean() - 2.0) < 4 * values.std() / np.sqrt(TRIALS)
    spread, uncertainty = values.std(), values.std() / np.sqrt(2 * TRIALS)
    assert spread - 3 * uncertainty < errors.mean() < 1.2 * spread + 3 * uncertainty


def test_merging_correlated_blocks_enlarges_the_error_as_much_as_their_correlation_asks(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # A mean of four values of an AR(1) process with ρ = ½ has (4 + 6ρ + 4ρ² + 2ρ³)/4 times the variance of white noise.
    rng = np.random.default_rng(3)
    series = ar1(rng, (TRIALS, 64), 0.5)[:, None, :]
    mean_variance = {}
    for merge in (1, 4):
        monkeypatch.setattr(statistics, "BLOCK_MERGES", (merge,))
        variances = [error_of_ratio({"over": x, "under": np.ones_like(x)}) ** 2 for x in series]
        mean_variance[merge] = np.mean(variances)
    expected = (4 + 6 * 0.5 + 4 * 0.25 + 2 * 0.125) / 4
    assert mean_variance[4] / mean_variance[1] == pytest.approx(expected, rel=0.1)  # 4 % standard error


def test_largest_error_of_all_merges_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    sums = correlated_blocks(np.random.default_rng(4), 1, 16)
    all_merges = error_of_ratio(sums)
    single = []
    for merge in (1, 2, 4):
        monkeypatch.setattr(statistics, "BLOCK_MERGES", (merge,))
        single.append(error_of_ratio(sums))
    assert all_merges == max(single)


def test_merged_blocks_never_span_two_seeds(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(statistics, "BLOCK_MERGES", (2,))
    over = np.random.default_rng(5).normal(size=(2, 5))
    error = error_of_ratio({"over": over, "under": np.ones_like(over)})
    pairs = (over[:, 0:4:2] + over[:, 1:4:2]).ravel() / 2
    assert error == pytest.approx(pairs.std(ddof=1) / np.sqrt(4), rel=1e-12)


@pytest.mark.parametrize(("seeds", "known"), [(1, False), (2, True)])
def test_a_single_block_has_no_error(seeds: int, known: bool) -> None:
    over = np.random.default_rng(6).normal(size=(seeds, 1))
    value, error = jackknife(ratio, {"over": over, "under": np.ones_like(over)})
    assert value["ratio"] == pytest.approx(over.mean())
    assert np.isfinite(error["ratio"]) == known


def test_tensors_have_an_error_for_every_component() -> None:
    moments = np.random.default_rng(7).normal(5.0, 1.0, (2, 8, 2, 2))
    value, error = jackknife(lambda sums: {"moment": sums / 16}, moments)
    one, error_of_one = jackknife(lambda sums: {"moment": sums / 16}, moments[..., 0, 1])
    assert value["moment"].shape == error["moment"].shape == (2, 2)
    assert value["moment"][0, 1] == pytest.approx(one["moment"])
    assert error["moment"][0, 1] == pytest.approx(error_of_one["moment"])


@pytest.mark.parametrize("correlation", [0.0, 0.3, 0.6, 0.8])
def test_correlation_length_is_that_of_the_process(correlation: float) -> None:
    """An AR(1) series of n values is worth n (1 − φ)/(1 + φ) samples. Long series: a short one shows less."""
    rng, lengths = np.random.default_rng(6), []
    for _ in range(60):
        sums = {"over": ar1(rng, (4, 256), correlation), "under": np.ones((4, 256))}
        lengths.append(correlation_length(ratio, sums)["ratio"])
    expected = (1 + correlation) / (1 - correlation)
    error = np.std(lengths) / np.sqrt(len(lengths))
    # never below one, and what it leaves out in the end of the sum: within a tenth
    assert abs(np.mean(lengths) - expected) < 4 * error + 0.1 * expected


def test_errors_follow_from_correlation_lengths() -> None:
    """The variance of a mean is that of one value over the number of independent samples."""
    rng, means, predicted = np.random.default_rng(7), [], []
    for _ in range(TRIALS):
        over = ar1(rng, (2, 128), 0.7)
        length = correlation_length(ratio, {"over": over, "under": np.ones_like(over)})["ratio"]
        means.append(over.mean())
        predicted.append(over.var() * length / over.size)
    spread = np.var(means) * np.sqrt(2 / TRIALS)
    assert abs(np.mean(predicted) - np.var(means)) < 4 * spread


def test_length_of_a_constant_or_of_too_few_blocks_is_unknown() -> None:
    ones = np.ones((2, 8))
    assert np.isnan(correlation_length(ratio, {"over": ones, "under": ones})["ratio"])
    few = np.random.default_rng(8).normal(size=(2, 3))
    assert np.isnan(correlation_length(ratio, {"over": few, "under": few})["ratio"])


def test_drift_of_a_step_is_its_height() -> None:
    assert drift(np.repeat([1.0, 3.5], 10)) == (2.5, 0.0)
    assert drift(np.array([0.0, 0.0, 9.0, 1.0, 1.0]))[0] == 1.0  # the middle of an odd series is left out


@pytest.mark.parametrize("correlation", [0.0, 0.6])
def test_drift_and_its_error_hold_for_correlated_noise(correlation: float) -> None:
    # Deviations in units of the error are Gaussian: 95.4 % lie within two.
    rng, length, shift, trials = np.random.default_rng(8), 400, 0.7, 2000
    series = ar1(rng, (trials, length), correlation) + shift * (np.arange(length) >= length // 2)
    differences, errors = np.array([drift(one) for one in series]).T
    assert abs(differences.mean() - shift) < 4 * differences.std() / np.sqrt(trials)
    covered = np.mean(np.abs(differences - shift) < 2 * errors)
    assert abs(covered - 0.954) < 4 * np.sqrt(0.954 * 0.046 / trials) + 0.01


def test_error_of_a_drift_of_four_values_takes_two_means_from_them() -> None:
    """Each half has one degree of freedom: σ² is estimated by Σ (x − mean)² / 2, and both means have half of it."""
    assert drift(np.array([0.0, 2.0, 5.0, 7.0])) == (5.0, pytest.approx(np.sqrt(4 / 2)))


def test_drift_of_a_record_with_nan_is_nan() -> None:
    assert np.isnan(drift(np.array([1.0, np.nan, 1.0, 1.0]))).all()
