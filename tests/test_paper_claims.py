"""What is read from windows and instants for the properties that the paper names."""

import numpy as np
import pytest
from flows import flow_of

import jaxgran as jg
from benchmarks.paper_claims import spread


def test_windows_of_a_sample_have_its_force_ratio_if_weighted_by_their_force(flowing) -> None:
    _, sample = jg.sample(flow_of(0.75, restitution=0.1), flowing(0.75), 1.0, blocks=20)
    found = spread(sample)
    ratio = np.asarray(sample.tally.impulse / sample.tally.binary_impulse)
    assert found["windows"] == 20
    assert np.average(ratio, weights=sample.tally.binary_impulse) == pytest.approx(found["force_ratio"][0])
    low, high = found["middle_95_percent_of_windows"]
    assert ratio.min() <= low < found["mean_of_windows"] < high <= ratio.max()
