"""Whether the samples of a flow drift, judged over all its seeds together."""

from collections.abc import Sequence

import jax
import numpy as np

from jaxgran.sampling.averages import averages
from jaxgran.sampling.sample import Sample
from jaxgran.statistics import drift

_BLOCKS = 16  # of a sample in this test
_LARGEST_RATIO = 4.0  # a sample drifts if it exceeds this ratio of drift to standard error
_LARGEST_DRIFT = 0.2  # and this drift in ln T or ln P
_CLUSTER_STRAIN = (
    1.0  # over which the clusters of a dissipative flow move; blocks within it are correlated
)


def is_drifting(seeds: Sequence[Sample], correlation_strain: float) -> bool:
    """Whether ln P or ln T drifts from the first to the second half of the samples, averaged over
    the seeds.

    The means of the halves must differ by more than four standard errors and by more than 0.2. A
    drift of one seed alone is noise. Blocks are correlated over at least the correlation strain of
    the flow.

    Args:
      seeds: samples of one flow with NumPy arrays, of 16 blocks or a multiple.
      correlation_strain: that of the flow, see ``flow_correlation_strain``.

    Returns:
      Whether they drift; True if a value is not finite.
    """
    strain = np.mean([np.sum(one.tally.duration) * one.shear_rate for one in seeds])
    correlation = float(np.exp(-strain / _BLOCKS / max(_CLUSTER_STRAIN, correlation_strain / 2)))
    series = np.mean([_series(one) for one in seeds], axis=0)
    return any(drifts(one, correlation) for one in series)


def drifts(series: np.ndarray, least_correlation: float = 0.0) -> bool:
    """Whether the two halves of a series differ significantly and by more than is accepted; True if
    not finite.
    """
    difference, error = drift(series, least_correlation)
    return not abs(difference) <= max(_LARGEST_RATIO * error, _LARGEST_DRIFT)


def _series(sample: Sample) -> np.ndarray:
    """ln P and ln T of a sample in blocks, (2, blocks)."""
    tally = jax.tree.map(lambda x: x.reshape(_BLOCKS, -1, *x.shape[1:]), sample.tally).total(axis=1)
    area, shear_rate = (np.full(_BLOCKS, x) for x in (sample.area, sample.shear_rate))
    by_block = averages(tally, area, sample.grains, shear_rate)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.log(np.stack([by_block["pressure"], by_block["granular_temperature"]]))
