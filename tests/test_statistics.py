"""Standard errors are those of many repetitions, intervals hold, and a drift is told from noise."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import stdtrit

from jaxgran import statistics
from jaxgran.model.flow import steps_of_blocks
from jaxgran.statistics import correlation_length, drift, standard_errors

TRIALS = 400


def ratio(sums: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    return {"ratio": sums["over"] / sums["under"]}


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


@pytest.mark.parametrize("correlation", [0.0, 0.3, 0.6, 0.8])
def test_correlation_length_is_that_of_the_process(correlation: float) -> None:
    """n values of AR(1) are worth n (1 − φ)/(1 + φ) samples; a short series shows less."""
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


def mean(sums: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    return {"mean": (sums["x"].T / sums["count"].T).T}


def counted(series: np.ndarray) -> dict[str, np.ndarray]:
    return {"x": series, "count": np.ones(series.shape[:2])}


def error_of_mean(series: np.ndarray) -> np.ndarray:
    """Errors of the means of series (seeds, blocks, ...)."""
    return standard_errors(mean, counted(series))[1]["mean"]


@pytest.mark.parametrize("seeds", [1, 2, 4, 8])
@pytest.mark.parametrize("memory", [0.01, 0.5, 1.0, 2.0])
def test_intervals_hold_if_a_seed_is_sixteen_times_as_long_as_its_memory(
    memory: float, seeds: int
) -> None:
    """95 % intervals of 32 blocks hold in 92 to 98 % of the trials, and are not too wide."""
    correlation, trials = np.exp(-1 / memory), 1000
    rng = np.random.default_rng(9)
    series = np.stack([ar1(rng, (trials, 32), correlation).T for _ in range(seeds)])
    errors, deviations = error_of_mean(series), np.abs(series.mean(axis=(0, 1)))
    lags = np.arange(1, 32)
    true = np.sqrt((1 + 2 * np.sum((1 - lags / 32) * correlation**lags)) / (32 * seeds))
    binomial = np.sqrt(0.95 * 0.05 / trials)
    assert 0.92 - 2 * binomial < np.mean(deviations < 1.96 * errors) < 0.98 + 2 * binomial
    assert np.mean(errors) < 1.3 * true


@pytest.mark.parametrize("memory", [0.3, 8.0])
def test_intervals_of_seeds_of_unequal_length_are_those_of_one_correlation_time(
    memory: float,
) -> None:
    """Sixteen short seeds with correlated blocks, and one eight times as long without."""
    rng, lengths, found = np.random.default_rng(0), [1] * 16 + [8], []
    for _ in range(TRIALS):
        series = [ar1(rng, (1, 32 * length), np.exp(-1 / memory)) for length in lengths]
        sums = {"over": np.stack([x.reshape(32, -1).sum(axis=1) for x in series])}
        sums["under"] = np.repeat(np.array(lengths, float)[:, None], 32, axis=1)
        value, error = standard_errors(ratio, sums, sums["under"].sum(axis=1))
        found.append((value["ratio"], error["ratio"]))
    values, errors = np.array(found).T
    assert 0.95 < errors.mean() / values.std() < 1.15  # 3.5 % standard error
    assert np.mean(np.abs(values) < 1.96 * errors) > 0.925


def test_interval_is_that_of_the_posterior_integrated_by_brute_force() -> None:
    """The likelihood of eight values, summed over mean, ln σ, memory and white share."""
    x = ar1(np.random.default_rng(10), (2, 4), 0.5) + 3.0
    lag = np.abs(np.subtract.outer(np.arange(4), np.arange(4)))
    half = 1.959964 * error_of_mean(x)
    # less the plain mean; even in a scale that reaches far
    means = half * np.sinh(np.linspace(-9, 9, 3601))
    spacing = np.hypot(means, half)
    log_deviation = np.linspace(-4, 9, 131)[:, None]
    mass = np.zeros(means.size)
    for memory in statistics._TIMES:
        for white in statistics._WHITE_SHARES:
            correlation = (1 - white) * np.exp(-lag / memory) + white * np.eye(4)
            residuals = (x - x.mean())[:, :, None] - means
            square = np.einsum("sim,ij,sjm->m", residuals, np.linalg.inv(correlation), residuals)
            likelihood = np.exp(-square * np.exp(-2 * log_deviation) / 2 - 8 * log_deviation).sum(
                axis=0
            )
            prior = memory**0.25 / (1 + (memory / 2.5) ** 2)
            mass += prior * likelihood / np.linalg.det(correlation)  # two seeds
    mass *= spacing
    inside = np.abs(means) <= half * (1 + 1e-12)
    assert mass[inside].sum() / mass.sum() == pytest.approx(0.95, abs=2e-3)


def test_seeds_of_one_block_are_independent_and_have_the_error_of_student() -> None:
    for seeds in (2, 3, 10, 200):
        values = np.random.default_rng(seeds).normal(size=(seeds, 1))
        usual = values.std(ddof=1) / np.sqrt(seeds)
        assert error_of_mean(values) == pytest.approx(
            usual * stdtrit(seeds - 1, 0.975) / 1.959964, rel=1e-4
        )


@given(
    scale=st.floats(1e-6, 1e6) | st.sampled_from([1e-290, 1e-160, 1e160, 1e290]),
    shift=st.floats(-100, 100),
    seed=st.integers(0, 1000),
    shape=st.sampled_from([(1, 2), (1, 5), (2, 32), (3, 7)]),
)
def test_errors_scale_with_the_values_and_do_not_see_their_origin_order_or_direction(
    scale: float, shift: float, seed: int, shape: tuple[int, int]
) -> None:
    values = ar1(np.random.default_rng(seed), shape, 0.6)
    error = error_of_mean(values)
    assert error_of_mean(scale * (values + shift)) == pytest.approx(scale * error, rel=1e-6)
    assert error_of_mean(-values[::-1, ::-1]) == pytest.approx(error, rel=1e-6)


def test_standard_error_of_a_ratio_of_sums_is_the_spread_of_many_samples() -> None:
    rng = np.random.default_rng(13)
    samples = [standard_errors(ratio, correlated_blocks(rng, 4, 16)) for _ in range(TRIALS)]
    values = np.array([value["ratio"] for value, _ in samples])
    errors = np.array([error["ratio"] for _, error in samples])
    uncertainty = values.std() / np.sqrt(2 * TRIALS)
    assert values.std() - 3 * uncertainty < errors.mean() < 1.2 * values.std() + 3 * uncertainty


def test_blocks_that_differ_by_a_step_have_the_error_of_all_their_steps() -> None:
    """White noise of each step, in blocks of five and six, as of a strain that 32 do not divide."""
    rng, steps = np.random.default_rng(12), steps_of_blocks(np.array(176.0), 32)
    assert set(steps.tolist()) == {5, 6}
    noise = np.sqrt(steps)[:, None] * rng.normal(size=(2, 32, TRIALS))
    sums = {
        "over": steps[:, None] * 3 + noise,
        "under": np.broadcast_to(steps[:, None], noise.shape),
    }
    value, error = standard_errors(ratio, sums)
    expected = 1 / np.sqrt(2 * 176)
    assert np.std(value["ratio"]) == pytest.approx(expected, rel=4 / np.sqrt(2 * TRIALS))
    covered = np.mean(np.abs(value["ratio"] - 3) < 1.959964 * error["ratio"])
    assert covered > 0.95 - 4 * np.sqrt(0.95 * 0.05 / TRIALS)


def test_error_of_equal_blocks_is_zero_and_of_an_unknown_value_unknown() -> None:
    values = np.random.default_rng(14).normal(size=(2, 8, 3))
    values[..., 1], values[0, 3, 2] = 1.0, np.nan
    errors = error_of_mean(values)
    assert errors[0] == pytest.approx(error_of_mean(values[..., 0]), rel=1e-12)
    assert errors[1] == 0 and np.isnan(errors[2])
    assert np.isnan(error_of_mean(np.ones((1, 1))))


def test_error_of_values_that_differ_by_rounding_is_zero() -> None:
    """Where two seeds are equal to the last bit the posterior has no width: no warnings."""
    for rng in map(np.random.default_rng, range(40)):
        under = np.ones((2, 40, 20))
        _, error = standard_errors(
            ratio, {"over": under + 1e-15 * rng.normal(size=under.shape), "under": under}
        )
        assert np.all(error["ratio"] == 0)


def test_drift_of_a_step_is_its_height() -> None:
    assert drift(np.repeat([1.0, 3.5], 10)) == (2.5, 0.0)
    # the middle of an odd series is left out
    assert drift(np.array([0.0, 0.0, 9.0, 1.0, 1.0]))[0] == 1.0


@pytest.mark.parametrize("correlation", [0.0, 0.6])
def test_drift_and_its_error_hold_for_correlated_noise(correlation: float) -> None:
    # Deviations in units of the error are Gaussian: 95.4 % lie within two.
    rng, length, shift, trials = np.random.default_rng(8), 400, 0.7, 2000
    series = ar1(rng, (trials, length), correlation) + shift * (np.arange(length) >= length // 2)
    differences, errors = np.array([drift(one) for one in series]).T
    assert abs(differences.mean() - shift) < 4 * differences.std() / np.sqrt(trials)
    covered = np.mean(np.abs(differences - shift) < 2 * errors)
    assert abs(covered - 0.954) < 4 * np.sqrt(0.954 * 0.046 / trials) + 0.01


def test_length_of_a_constant_or_of_too_few_blocks_is_unknown() -> None:
    ones = np.ones((2, 8))
    assert np.isnan(correlation_length(ratio, {"over": ones, "under": ones})["ratio"])
    few = np.random.default_rng(8).normal(size=(2, 3))
    assert np.isnan(correlation_length(ratio, {"over": few, "under": few})["ratio"])


def test_error_of_a_drift_of_four_values_takes_two_means_from_them() -> None:
    """Each half has one degree of freedom: σ² is Σ (x − mean)² / 2, and a mean has half of it."""
    assert drift(np.array([0.0, 2.0, 5.0, 7.0])) == (5.0, pytest.approx(np.sqrt(4 / 2)))
