"""Standard errors of sums over blocks by the jackknife, and the drift of a series."""

from collections.abc import Callable, Mapping
from typing import Any

import jax
import numpy as np

BLOCK_MERGES = (1, 2, 4, 8, 16)  # with 16 blocks a seed, the last compares whole seeds
_FEWEST_GROUPS = 4  # a spread over fewer says little, unless there is nothing better
Estimates = dict[str, np.ndarray]


def jackknife(estimate: Callable[[Any], Mapping[str, Any]], sums: Any) -> tuple[Estimates, Estimates]:
    """Estimates from the sums over all blocks of all seeds, and their standard errors.

    Every estimate is a function of sums (a ratio of sums, as a rule), so its error comes from leaving out one block at
    a time. Blocks that follow each other are correlated; merged in groups of up to 16 they are less so, and the
    largest of the errors is taken, as far as there are four groups (the blocking method: Flyvbjerg and Petersen,
    J. Chem. Phys. 91, 461, 1989).

    Args:
      estimate: maps a pytree of sums with any leading axes to named estimates with the same leading axes.
      sums: pytree of arrays of shape (seeds, blocks, ...).

    Returns:
      Estimates and standard errors, without the axes of seeds and blocks. The error is NaN with fewer than two blocks.
    """
    value = _to_numpy(estimate(jax.tree.map(lambda x: x.sum(axis=(0, 1)), sums)))
    seeds, blocks = jax.tree.leaves(sums)[0].shape[:2]
    unknown = {name: np.full(x.shape, np.nan) for name, x in value.items()}
    errors = [
        _jackknife_error(estimate, jax.tree.map(lambda x, m=m: _merged(x, m), sums))
        for m in BLOCK_MERGES
        if seeds * (blocks // m) >= (2 if m == 1 else _FEWEST_GROUPS)
    ]
    return value, {name: np.fmax.reduce([error[name] for error in [unknown, *errors]]) for name in value}


def drift(series: np.ndarray, least_correlation: float = 0.0) -> tuple[float, float]:
    """Difference of the means of the second and first half of a series, and its standard error.

    The error allows for the correlation of neighbouring values: the variance of a mean is multiplied by
    (1 + ρ)/(1 − ρ), with ρ the lag-one autocorrelation of the halves about their own means. A short series shows it too
    small, so ρ is taken between ``least_correlation`` and 0.9.
    The series has at least four values.
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


def _jackknife_error(estimate: Callable[[Any], Mapping[str, Any]], groups: Any) -> Estimates:
    count = len(jax.tree.leaves(groups)[0])
    without = _to_numpy(estimate(jax.tree.map(lambda x: x.sum(axis=0) - x, groups)))
    return {name: np.sqrt((count - 1) * np.mean((x - x.mean(axis=0)) ** 2, axis=0)) for name, x in without.items()}


def _to_numpy(estimates: Mapping[str, Any]) -> Estimates:
    return {name: np.asarray(x) for name, x in estimates.items()}
