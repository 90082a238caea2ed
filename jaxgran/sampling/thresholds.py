"""Thresholds of what is decided without the user, each with the rate that it was chosen for.

Noise here is a first-order autoregressive series. Chunks of a record last a quarter of the
correlation strain, so that neighbours have the correlation exp(-1/2). Its standard deviation σ is
that of ln T or ln P of one value. ``pytest tests/test_thresholds.py`` measures these rates again,
and fails where they differ. The priors of the error bars are in ``jaxgran.statistics``.
"""

from typing import NamedTuple


class DriftLimits(NamedTuple):
    """A drift of ln T or ln P is one if it exceeds both limits."""

    errors: float  # in standard errors of the drift
    accepted: float  # in ln T or ln P

    def are_exceeded(self, drift: float, error: float) -> bool:
        """Whether a drift with this standard error exceeds the limits; True if it is not finite."""
        return not abs(drift) <= max(self.errors * error, self.accepted)


# The record of a preparation

# Of steady noise, 94 % are within two errors, for 8 as for 40 values (95 % with a known error).
STEADY = DriftLimits(errors=2.0, accepted=0.1)
# Above this error of the drift the test is undecided. All steady flows pass in the end: after 12
# chunks for σ = 0.05, 18 for 0.1, 44 for 0.15, and after the last one from 0.2 on. A relaxation of
# ln T from 2 in one or two correlation strains has decayed to 0.01 on average when it is accepted,
# and to 0.1 at most (σ ≤ 0.1).
LARGEST_STEADY_ERROR = 0.1
# After the last chunk, with the error of the noise about a linear trend: refuses less than 0.1 % of
# steady noise, 39 % of trends of 4 σ over the record and 99 % of those of 8 σ.
STEADY_AT_LAST = DriftLimits(errors=4.0, accepted=0.1)
SHORTEST_CHUNK = 0.75  # strain; a quarter of the correlation strain where that is longer
FEWEST_CHUNKS = 12  # before the first test, which needs eight values in two thirds of them
MEASURING_CHUNKS = 4  # which set the length of later chunks; the test leaves them out
MOST_CHUNKS = 60  # 15 correlation strains; a limit of cost
LEAST_PREPARATION = FEWEST_CHUNKS * SHORTEST_CHUNK  # strain, where it is not given

# The samples of a point

# Of steady samples, 0.13 % drift by more than four errors, for 4 to 32 correlation strains in 16
# blocks. A step of 4 σ between the halves is found in 86 %. A linear trend is found in 17 % at
# most, however large it is, as it also scatters the blocks of a half.
SAMPLE_DRIFT = DriftLimits(errors=4.0, accepted=0.2)
DRIFT_BLOCKS = 16  # of a sample in this test
# Strain over which the clusters of a dissipative flow move: blocks within it are correlated in this
# test, however short the correlation strain is.
CLUSTER_STRAIN = 1.0

# Length of a sample: coverage of 95 % intervals, mean and worst over average, seeds and 12 flows of
# 256 grains, 64 repeats of each

FEWEST_CORRELATION_STRAINS = 4.0  # 97 %, 88 %; a shorter one has the status ``short_sample``
SAMPLE_CORRELATION_STRAINS = 6.0  # 97 %, 89 %; where the strain is not given
LEAST_SAMPLE = 8.0  # strain, at least: 16 of the shortest correlation strains
# A sample for an error of 0.05: at least 96 %, 90 % over nine points, which narrower errors had. It
# ends at the longer one of these limits of cost, as 8 % of the samples did there.
LONGEST_STRAIN = 256.0
LONGEST_CORRELATION_STRAINS = 32.0

# The time step. Straight after a change from 1e-3 to 1e-5 the force ratio is too large by 5 ± 1 %
# at α = 0.5, ν = 0.76 and by 15 ± 5 % at 0.2, 0.8 over a strain of 0.1, and by 1 ± 1 % and −3 ± 5 %
# over the next 0.1 (64 grains, 256 seeds, ``sample`` in 24 blocks of 0.1 after ``prepare``).

RELAXATION_STRAIN = 0.5  # strain at the new time step before the sample
SHORTENING_STRAIN = 0.1  # strain at each time step between the coarse and the final one
