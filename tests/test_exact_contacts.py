"""The reference of other tests: exact solutions agree with closed forms, and what is wrong is
refused.
"""

import numpy as np
import pytest
from oracles import random_network

from benchmarks.exact_contacts import (
    METHODS,
    certified_impulses,
    exact,
    incidence,
    is_obstacle,
    is_solution,
)
from benchmarks.networks import chain, hexagonal, jammed_lattice, jammed_row, mass_ratio, size_ratio

EPS = np.finfo(float).eps


def problem(contacts, masses) -> tuple[np.ndarray, np.ndarray]:
    """G and u⁻ of the contacts in use."""
    used = np.asarray(contacts.used)
    return incidence(contacts, len(masses))[used] / np.repeat(np.sqrt(masses), 2), np.asarray(
        contacts.approach
    )[used]


def problem_of(network) -> tuple[np.ndarray, np.ndarray]:
    return problem(network.contacts, network.masses)


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


@pytest.mark.parametrize("method", METHODS)
def test_three_discs_in_a_row(method):
    """One that hits two: at restitution zero all go on together; at one they leave as −1/3, 2/3,
    2/3.
    """
    g, approach = problem_of(chain(3))
    changes = certified_impulses(g, approach, [method]) @ g
    np.testing.assert_allclose(np.array([1, 0, 0]) + changes[:6:2], 1 / 3, rtol=4 * EPS)
    np.testing.assert_allclose(
        np.array([1, 0, 0]) + 2 * changes[:6:2], [-1 / 3, 2 / 3, 2 / 3], rtol=4 * EPS
    )


@pytest.mark.parametrize("rings", [1, 2, 3])
def test_pressed_hexagon_stops(rings):
    """W is singular; the changes undo the compression, which moves every grain by its place from
    the centre.
    """
    network = hexagonal(rings, struck=False)
    g, _ = problem_of(network)
    assert np.linalg.matrix_rank(g) < len(g)
    a, b = (
        axis.ravel()
        for axis in np.meshgrid(np.arange(-rings, rings + 1), np.arange(-rings, rings + 1))
    )
    places = np.stack([a + b / 2, b * np.sqrt(3) / 2], axis=-1)[np.abs(a + b) <= rings]
    solution = exact(network.contacts, network.masses)
    assert solution.feasible and solution.residual < 1e-14
    np.testing.assert_allclose(
        solution.changes[: len(places)], places, rtol=0, atol=100 * EPS * rings
    )


def test_both_methods_find_the_same_velocities():
    for seed in range(12):
        contacts, masses, _ = random_network(seed, 5 * (seed + 1), [1.0, 100.0, 1e6][seed % 3])
        g, approach = problem(contacts, masses)
        one, other = (certified_impulses(g, approach, [method]) @ g for method in METHODS)
        assert np.linalg.norm(one - other) <= 1e-11 * np.linalg.norm(one)


@solvable
def test_wrong_impulses_are_refused(network):
    g, approach = problem_of(network)
    right = certified_impulses(g, approach)
    assert is_solution(g, approach, right)
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
def test_no_impulses_stop_what_is_jammed(network):
    g, approach = problem_of(network)
    assert certified_impulses(g, approach) is None
    assert not exact(network.contacts, network.masses).feasible
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
