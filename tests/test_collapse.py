"""Inelastic collapse of three and four discs in a row: exact laws of the time step below and above
the thresholds.
"""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from benchmarks import collapse
from benchmarks.collapse import GAP, THRESHOLDS, half_trace, most_collisions, roots, row, slopes

GAPS = GAP * np.geomspace(0.5, 2, 96)


@pytest.fixture(scope="module")
def steps_and_excess(engines):
    """``steps_and_excess(restitution, timestep, states)`` by the numba engine."""
    return partial(collapse.steps_and_excess, advance=engines["numba"])


@pytest.mark.parametrize(("discs", "angle"), [(3, np.pi / 12), (4, np.pi / 8)])
def test_roots_of_a_collapse_are_real_below_the_threshold(discs, angle) -> None:
    threshold = THRESHOLDS[discs]
    assert threshold == pytest.approx(np.tan(angle) ** 2, rel=1e-14)
    assert half_trace(discs, threshold) ** 2 == pytest.approx(threshold, rel=1e-14)
    larger, smaller = roots(discs, 0.9 * threshold)
    assert 0 < smaller < larger < 1


@pytest.mark.parametrize(
    ("discs", "restitution"), [(3, 0.08), (3, 0.1), (3, 0.3), (4, 0.18), (4, 0.2), (4, 0.5)]
)
def test_above_the_threshold_the_steps_of_contact_saturate_and_are_binary(
    steps_and_excess, discs, restitution
) -> None:
    """No start has more collisions than the rotation by θ allows, and one of these has all but
    two.
    """
    states = [row(discs, gap) for gap in GAPS[::4]]
    steps, excess = np.stack(
        [steps_and_excess(restitution, dt, states) for dt in (1e-6, 1e-7)], axis=1
    )
    np.testing.assert_array_equal(steps[0], steps[1])
    most = most_collisions(discs, restitution)
    assert most - 2 <= np.max(steps) <= most
    np.testing.assert_allclose(excess, 0, atol=1e-9)


@pytest.mark.parametrize(("discs", "restitution"), [(3, 0.02), (3, 0.04), (4, 0.05), (4, 0.1)])
def test_below_the_threshold_steps_grow_and_the_excess_falls_by_the_roots(
    engines, discs, restitution
) -> None:
    exact = roots(discs, restitution)
    fitted = slopes(exact, restitution, [row(discs, gap) for gap in GAPS], engines["numba"])
    for values, expected in zip(fitted, (exact.steps_per_decade, exact.exponent), strict=True):
        error = values.std(ddof=1) / np.sqrt(len(values))
        assert error < 0.1 * expected
        assert abs(values.mean() - expected) < 4 * error


@pytest.mark.parametrize(("share", "collapses"), [(0.95, True), (1.05, False)])
def test_three_discs_collapse_where_the_third_leaves_more_slowly_than_the_larger_root(
    steps_and_excess, share, collapses
) -> None:
    restitution, speed = 0.05, 40.0  # so that the collapse, which begins slowly, ends in time
    leaving = share * roots(3, restitution).larger
    velocities = speed * np.array([1.0, 0.0, leaving])
    states = [row(3, gap) for gap in GAPS[::4]]
    states = [
        replace(state, velocities=state.velocities.at[:3, 0].set(velocities)) for state in states
    ]
    coarse, fine = (steps_and_excess(restitution, dt, states)[0] for dt in (1e-6, 1e-8))
    assert fine.mean() > coarse.mean() + 1 if collapses else np.array_equal(fine, coarse)
