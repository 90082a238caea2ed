"""Whether a flow drifts: the record of its preparation, and the samples of all its seeds together.

The limits, and the rates they were chosen for, are in ``thresholds``.
"""

from collections.abc import Sequence

import jax
import numpy as np

from jaxgran.sampling.averages import averages
from jaxgran.sampling.sample import Sample
from jaxgran.sampling.thresholds import (
    CLUSTER_STRAIN,
    DRIFT_BLOCKS,
    LARGEST_STEADY_ERROR,
    SAMPLE_DRIFT,
    STEADY,
    STEADY_AT_LAST,
)
from jaxgran.statistics import drift


def is_level(series: np.ndarray, least_correlation: float = 0.0) -> bool:
    """Whether the means of the two halves of a series agree, and the error of their difference is
    small.
    """
    difference, error = drift(series, least_correlation)
    return error <= LARGEST_STEADY_ERROR and not STEADY.are_exceeded(difference, error)


def is_level_noise(series: np.ndarray, least_correlation: float = 0.0) -> bool:
    """Whether the means of the two halves of a long series agree within its noise about a linear
    trend, which may be large.
    """
    place = np.arange(len(series)) - (len(series) - 1) / 2
    slope = np.sum(place * series) / np.sum(place**2)
    difference, _ = drift(series)
    _, error = drift(series - slope * place, least_correlation)
    return not STEADY_AT_LAST.are_exceeded(difference, error)


def is_drifting(samples: Sequence[Sample], correlation_strain: float) -> bool:
    """Whether ln P or ln T drifts from the first to the second half of the samples, averaged over
    the seeds. A drift of one seed alone is noise.

    Args:
      samples: those of all seeds of one flow with NumPy arrays, of 16 blocks or a multiple.
      correlation_strain: that of the flow, see ``flow_correlation_strain``; blocks are correlated
        over at least this strain.

    Returns:
      Whether they drift; True if a value is not finite.
    """
    strain = np.mean([np.sum(sample.tally.duration) * sample.flow.shear_rate for sample in samples])
    memory = max(CLUSTER_STRAIN, correlation_strain / 2)
    correlation = float(np.exp(-strain / DRIFT_BLOCKS / memory))
    means = np.mean([_series(sample) for sample in samples], axis=0)
    return any(SAMPLE_DRIFT.are_exceeded(*drift(series, correlation)) for series in means)


def _series(sample: Sample) -> np.ndarray:
    """ln P and ln T of a sample in blocks, (2, blocks)."""
    blocks = jax.tree.map(lambda x: x.reshape(DRIFT_BLOCKS, -1, *x.shape[1:]), sample.tally)
    area, shear_rate = (np.full(DRIFT_BLOCKS, x) for x in (sample.area, sample.flow.shear_rate))
    by_block = averages(blocks.total(axis=1), area, sample.flow.grains, shear_rate)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.log(np.stack([by_block["pressure"], by_block["granular_temperature"]]))
