"""What a residual costs: each solver from a loose tolerance to a tight one, judged by the residual
of this program.

Tolerances of packages mean different things. So each solver is run with tolerances of its own, a
power of ten after the other, until its residual ‖min(W_cc J, w)‖ / ‖min(u⁻, 0)‖ is below the
smallest target. A target costs what the cheapest run does that meets it. A solve of more than
``LIMIT`` seconds is a failure. After it no tighter tolerance is tried, and no problem of that
family whose time, growing as the square of the contacts, would be beyond the limit too.

Times are those of the processor, of this process on one core, so that other work on the machine
counts little.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from benchmarks.collection import Entry
from benchmarks.collection.compare import Answer
from benchmarks.solvers.roster import Solver
from benchmarks.timing import timed

TARGETS = (1e-2, 1e-4, 1e-6, 1e-8)
LIMIT = 1.0  # seconds
_TIGHTEST, _LARGE = (
    16,
    300,
)  # power of the last tolerance; contacts from which only every second one is tried
_MANY = 1000  # iterations, from which a run that repeats the one before has come to its limit


class Attempt(NamedTuple):
    """One run: of a solver with a tolerance of its own."""

    tolerance: float
    seconds: float
    iterations: float
    residual: float
    impulses: np.ndarray | None


class Row(NamedTuple):
    """The cheapest run of a solver on a problem that meets a target, or a failure.

    ``outcome`` is ok, missed (the residual is not reached), slow (beyond the limit), or skipped
    (see the module). Costs and errors of a failure are not a number, and so are iterations that a
    solver does not count. ``velocity_error`` is max |w − w_exact| / max |min(u⁻, 0)|, and
    ``stress_error`` that of Σ J n⊗n. A problem without a solution has one row, with the target 0:
    ok if the solver says so.
    """

    solver: str
    problem: str
    family: str
    contacts: int
    target: float
    outcome: str
    tolerance: float = np.nan
    seconds: float = np.nan
    iterations: float = np.nan
    residual: float = np.nan
    velocity_error: float = np.nan
    stress_error: float = np.nan


def run_solvers(
    solvers: Mapping[str, Solver],
    entries: Sequence[Entry],
    note: Callable[[str, Entry, list[Attempt]], None],
) -> list[Row]:
    """All solvers on all problems, problem by problem; ``note`` receives the runs of each."""
    rows, slowest = [], {}
    for entry in entries:
        matrix = entry.matrix
        for name, solver in solvers.items():
            count, before = len(entry.problem.approach), slowest.get((name, entry.family), (1, 0.0))
            if before[1] * (count / before[0]) ** 2 > LIMIT:
                rows += [_row(name, entry, target, "skipped") for target in targets(entry)]
                continue
            runs = ladder(solver, entry, matrix)
            note(name, entry, runs)
            slow = max(run.seconds for run in runs)
            slowest[name, entry.family] = (count, slow) if slow > LIMIT / 10 else (1, 0.0)
            rows += [best_run(name, entry, matrix, runs, target) for target in targets(entry)]
    return rows


def targets(entry: Entry) -> tuple[float, ...]:
    """Of a problem without a solution: one, which is zero."""
    return TARGETS if entry.solution.feasible else (0.0,)


def ladder(solver: Solver, entry: Entry, matrix) -> list[Attempt]:
    """Runs with ever tighter tolerances."""
    runs, count = [], len(entry.problem.approach)
    for power in range(1, _TIGHTEST + 1) if count <= _LARGE else range(2, _TIGHTEST + 1, 2):
        if not entry.solution.feasible:
            power = 6
        seconds, answer = timed(solver.prepare(entry, 10.0**-power))
        impulses, iterations = answer if isinstance(answer, Answer) else (answer, np.nan)
        iterations = max(iterations, 1)  # some count from zero
        residual = np.nan if impulses is None else natural_residual(entry, matrix, impulses)
        runs.append(Attempt(10.0**-power, seconds, iterations, residual, impulses))
        stuck = iterations > _MANY and len(runs) > 1 and runs[-2].residual == residual
        if seconds > LIMIT or residual <= TARGETS[-1] or stuck or not entry.solution.feasible:
            break
    return runs


def natural_residual(entry: Entry, matrix, impulses: np.ndarray) -> float:
    """‖min(W_cc J, w)‖ / ‖min(u⁻, 0)‖, as ``jaxgran.contact.solve_contacts``."""
    approach = entry.problem.approach
    least = np.minimum(matrix.diagonal() * impulses, matrix @ impulses + approach)
    return float(np.linalg.norm(least) / np.linalg.norm(np.minimum(approach, 0)))


def best_run(name: str, entry: Entry, matrix, runs: list[Attempt], target: float) -> Row:
    """The cheapest run that meets a target, as a row."""
    if not entry.solution.feasible:
        run = runs[0]
        outcome = "slow" if run.seconds > LIMIT else "missed" if run.impulses is not None else "ok"
        return _row(name, entry, target, outcome, run.tolerance, run.seconds, run.iterations)
    good = [run for run in runs if run.residual <= target and run.seconds <= LIMIT]
    if not good:
        return _row(name, entry, target, "slow" if runs[-1].seconds > LIMIT else "missed")
    run = min(good, key=lambda candidate: candidate.seconds)
    errors = velocity_error(entry, matrix, run.impulses), stress_error(entry, run.impulses)
    return _row(
        name, entry, target, "ok", run.tolerance, run.seconds, run.iterations, run.residual, *errors
    )


def _row(name: str, entry: Entry, target: float, outcome: str, *costs: float) -> Row:
    return Row(
        name,
        entry.name,
        entry.family,
        len(entry.problem.approach),
        target,
        outcome,
        *map(float, costs),
    )


def velocity_error(entry: Entry, matrix, impulses: np.ndarray) -> float:
    """max |w − w_exact| / max |min(u⁻, 0)|."""
    approach = entry.problem.approach
    return float(
        np.max(np.abs(matrix @ impulses + approach - entry.solution.velocities)) / -np.min(approach)
    )


def stress_error(entry: Entry, impulses: np.ndarray) -> float:
    """Relative error of Σ J n⊗n, the stress of grains of one size."""
    moment, true = (
        np.einsum("c,ca,cb", p, entry.problem.normals, entry.problem.normals)
        for p in (impulses, entry.solution.impulses)
    )
    return float(np.linalg.norm(moment - true) / np.linalg.norm(true))
