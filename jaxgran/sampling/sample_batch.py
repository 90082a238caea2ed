"""The sample of a batch of a map: its length, and its extension until its errors are small.

Without a given strain, a sample lasts six correlation strains; below four its status is
``short_sample``. A sample that ends when its estimated error is small lasts at least twice as long:
of shorter ones, it would select those that underestimate their error.
"""

from dataclasses import replace

import jax
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array

from jaxgran.model.status import GIVEN_UP, Status
from jaxgran.sampling.blocks import Batch, shear_by_block
from jaxgran.sampling.correlation_strain import length_status
from jaxgran.sampling.observe import AdvanceBatch, advance_batch
from jaxgran.sampling.sample import BLOCKS, Sample, relative_error
from jaxgran.sampling.thresholds import (
    LEAST_SAMPLE,
    LONGEST_CORRELATION_STRAINS,
    LONGEST_STRAIN,
    SAMPLE_CORRELATION_STRAINS,
)


def sample_batch(
    batch: Batch,
    strain: float | None,
    advance: AdvanceBatch = advance_batch,
    error: ArrayLike | None = None,
) -> tuple[Batch, Sample]:
    """Sample every replica of a batch in blocks whose numbers of time steps differ by one at most.

    Args:
      batch: prepared replicas.
      strain: strain to sample, or None for six correlation strains of each flow, at least 8.
      advance: advances the batch.
      error: targets (replicas,) for the relative standard error of each of ``ERROR_OBSERVABLES``.
        The strain of a replica begins with twice the one without a target, and is doubled until the
        target is reached, up to ``LONGEST_STRAIN`` or 32 correlation strains, where its status is
        ``imprecise``. None samples ``strain`` only.
    """
    strains = (
        np.maximum(LEAST_SAMPLE, SAMPLE_CORRELATION_STRAINS * batch.correlation_strain)
        if strain is None
        else np.full_like(batch.correlation_strain, strain)
    )
    if error is not None and strain is None:
        strains = 2 * strains
    longest = np.maximum(LONGEST_STRAIN, LONGEST_CORRELATION_STRAINS * batch.correlation_strain)
    imprecise = np.zeros(len(strains), bool)
    batch, sample = shear_by_block(batch, strains, BLOCKS, advance)
    while error is not None:
        imprecise = np.array([relative_error(replica) for replica in sample]) > error
        extended = imprecise & (2 * strains <= longest) & (batch.status < GIVEN_UP)
        if not extended.any():
            break
        added_strain = np.where(extended, strains, 0)
        batch, added = shear_by_block(batch, added_strain, BLOCKS // 2, advance)
        strains = strains + added_strain
        sample = _extended(sample, added, extended)
    batch = batch._replace(correlation_strain=sample.correlation_strain)
    of_length = length_status(strains, batch.correlation_strain)
    of_error = np.where(imprecise, Status.imprecise, Status.ok)
    return batch._replace(
        status=np.maximum.reduce([batch.status, of_length, of_error, sample.status])
    ), sample


def _extended(sample: Sample, added: Sample, extended: np.ndarray) -> Sample:
    """The sample with twice the strain in the same number of blocks where a replica is extended:
    its blocks joined in pairs, then those that were added.
    """
    pairs = jax.tree.map(lambda x: x.reshape(x.shape[0], -1, 2, *x.shape[2:]), sample.tally)

    def choose(joined: Array, new: Array, old: Array) -> np.ndarray:
        chosen = extended.reshape(-1, *(1,) * (np.ndim(old) - 1))
        return np.where(chosen, np.concatenate([joined, new], axis=1), old)

    tally = jax.tree.map(choose, pairs.total(axis=2), added.tally, sample.tally)
    return replace(sample, tally=tally)
