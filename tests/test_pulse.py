"""Rigid discs pass a push on at once; a loose solve makes a front of it, and momentum is conserved in both."""

import numpy as np
import pytest

from benchmarks import pulse

LENGTH = 12


@pytest.fixture(scope="module")
def made() -> pulse.Strip:
    return pulse.strip(LENGTH)


def test_every_disc_inside_touches_six_others(made) -> None:
    touching = np.bincount([*made.i, *made.j], minlength=len(made.columns))
    inside = (made.columns >= 1) & (made.columns < LENGTH - 1.5)
    assert np.all(touching[inside] == 6)
    np.testing.assert_allclose(np.linalg.norm(made.normals, axis=1), 1, rtol=1e-15)


def test_a_precise_solve_passes_the_whole_force_on_in_the_first_step_and_nothing_moves(made) -> None:
    seen = pulse.pushed(made, "barzilai-borwein", 1e-10, 2)
    np.testing.assert_array_equal(seen.front, LENGTH - 1)
    np.testing.assert_allclose(seen.wall, 1, atol=1e-8)
    np.testing.assert_allclose(seen.moved, 0, atol=1e-8)


@pytest.mark.parametrize("method", ["barzilai-borwein", pulse.SWEEPS])
def test_the_front_of_a_loose_solve_takes_several_steps(made, method: str) -> None:
    loose = pulse.pushed(made, method, 0.3, 30)
    found = pulse.summary(loose, LENGTH - 1)
    assert loose.front[0] < 4 and not found["at_once"]
    assert found["speed"] < LENGTH / 3 and found["creep"] > 0.1
