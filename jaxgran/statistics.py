"""Standard errors of sums over blocks by the jackknife, the correlation of blocks, and the drift of a series."""

from collections.abc import Callable, Mapping
from typing import Any

import jax
import numpy as np

BLOCK_MERGES = (1, 2, 4, 8, 16, 32)  # blocks in a group; with 32 blocks a seed, the last compares whole seeds
_FEWEST_GROUPS = 4  # the spread over fewer groups is too uncertain; single blocks are used in any case
Estimates = dict[str, np.ndarray]


def jackknife(estimate: Callable[[Any], Mapping[str, Any]], sums: Any) -> tuple[Estimates, Estimates]:
    """Estimates from the sums over all blocks of all seeds, and their standard errors.

    Every estimate is a function of sums, usually a ratio. Its error comes from leaving out one block at a time.
    Successive blocks are correlated, and groups of up to 32 merged blocks are less so. The error returned is the
    largest over the group sizes that leave at least four groups (the blocking method: Flyvbjerg and Petersen,
    J. Chem. Phys. 91, 461, 1989).

    Args:
      estimate: maps a pytree of sums with any leading axes to named estimates with the same leading axes.
      sums: pytree of arrays of shape (seeds, blocks, ...), in any units.

    Returns:
      Estimates and standard errors, without the axes of seeds and blocks. The error is NaN with fewer than two blocks.

    Examples:
      Eight blocks that drift. Independent blocks would have an error of 0.87. Merged in pairs they have a larger one.

      >>> blocks = {"x": np.arange(1.0, 9.0)[None], "steps": np.ones((1, 8))}
      >>> value, error = jackknife(lambda sums: {"mean": sums["x"] / sums["steps"]}, blocks)
      >>> float(value["mean"]), round(float(error["mean"]), 2)
      (4.5, 1.29)
    """
    seeds, blocks = jax.tree.leaves(sums)[0].shape[:2]
    merges = [m for m in BLOCK_MERGES if seeds * (blocks // m) >= (2 if m == 1 else _FEWEST_GROUPS)]
    edges = np.cumsum([1, *(seeds * (blocks // m) for m in merges)])
    flat, named = _flat(estimate(jax.tree.map(lambda x: _whole_and_parts(x, merges), sums)))
    spreads = [np.full_like(flat[0], np.nan), *(_spread(part) for part in np.split(flat, edges)[1:-1])]
    return named(flat[0]), named(np.fmax.reduce(spreads))


def correlation_length(estimate: Callable[[Any], Mapping[str, Any]], sums: Any) -> Estimates:
    """Number of successive blocks that count as one independent sample, for every estimate; at least one.

    It is the statistical inefficiency g = 1 + 2 Σ (1 − k/B) ρ_k: n blocks are worth n/g independent samples. ρ_k is the
    autocorrelation at lag k of the B blocks of a seed, averaged over the seeds. It is that of the influence of each
    block on the estimate, from the jackknife. The sum ends before the first pair ρ_2k + ρ_2k+1 that is not positive
    (C. J. Geyer, Stat. Sci. 7, 473, 1992), because later terms are only noise. A series that is not many times longer
    than g gives too small a value: with 32 blocks it is 3 instead of 4, and 4.6 instead of 9.

    Args:
      estimate, sums: as in ``jackknife``.

    Returns:
      Lengths in blocks, NaN with fewer than four blocks a seed.
    """
    seeds, blocks = jax.tree.leaves(sums)[0].shape[:2]
    flat, named = _flat(estimate(jax.tree.map(lambda x: _all_but_one(_merged(x, 1)), sums)))
    return named(_inefficiency(flat.reshape(seeds, blocks, -1)))


def drift(series: np.ndarray, least_correlation: float = 0.0) -> tuple[float, float]:
    """Difference of the means of the second and first half of a series, and its standard error.

    The error includes the correlation of neighbouring values: the variance of a mean is multiplied by
    (1 + ρ)/(1 − ρ), with ρ the lag-one autocorrelation of the halves about their own means. A short series gives too
    small a ρ, so it is limited to the range from ``least_correlation`` to 0.9. The series has at least four values.
    """
    half = len(series) // 2
    halves = np.stack([series[:half], series[-half:]])
    means = halves.mean(axis=1)
    residuals = halves - means[:, None]
    squares = np.sum(residuals**2)
    lagged = np.sum(residuals[:, 1:] * residuals[:, :-1]) / max(squares, np.finfo(float).tiny)
    correlation = np.clip(lagged, least_correlation, 0.9)
    variance = squares / (2 * half - 2) * 2 / half
    return float(means[1] - means[0]), float(np.sqrt(variance * (1 + correlation) / (1 - correlation)))


def _merged(x: np.ndarray, merge: int) -> np.ndarray:
    """Sums over groups of ``merge`` successive blocks, (seeds · groups, ...); no group spans two seeds."""
    seeds, blocks = x.shape[:2]
    groups = blocks // merge
    return x[:, : groups * merge].reshape(seeds * groups, merge, *x.shape[2:]).sum(axis=1)


def _whole_and_parts(x: np.ndarray, merges: list[int]) -> np.ndarray:
    """The sum over all blocks, then for each merge those over all groups but one, (1 + groups + groups + ..., ...)."""
    return np.concatenate([x.sum(axis=(0, 1))[None], *(_all_but_one(_merged(x, m)) for m in merges)])


def _all_but_one(groups: np.ndarray) -> np.ndarray:
    """Sums over all groups but one, (groups, ...)."""
    return groups.sum(axis=0) - groups


def _spread(without: np.ndarray) -> np.ndarray:
    """Jackknife standard errors (n,) of n estimates, from the estimates without one group each, (groups, n)."""
    return np.sqrt((len(without) - 1) * np.mean((without - without.mean(axis=0)) ** 2, axis=0))


def _flat(estimates: Mapping[str, Any]) -> tuple[np.ndarray, Callable[[np.ndarray], Estimates]]:
    """All estimates with a leading axis as one array (rows, n), and a function that names the parts of a row (n,)."""
    arrays = {name: np.asarray(x) for name, x in estimates.items()}
    rows = len(next(iter(arrays.values())))
    edges = np.cumsum([x[0].size for x in arrays.values()])[:-1]

    def named(row: np.ndarray) -> Estimates:
        parts = zip(arrays.items(), np.split(row, edges), strict=True)
        return {name: part.reshape(x.shape[1:]) for (name, x), part in parts}

    return np.concatenate([x.reshape(rows, -1) for x in arrays.values()], axis=1), named


def _inefficiency(series: np.ndarray) -> np.ndarray:
    """Statistical inefficiency (n,) of n series (seeds, blocks, n)."""
    blocks = series.shape[1]
    if blocks < 4:
        return np.full(series.shape[2], np.nan)
    deviations = series - series.mean(axis=(0, 1))
    products = [np.mean(deviations[:, : blocks - k] * deviations[:, k:], axis=(0, 1)) for k in range(blocks // 2)]
    with np.errstate(invalid="ignore", divide="ignore"):
        correlation = np.stack(products) / products[0]
    weighted = correlation * (1 - np.arange(len(products)) / blocks)[:, None]
    pairs = weighted[: len(weighted) // 2 * 2].reshape(-1, 2, *weighted.shape[1:]).sum(axis=1)
    counted = np.logical_and.accumulate(pairs > 0, axis=0)
    length = 2 * np.sum(np.where(counted, pairs, 0), axis=0) - 1
    return np.where(np.isfinite(products[0]) & (products[0] > 0), np.maximum(length, 1), np.nan)
