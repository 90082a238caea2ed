"""The peers of the comparison obey the laws that they are compared by, and its table reads right what was measured."""

from collections.abc import Callable

import numpy as np
import pytest

from benchmarks.peers import jaxgran_itself, numba_rival
from benchmarks.peers.problem import Discs, Flow, overlaps
from jaxgran.model.state import State

TIMESTEP = 1e-3
CURVE = next(iter(numba_rival.CURVES))


@pytest.fixture(scope="module")
def sheared(flowing: Callable[..., State]) -> Discs:
    return jaxgran_itself.discs_of(flowing(0.6))


def two_discs(gap: float) -> Discs:
    """Two unlike discs that meet head on with a relative velocity of one and no momentum."""
    radii = np.array([0.4, 0.6])
    masses = 4 * radii**2
    positions = np.array([[9.0, 10.0], [10.0 + gap, 10.0]])
    velocities = np.array([[1.0, 0.0], [0.0, 0.0]]) - [masses[0] / masses.sum(), 0.0]
    return Discs(positions, velocities, radii, masses, 20.0, 0.0)


@pytest.mark.parametrize("restitution", [0.0, 0.5, 1.0])
def test_discs_of_the_numba_loop_rebound_with_the_restitution(restitution: float) -> None:
    run = numba_rival.begin(two_discs(0.02), Flow(restitution, 0.01, 0.0), CURVE, TIMESTEP, 0.25)
    run.advance()
    velocities = run.discs().velocities[:, 0]
    run.close()
    assert velocities[1] - velocities[0] == pytest.approx(restitution, abs=1e-12)


def test_momentum_is_conserved_while_the_cell_tilts_over(sheared: Discs) -> None:
    run = numba_rival.begin(sheared, Flow(0.7, 0.6), CURVE, TIMESTEP, 2.25)
    stress = run.advance()
    now = run.discs()
    run.close()
    np.testing.assert_allclose(now.masses @ now.velocities, 0, atol=1e-9)
    assert (now.tilt - sheared.tilt - 2.25 + 0.5) % 1 == pytest.approx(0.5, abs=1e-9)
    assert 0 < stress.shear_stress < stress.pressure
    assert overlaps(now)[1] < 0.1
