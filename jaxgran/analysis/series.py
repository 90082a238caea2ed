"""Averages over a series of snapshots on the host, with the errors of ``statistics``."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxgran.dynamics.snapshot import Snapshot
from jaxgran.model.checks import InputError
from jaxgran.statistics import standard_errors

Sums = Mapping[str, Any]  # NumPy arrays or scalars by name


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
    if frames.state.side.ndim > 1:
        raise InputError(
            "the snapshots must be those of one flow: of a batch, take seen[k] for the replica k."
        )
    return frames if frames.state.side.ndim else jax.tree.map(lambda x: x[None], frames)


def with_errors(
    estimate: Callable[[Sums], Sums], sums: Mapping[str, np.ndarray]
) -> dict[str, Measured]:
    """Estimates from sums of shape (times, ...) and their ``standard_errors``, which include the
    correlation between times.

    ``estimate`` maps sums with any leading axes to named estimates with the same leading axes.
    """
    one_seed = {name: np.asarray(x, float)[None] for name, x in sums.items()}
    values, errors = standard_errors(estimate, one_seed)
    return {name: Measured(values[name], errors[name]) for name in values}


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
