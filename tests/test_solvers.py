"""Contact solvers side by side: problems as others pose them, what is judged and counted, and the figure."""

import numpy as np
import pytest
from test_collection import entry_of

from benchmarks import networks
from benchmarks.collection import Entry
from benchmarks.collection.certificates import delassus
from benchmarks.collection.compare import Answer
from benchmarks.collection.problems import compact
from benchmarks.solvers import measure
from benchmarks.solvers.forms import program_of, weighted
from benchmarks.solvers.measure import TARGETS, run_solvers
from benchmarks.solvers.roster import Solver


@pytest.fixture(scope="module")
def entries() -> list[Entry]:
    return [
        entry_of("chain", networks.chain(16)),
        entry_of("size ratio 10", networks.size_ratio(1, 0)),
        entry_of("mass ratio 10000", networks.mass_ratio(4, 0)),
        entry_of("hexagonal cluster", networks.hexagonal(2, True)),
        entry_of("jammed row", networks.jammed_row(10)),
    ]


def test_solution_is_optimal_for_the_quadratic_program(entries):
    for entry in entries[:4]:
        program = program_of(entry)
        slope = program.scale * (program.p @ (entry.solution.impulses / program.scale) + program.q)
        np.testing.assert_allclose(slope, entry.solution.velocities, atol=1e-12)
        g = weighted(entry)
        np.testing.assert_allclose((g @ g.T).toarray(), delassus(entry.problem).toarray(), atol=1e-12)


def scripted(*residuals: float, seconds: float = 0.0):
    """A solver whose answer is off by a share of the exact impulses, one share for each tolerance in turn."""
    left = list(residuals)

    def prepare(entry: Entry, tolerance: float):
        share = left.pop(0) if len(left) > 1 else left[0]
        impulses = entry.solution.impulses * (1 + share) if entry.solution.feasible else np.ones(10)
        return lambda: Answer(impulses, 7)

    return Solver(prepare, "products", {})


def test_a_target_costs_what_the_cheapest_run_does_that_meets_it(entries, monkeypatch):
    times = iter([3.0, 1.0, 2.0, 0.5])
    monkeypatch.setattr(measure, "LIMIT", 10.0)
    monkeypatch.setattr(measure, "timed", lambda solve: (next(times), solve()))
    rows = run_solvers({"one": scripted(1e-1, 1e-5, 1e-7, 0.0)}, entries[:1], lambda *_: None)
    assert [row.outcome for row in rows] == ["ok"] * 4
    assert [row.seconds for row in rows] == [0.5] * 4 and rows[0].iterations == 7
    assert all(row.residual <= row.target for row in rows)


def test_failures_are_missed_slow_or_skipped(entries, monkeypatch):
    monkeypatch.setattr(measure, "timed", lambda solve: (0.3, solve()))
    rows = run_solvers({"one": scripted(1e-3)}, [entries[0]] * 2, lambda *_: None)
    assert [row.outcome for row in rows[:4]] == ["ok", "missed", "missed", "missed"]
    longer = entries[0]._replace(problem=networks_problem(64), solution=None)
    monkeypatch.setattr(measure, "targets", lambda entry: TARGETS)
    rows = run_solvers({"one": scripted(1e-3)}, [entries[0], longer], lambda *_: None)
    assert {row.outcome for row in rows[4:]} == {"skipped"}
    monkeypatch.setattr(measure, "timed", lambda solve: (1.3, solve()))
    rows = run_solvers({"one": scripted(0.0)}, entries[:1], lambda *_: None)
    assert {row.outcome for row in rows} == {"slow"}


def networks_problem(discs: int):
    network = networks.chain(discs)
    return compact(network.contacts, network.masses)
