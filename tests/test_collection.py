"""The collection of contact problems: certificates against exact fractions, the file, and solvers
side by side.
"""

import hashlib
import json
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from benchmarks import networks
from benchmarks.collection import PATH, Entry, load
from benchmarks.collection.certificates import (
    Problem,
    certificate,
    delassus,
    obstacle,
    obstructed,
    solved,
)
from benchmarks.collection.problems import compact
from benchmarks.exact_contacts import certified_impulses
from benchmarks.exact_contacts import incidence as dense_incidence
from benchmarks.networks import Network

ROOT = Path(__file__).parents[1]
FEASIBLE = {
    "chain": networks.chain(16),
    "size ratio": networks.size_ratio(1, 0),
    "mass ratio": networks.mass_ratio(4, 0),
    "hexagon, struck": networks.hexagonal(2, True),
}
JAMMED = {"row": networks.jammed_row(10), "lattice": networks.jammed_lattice(4)}
feasible = pytest.mark.parametrize("network", FEASIBLE.values(), ids=FEASIBLE)
jammed = pytest.mark.parametrize("network", JAMMED.values(), ids=JAMMED)


def problem_of(network: Network) -> Problem:
    return compact(network.contacts, network.masses)


def rough(network: Network) -> np.ndarray:
    """The solution in double precision by a method of the other reference, with an error of a
    millionth.
    """
    used = np.asarray(network.contacts.used)
    g = dense_incidence(network.contacts, network.grains)[used] / np.repeat(
        np.sqrt(network.masses), 2
    )
    impulses = certified_impulses(g, np.asarray(network.contacts.approach)[used])
    assert impulses is not None
    return impulses * (1 + 1e-6 * np.sin(np.arange(len(impulses))))


def entry_of(name: str, network: Network) -> Entry:
    problem = problem_of(network)
    solution = solved(problem, rough(network)) if network.feasible else obstructed(problem)
    assert solution is not None
    return Entry(name, "made", f"a network called {name}", problem, solution)


@pytest.fixture(scope="module")
def entries() -> list[Entry]:
    return [entry_of(name, network) for name, network in (FEASIBLE | JAMMED).items()]


def after_in_fractions(problem: Problem, *parts: np.ndarray) -> list[Fraction]:
    """w = u⁻ + W Σ parts, without any rounding."""
    impulses = [sum((Fraction(x) for x in each), Fraction(0)) for each in zip(*parts, strict=True)]
    gained = [[Fraction(0), Fraction(0)] for _ in problem.masses]
    for (i, j), normal, impulse in zip(problem.ends, problem.normals, impulses, strict=True):
        for a in (0, 1):
            gained[i][a] += Fraction(normal[a]) * impulse / Fraction(problem.masses[i])
            gained[j][a] -= Fraction(normal[a]) * impulse / Fraction(problem.masses[j])
    return [
        Fraction(u) + sum(Fraction(n[a]) * (gained[i][a] - gained[j][a]) for a in (0, 1))
        for (i, j), n, u in zip(problem.ends, problem.normals, problem.approach, strict=True)
    ]


@feasible
def test_solution_is_one_in_exact_fractions(network):
    """To 30 digits: by numbers that have nothing to do with those of the certificate."""
    problem = problem_of(network)
    solution = solved(problem, rough(network))
    high, low = solution.impulses, solution.impulses_low
    after, own = after_in_fractions(problem, high, low), delassus(problem).diagonal()
    speed = np.linalg.norm(np.minimum(problem.approach, 0))
    push = [
        Fraction(o) * (Fraction(a) + Fraction(b)) for o, a, b in zip(own, high, low, strict=True)
    ]
    least = [float(min(x, y)) for x, y in zip(push, after, strict=True)]
    assert min(push) >= 0
    assert np.linalg.norm(least) <= 1e-28 * speed
    np.testing.assert_allclose(
        solution.certificate["natural_map"], np.linalg.norm(least) / speed, rtol=1e-6
    )
    np.testing.assert_allclose(solution.velocities, [float(x) for x in after], rtol=1e-15)


@jammed
def test_weights_prove_in_exact_fractions_that_there_is_no_solution(network):
    """Velocities v with H v ≥ −u⁻ have 0 = (Hᵀq)·v ≥ −q·u⁻ > 0."""
    problem = problem_of(network)
    proof = obstructed(problem)
    assert proof is not None and not proof.feasible
    weights = [
        Fraction(a) + Fraction(b) for a, b in zip(proof.impulses, proof.impulses_low, strict=True)
    ]
    total = np.full((len(problem.masses), 2), Fraction(0))
    for (i, j), normal, weight in zip(problem.ends, problem.normals, weights, strict=True):
        total[i] += [Fraction(n) * weight for n in normal]
        total[j] -= [Fraction(n) * weight for n in normal]
    assert min(weights) >= 0
    assert sum(q * Fraction(u) for q, u in zip(weights, problem.approach, strict=True)) < 0
    assert max(abs(float(x)) for x in total.ravel()) < 1e-30


def test_committed_collection_is_the_one_of_its_summary_and_its_solutions_hold():
    told = json.loads((ROOT / "benchmarks" / "results" / "collection.json").read_text())
    assert hashlib.sha256(PATH.read_bytes()).hexdigest() == told["sha256"]
    entries = load()
    sizes = [len(entry.problem.approach) for entry in entries]
    assert len(entries) == told["problems"] >= 200 and min(sizes) == 2 and max(sizes) > 2900
    assert sum(not entry.solution.feasible for entry in entries) >= 7
    for entry in entries:
        matrix, impulses, approach = entry.matrix, entry.solution.impulses, entry.problem.approach
        if (
            entry.solution.feasible
        ):  # in double precision: for all; by the certificate: for every tenth
            after, own = matrix @ impulses + approach, matrix.diagonal()
            speed = np.linalg.norm(np.minimum(approach, 0))
            assert np.linalg.norm(np.minimum(own * impulses, after)) <= 1e-9 * speed
            np.testing.assert_allclose(entry.solution.velocities, after, rtol=0, atol=1e-9 * speed)
            assert np.all(impulses >= 0)
    for entry in entries[::10]:
        high, low = entry.solution[1:3]
        if entry.solution.feasible:
            assert certificate(entry.problem, high, low) == pytest.approx(
                entry.solution.certificate, rel=1e-6, abs=1e-40
            )
        else:
            assert obstacle(entry.problem, high, low) < 1e-28
