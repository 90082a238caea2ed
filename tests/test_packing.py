"""Packings: no overlap, and exactly the packing fraction asked for."""

import numpy as np
import pytest
from oracles import gaps_of


@pytest.mark.parametrize("packing_fraction", [0.1, 0.5, 0.7, 0.8, 0.83])
def test_packing_has_no_overlap_and_the_packing_fraction(packed, packing_fraction):
    state = packed(packing_fraction)
    side = float(state.side)
    assert np.min(gaps_of(state.positions, state.grains.radii, side, state.tilt)) >= 0
    filled = np.sum(np.pi * np.asarray(state.grains.radii) ** 2) / side**2
    assert filled == pytest.approx(packing_fraction, rel=32 * np.finfo(float).eps)
    assert np.all((state.positions >= 0) & (state.positions < side))
    assert np.all(state.velocities == 0) and state.tilt == 0


@pytest.mark.parametrize("packing_fraction", [0.2, 0.6])
def test_no_packing_of_many_has_an_overlap(packed, packing_fraction):
    """Inertia must not carry grains past the place where their overlap was measured."""
    for seed in range(30):
        state = packed(packing_fraction, seed)
        assert (
            np.min(gaps_of(state.positions, state.grains.radii, float(state.side), state.tilt)) >= 0
        )


def test_packing_follows_from_the_key(packed):
    first, second, again = packed(0.7, 0), packed(0.7, 1), packed.__wrapped__(0.7, 0)
    np.testing.assert_array_equal(first.positions, again.positions)
    assert not np.any(first.positions == second.positions)
