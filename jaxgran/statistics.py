"""Standard errors of estimates from block sums, statistical inefficiency, drift of a series.

``standard_errors`` infers the correlation time from the blocks themselves; its intervals have the
stated coverage when each seed is several correlation times long.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from typing import Any

import jax
import numpy as np
import scipy  # its parts are loaded when they are used

_MOST_BLOCKS = 32  # per seed in ``standard_errors``; more are merged
_TIMES = np.geomspace(0.2, 100, 16)  # correlation times, in blocks
_WHITE_SHARES = np.array([0.0, 0.5, 0.9])  # share of white noise in the variance of a block
_EXPECTED_TIME = 2.5  # blocks, beyond which the prior of an unknown correlation time falls
_LONGER = 1.5  # centre of the prior of a correlation time over the expected one
_LEVEL = 0.95  # of an interval of 1.96 standard errors
_NORMAL_QUANTILE = 1.959964
_NEWTON_STEPS = 4
_ROUNDING = 64 * np.finfo(float).eps  # of an estimate, to a scatter of the blocks that is none
Estimates = dict[str, np.ndarray]


def standard_errors(
    estimate: Callable[[Any], Mapping[str, Any]],
    sums: Any,
    lengths: np.ndarray | None = None,
    correlation: float | None = None,
) -> tuple[Estimates, Estimates]:
    """Estimates from the sums over all blocks of all seeds, and their standard errors.

    The error is the half-width of the 95 % interval divided by 1.96, so ±1.96 errors is a 95 %
    interval even if few blocks are independent and Student's distribution is wide. The jackknife
    influence of each block makes a series, modelled as a mean plus Gaussian noise with the
    correlation

        R_ij = (1 - w) exp(-|i - j| / t) + w δ_ij

    within a seed and none between seeds: a first-order autoregressive process plus white noise. The
    correlation time t, in blocks, and the share w of white noise are unknown. For given (t, w),
    with flat priors for the mean and for ln σ, the mean has a Student's t distribution with M - 1
    degrees of freedom for M blocks in all. Its centre is the generalised least-squares mean μ =
    1'R⁻¹x / 1'R⁻¹1, its scale S / √((M - 1) 1'R⁻¹1) with S² = (x - μ)'R⁻¹(x - μ), and its weight
    |R|^(-1/2) (1'R⁻¹1)^(-1/2) S^(1 - M). The interval is that of the mixture over 16 correlation
    times from 0.2 to 100 blocks and three values of w, around the plain mean. The prior is flat in
    w. In ln t it is Gaussian with a standard deviation of one about 1.5 times the expected
    correlation time, or about one block where that is longer; and t^(1/4) / (1 + (t/2.5)²) where
    none is expected. A series that is shorter than its correlation cannot show it: without an
    expected time its error is far too small.

    Blocks of shorter seeds are merged until they last about as long as those of the longest, so
    that one correlation time holds for all, see ``merged_blocks``.

    Args:
      estimate: maps a pytree of sums with any leading axes to estimates by name with the same
        leading axes.
      sums: pytree of arrays of shape (seeds, blocks, ...), in any units.
      lengths: (seeds,) durations in any unit; None where all are equal.
      correlation: duration of one independent sample in this unit, 2t, as expected within a factor
        of three; None where nothing is known.

    Returns:
      Estimates and standard errors, without the axes of seeds and blocks. The error is zero where
      all blocks are equal within rounding, and NaN for fewer than two blocks.

    Examples:
      Eight blocks with a trend. Independent blocks would have an error of 0.87.

      >>> blocks = {"x": np.arange(1.0, 9.0)[None], "steps": np.ones((1, 8))}
      >>> value, error = standard_errors(lambda sums: {"mean": sums["x"] / sums["steps"]}, blocks)
      >>> float(value["mean"]), round(float(error["mean"]), 1)
      (4.5, 2.7)
    """
    whole, influence, scale, by_name = _influences(estimate, sums, lengths)
    if sum(map(len, influence)) < 2:
        return by_name(whole), by_name(np.full_like(whole, np.nan))
    expected = None
    if lengths is not None and correlation is not None and np.max(lengths) > 0:
        expected = correlation / 2 * max(map(len, influence)) / np.max(lengths)
    half = _half_width(*_posterior(influence, expected), sum(map(len, influence)) - 1)
    return by_name(whole), by_name(scale * half / _NORMAL_QUANTILE)


def merged_blocks(lengths: np.ndarray | None, seeds: int, blocks: int) -> np.ndarray:
    """Numbers of blocks (seeds,) that last about as long as those of the longest seed, at most
    ``blocks``.

    Where a seed is 1/n of the longest, n of its blocks are one. Seeds of up to 1.5 times the length
    count as equal.

    Examples:
      >>> merged_blocks(np.array([8.0, 32.0, 9.0]), 3, 32).tolist()
      [8, 32, 8]
    """
    if lengths is None or not np.isfinite(lengths).all():
        return np.full(seeds, blocks)
    merge = np.rint(np.max(lengths) / np.maximum(lengths, np.finfo(float).tiny))
    return np.maximum(1, blocks // np.maximum(1, merge)).astype(int)


def correlation_length(
    estimate: Callable[[Any], Mapping[str, Any]], sums: Any, lengths: np.ndarray | None = None
) -> Estimates:
    """Statistical inefficiency: the number of successive blocks that count as one independent
    sample, at least one.

    g = 1 + 2 Σ (1 − k/B) ρ_k, where ρ_k is the autocorrelation at lag k of the jackknife influences
    of the B blocks of a seed, averaged over seeds: n blocks are worth n/g independent samples. The
    sum ends before the first pair ρ_2k + ρ_2k+1 that is not positive, since later terms are noise
    (C. J. Geyer, Stat. Sci. 7, 473, 1992). A series not many times longer than g underestimates it:
    32 blocks give 3 instead of 4, and 4.6 instead of 9.

    Args:
      estimate, sums, lengths: as in ``standard_errors``.

    Returns:
      g of each estimate, in blocks of ``merged_blocks``; NaN for fewer than four blocks in the
      longest seed.
    """
    blocks = jax.tree.leaves(sums)[0].shape[1]
    _, influence, scale, by_name = _influences(estimate, sums, lengths, blocks)
    return by_name(np.where(scale > 0, _inefficiency(influence), np.nan))


def drift(series: np.ndarray, least_correlation: float = 0.0) -> tuple[float, float]:
    """Mean of the second half of a series minus that of the first half, and its standard error.

    The error includes the correlation of neighbouring values: the variance of a mean is multiplied
    by (1 + ρ)/(1 − ρ), with ρ the lag-one autocorrelation of the halves about their own means. A
    short series underestimates ρ, so it is clipped to the range from ``least_correlation`` to 0.9.
    The series needs four values.
    """
    half = len(series) // 2
    halves = np.stack([series[:half], series[-half:]])
    means = halves.mean(axis=1)
    residuals = halves - means[:, None]
    squares = np.sum(residuals**2)
    lagged = np.sum(residuals[:, 1:] * residuals[:, :-1]) / max(squares, np.finfo(float).tiny)
    correlation = np.clip(lagged, least_correlation, 0.9)
    variance = squares / (2 * half - 2) * 2 / half
    error = np.sqrt(variance * (1 + correlation) / (1 - correlation))
    return float(means[1] - means[0]), float(error)


def _influences(
    estimate: Callable[[Any], Mapping[str, Any]],
    sums: Any,
    lengths: np.ndarray | None,
    most: int = _MOST_BLOCKS,
) -> tuple[np.ndarray, list[np.ndarray], np.ndarray, Callable[[np.ndarray], Estimates]]:
    """Estimates (n,), influences of the blocks of each seed (blocks, n), their scale, and
    ``by_name``.

    The influence of a block is (B - 1) times the mean of the leave-one-out estimates minus the one
    without the block, for B blocks in all, divided by the scale (its root mean square, zero for
    rounding only). A seed has at most ``most`` blocks.
    """
    seeds, blocks = jax.tree.leaves(sums)[0].shape[:2]
    counts = merged_blocks(lengths, seeds, min(blocks, most))
    total = int(counts.sum())

    def whole_and_parts(x: np.ndarray) -> np.ndarray:
        """The sums, and then those without each part."""
        parts = _joined(x, counts)
        whole = parts.sum(axis=0)[None]
        return np.concatenate([whole, whole - parts]) if total > 1 else whole

    flat, by_name = _flat(estimate(jax.tree.map(whole_and_parts, sums)))
    without = flat[1:].astype(float) if total > 1 else np.full(flat.shape, np.nan)
    influence = (total - 1) * (without.mean(axis=0) - without)
    largest = np.max(np.abs(influence), axis=0)  # squares of tiny and huge numbers are lost
    unit = np.where(largest > 0, largest, 1)
    scale = unit * np.sqrt(np.mean((influence / unit) ** 2, axis=0))
    scale = np.where(scale <= _ROUNDING * total * np.abs(flat[0]), 0, scale)
    alternating = (-1.0) ** np.arange(len(influence))[:, None]  # stands for blocks without scatter
    influence = np.where(scale == 0, alternating, influence / np.where(scale == 0, 1, scale))
    return flat[0], np.split(influence, np.cumsum(counts)[:-1]), scale, by_name


def _joined(x: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """The blocks (seeds, blocks, ...) of all seeds, (Σ counts, ...), those of a seed merged to its
    number of them.
    """
    firsts = (np.arange(count) * x.shape[1] // count for count in counts)
    return np.concatenate(
        [np.add.reduceat(seed, first, axis=0) for seed, first in zip(x, firsts, strict=True)]
    )


@lru_cache(maxsize=_MOST_BLOCKS)
def _correlation_models(blocks: int) -> tuple[np.ndarray, np.ndarray]:
    """Eigenvectors (times, blocks, modes) and eigenvalues (times, white, modes)."""
    lag = np.abs(np.subtract.outer(np.arange(blocks), np.arange(blocks)))
    values, vectors = np.linalg.eigh(np.exp(-lag / _TIMES[:, None, None]))
    eigenvalues = (1 - _WHITE_SHARES[:, None]) * values[:, None] + _WHITE_SHARES[:, None]
    return vectors, eigenvalues


def _prior(expected: float | None) -> np.ndarray:
    """Logarithm of the prior (models,): times, and the shares of white noise of each. The expected
    correlation time is in blocks.
    """
    if expected is None:
        log_prior = np.log(_TIMES**0.25 / (1 + (_TIMES / _EXPECTED_TIME) ** 2))
    else:
        centre = np.clip(_LONGER * expected, 1, _TIMES[-1])
        log_prior = -(np.log(_TIMES / centre) ** 2) / 2
    return np.repeat(log_prior, len(_WHITE_SHARES))


def _posterior(
    seeds: Sequence[np.ndarray], expected: float | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Posterior of n means from series (blocks, n) of plain mean zero, one a seed; see
    ``standard_errors``.

    Returns:
      Weight of each model of the correlation, mean in it less the plain mean, and scale of its
      Student's t distribution, (models, n) each.
    """
    prior = _prior(expected)[:, None]
    shape, freedom = (len(prior), seeds[0].shape[1]), sum(map(len, seeds)) - 1
    information = determinant = np.zeros((len(prior), 1))
    weighted = square = np.zeros(shape)
    for series in seeds:
        vectors, eigenvalues = _correlation_models(len(series))
        modes = vectors.swapaxes(1, 2) @ series  # (times, modes, n)
        ones = vectors.sum(axis=1)[:, None]
        information = information + (ones**2 / eigenvalues).sum(axis=2).reshape(-1, 1)  # 1'R⁻¹1
        weighted = weighted + ((ones / eigenvalues) @ modes).reshape(shape)  # 1'R⁻¹x
        square = square + ((1 / eigenvalues) @ modes**2).reshape(shape)  # x'R⁻¹x
        determinant = determinant + np.log(eigenvalues).sum(axis=2).reshape(-1, 1)
    shift = weighted / information
    residual = np.maximum(square - weighted * shift, np.finfo(float).tiny)
    log_weight = prior - (determinant + np.log(information) + freedom * np.log(residual)) / 2
    weight = np.exp(log_weight - log_weight.max(axis=0))
    width = np.sqrt(residual / (freedom * information))
    return weight / weight.sum(axis=0), shift, width


def _half_width(
    weight: np.ndarray, shift: np.ndarray, width: np.ndarray, freedom: int
) -> np.ndarray:
    """Half-width (n,) of the interval around zero that contains a mean with probability
    ``_LEVEL``, by Newton's method, from the mixture of ``_posterior``.
    """
    special: Any = scipy.special
    quantile = special.stdtrit(freedom, (1 + _LEVEL) / 2)
    highest = 1 / (np.sqrt(freedom) * special.beta(freedom / 2, 0.5))  # density at zero
    half = np.sqrt(np.sum(weight * ((quantile * width) ** 2 + shift**2), axis=0))
    for _ in range(_NEWTON_STEPS):
        z = np.stack([half - shift, half + shift]) / width
        # z of a constant series is so large that its square overflows
        density = highest * np.hypot(1, z / np.sqrt(freedom)) ** -(freedom + 1.0)
        excess = np.sum(weight * special.stdtr(freedom, z), axis=(0, 1)) - 1 - _LEVEL
        slope = np.sum(weight / width * density, axis=(0, 1))
        half = np.clip(half - excess / slope, half / 2, 2 * half)
    return half


def _flat(estimates: Mapping[str, Any]) -> tuple[np.ndarray, Callable[[np.ndarray], Estimates]]:
    """All estimates with a leading axis as one array (rows, n), and a function that splits a row
    (n,) by name.
    """
    arrays = {name: np.asarray(x) for name, x in estimates.items()}
    rows = len(next(iter(arrays.values())))
    edges = np.cumsum([x[0].size for x in arrays.values()])[:-1]

    def by_name(row: np.ndarray) -> Estimates:
        parts = zip(arrays.items(), np.split(row, edges), strict=True)
        return {name: part.reshape(x.shape[1:]) for (name, x), part in parts}

    return np.concatenate([x.reshape(rows, -1) for x in arrays.values()], axis=1), by_name


def _inefficiency(seeds: Sequence[np.ndarray]) -> np.ndarray:
    """Statistical inefficiency (n,) of n series (blocks, n) of plain mean zero, one a seed."""
    blocks = max(map(len, seeds))
    if blocks < 4:
        return np.full(seeds[0].shape[1], np.nan)
    products = [
        np.concatenate([x[: len(x) - k] * x[k:] for x in seeds if len(x) > k]).mean(axis=0)
        for k in range(blocks // 2)
    ]
    weights = 1 - np.arange(len(products)) / blocks
    weighted = np.stack(products) / products[0] * weights[:, None]
    pairs = weighted[: len(weighted) // 2 * 2].reshape(-1, 2, weighted.shape[1]).sum(axis=1)
    counted = np.logical_and.accumulate(pairs > 0, axis=0)
    return np.maximum(2 * np.sum(np.where(counted, pairs, 0), axis=0) - 1, 1)
