"""The reference of other tests: solutions agree with closed forms; wrong ones are refused."""

import numpy as np
import pytest
from contact_networks import (
    Network,
    chain,
    hexagon,
    hexagonal,
    jammed_lattice,
    jammed_row,
    mass_ratio,
    size_ratio,
)
from exact_contacts import (
    EPS,
    certified_impulses,
    exact_changes,
    is_obstacle,
    is_solution,
    natural_residual,
    weighted,
)

SOLVABLE = {
    "chain": chain(16),
    "size ratio": size_ratio(1, 0),
    "mass ratio": mass_ratio(4, 0),
    "hexagon, struck": hexagonal(2, True),
    "hexagon, pressed": hexagonal(2, False),
}
JAMMED = {"row": jammed_row(10), "lattice": jammed_lattice(4)}
solvable = pytest.mark.parametrize("network", SOLVABLE.values(), ids=SOLVABLE)
jammed = pytest.mark.parametrize("network", JAMMED.values(), ids=JAMMED)


def test_three_discs_in_a_row() -> None:
    """One hits two: at restitution zero all go on as one; at one they leave as −1, 2, 2 thirds."""
    changes = exact_changes(*chain(3))[:3, 0]
    np.testing.assert_allclose(np.array([1, 0, 0]) + changes, 1 / 3, rtol=4 * EPS)
    np.testing.assert_allclose(
        np.array([1, 0, 0]) + 2 * changes, [-1 / 3, 2 / 3, 2 / 3], rtol=4 * EPS
    )


@pytest.mark.parametrize("rings", [1, 2, 3])
def test_pressed_hexagon_stops(rings: int) -> None:
    """W is singular; the changes undo the compression, which moves a grain by its place."""
    network = hexagonal(rings, struck=False)
    g, approach = weighted(*network)
    assert np.linalg.matrix_rank(g) < len(g)
    impulses = certified_impulses(g, approach)
    assert impulses is not None and natural_residual(g, approach, impulses) < 1e-14
    places = hexagon(rings)
    changes = exact_changes(*network)[: len(places)]
    np.testing.assert_allclose(changes, places, rtol=0, atol=100 * EPS * rings)


@solvable
def test_wrong_impulses_are_refused(network: Network) -> None:
    g, approach = weighted(*network)
    right = certified_impulses(g, approach)
    assert right is not None and is_solution(g, approach, right)
    strongest = np.zeros_like(right)
    strongest[np.argmax(np.sum(g**2, axis=1) * right)] = 1
    for wrong in (
        np.zeros_like(right),
        right * (1 + 1e-9),
        right * (1 - 1e-9),
        right * (1 - strongest),
        right + 1e-9 * right * strongest,
        np.where(strongest, -right, right),
        np.where(strongest, np.nan, right),
        np.where(strongest, np.inf, right),
    ):
        assert not is_solution(g, approach, wrong)


@jammed
def test_no_impulses_stop_what_is_jammed(network: Network) -> None:
    g, approach = weighted(*network)
    assert certified_impulses(g, approach) is None
    balanced = np.ones(len(g))  # both are pressed alike along every row of contacts
    assert is_obstacle(g, approach, balanced)
    for wrong in (
        balanced + 1e-9 * np.eye(len(g))[0],
        -balanced,
        np.eye(len(g))[0],
        np.full(len(g), np.nan),
    ):
        assert not is_obstacle(g, approach, wrong)
    assert not is_obstacle(g, -approach, balanced)
    for size in 10.0 ** np.arange(0, 30, 3):  # what cancels in rounding is no solution either
        assert not is_solution(g, approach, size * balanced)
