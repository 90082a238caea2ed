"""Averages over a series of snapshots on the host, with standard errors.

Errors come from the jackknife over blocks of times, since successive times are correlated
(``statistics``).
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxgran.dynamics.snapshot import Snapshot
from jaxgran.statistics import jackknife

Sums = Mapping[str, Any]  # NumPy arrays or scalars by name

BLOCKS = 32  # of successive times, for the standard errors


class Measured(NamedTuple):
    """An average over the times of a series and its standard error, of equal shape; NaN where
    nothing was counted.
    """

    value: np.ndarray
    error: np.ndarray


def series(snapshots: Snapshot) -> Any:
    """A Snapshot with NumPy instead of JAX arrays; a single snapshot becomes a series of length
    one.
    """
    frames = jax.tree.map(np.asarray, snapshots)
    return frames if frames.state.side.ndim else jax.tree.map(lambda x: x[None], frames)


def with_errors(
    estimate: Callable[[Sums], Sums], sums: Mapping[str, np.ndarray]
) -> dict[str, Measured]:
    """Estimates from sums of shape (times, ...) and their standard errors by the jackknife over
    blocks of times.

    ``estimate`` maps sums with any leading axes to named estimates with the same leading axes.
    Times are merged into at most ``BLOCKS`` blocks, and these into larger ones, so the errors
    include the correlation between times.
    """
    times = len(next(iter(sums.values())))
    blocks = min(times, BLOCKS)
    first = np.arange(blocks) * times // blocks
    merged = {name: np.add.reduceat(np.asarray(x, float), first)[None] for name, x in sums.items()}
    value, error = jackknife(estimate, merged)
    return {name: Measured(x, np.asarray(error[name])) for name, x in value.items()}


def ratio(numerator: Any, denominator: Any) -> np.ndarray:
    """A quotient that is NaN where the denominator is zero, without a warning."""
    numerator, denominator = np.broadcast_arrays(numerator, denominator)
    return np.divide(
        numerator, denominator, out=np.full(numerator.shape, np.nan), where=denominator != 0
    )


def by_time(times: int, time: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Sums of the values at each time, (times, ...)."""
    sums = np.zeros((times, *values.shape[1:]))
    np.add.at(sums, time, values)
    return sums
