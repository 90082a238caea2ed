"""The constraint solvers of Pinocchio: projected Gauss–Seidel, and the alternating direction method
of multipliers.

Its contacts have three rows and Coulomb friction. Limits of joints are scalar unilateral
constraints, whose set is the orthant p ≥ 0. So a model of one sliding joint for each contact, all
at their lower limits, poses exactly this problem with any Delassus matrix. The model says nothing
but the number of constraints, and is made once.

Dense matrices are copied to the stack, which has to be larger than usual for more than a thousand
contacts. There is no limit of time, so that of iterations is set by their measured time.

Source of the second method: Carpentier, Le Lidec and Montaut, From Compliant to Rigid Contact
Simulation: a Unified and Efficient Approach, Robotics: Science and Systems (2024).
"""

import resource
import time
from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np
import pinocchio as pin

from benchmarks.collection import Entry
from benchmarks.collection.compare import Answer, Solve
from benchmarks.solvers.forms import columns, scaled

MOST, LIMIT = 20_000, 1.0  # iterations, and seconds of a solve
_FEW, _MORE, _LARGE = 5, 25, 300  # iterations that are timed, and contacts from which they are
_STACK = 120 << 20  # bytes: a matrix of 3000 contacts and some
PGS = {"over_relaxation": 1.45}
ADMM = {"admm_update_rule": "OSQP", "anderson_capacity": 5, "lanczos_size": 10}


def _widen_stack() -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_STACK)
    if soft != resource.RLIM_INFINITY and soft < _STACK:
        resource.setrlimit(
            resource.RLIMIT_STACK,
            (_STACK if hard == resource.RLIM_INFINITY else min(_STACK, hard), hard),
        )


_widen_stack()


@lru_cache(maxsize=2)
def orthant(contacts: int) -> tuple[Any, Any]:
    """Constraint models and data of p ≥ 0 in so many unknowns."""
    model = pin.Model()
    for joint in range(contacts):
        limits = np.ones(1), np.ones(1), np.zeros(1), np.ones(1)
        model.addJoint(0, pin.JointModelPX(), pin.SE3.Identity(), str(joint), *limits)
    lower, upper, margin = np.zeros(contacts), np.full(contacts, np.inf), np.zeros(contacts)
    limit = pin.JointLimitConstraintModel(model, list(range(1, contacts + 1)), lower, upper, margin)
    limit.makeSelectionMaximal()
    models, data = pin.StdVec_ConstraintModel(), pin.StdVec_ConstraintData()
    models.append(pin.ConstraintModel(limit))
    data.append(models[0].createData())
    return models, data


def gauss_seidel(entry: Entry, tolerance: float) -> Solve:
    """Projected Gauss–Seidel. It takes a dense matrix alone."""
    rates, scale = scaled(entry)
    chosen = _chosen(pin.PGSSolverSettings(), tolerance, PGS)
    matrix, sets, solver = (
        np.asfortranarray(entry.matrix.toarray()),
        orthant(len(rates)),
        pin.PGSConstraintSolver(),
    )

    def solve() -> Answer:
        result = pin.PGSSolverResult()
        solver.solve(pin.DelassusOperatorDense(matrix), rates, *sets, chosen, result)
        return Answer(scale * result.retrieveConstraintImpulses(), result.iterations)

    return _limited(solve, chosen, len(rates))


def multipliers(entry: Entry, tolerance: float) -> Solve:
    """Alternating directions: each iteration solves with W + ρ, which is factored anew whenever ρ
    changes.
    """
    rates, scale = scaled(entry)
    chosen = _chosen(pin.ADMMSolverSettings(), tolerance, ADMM)
    matrix, sets, solver = columns(entry.matrix), orthant(len(rates)), pin.ADMMConstraintSolver()

    def solve() -> Answer:
        result, impulses = pin.ADMMSolverResult(), np.zeros_like(rates)
        solver.solve(pin.DelassusOperatorSparse(matrix), rates, *sets, chosen, result)
        result.retrievePrimalSolution(impulses)
        return Answer(scale * impulses, result.iterations)

    return _limited(solve, chosen, len(rates))


def _limited(solve: Callable[[], Answer], settings: Any, contacts: int) -> Solve:
    """The same solve with as many iterations as the limit of time allows."""
    if contacts > _LARGE:
        seconds = []
        for settings.max_iterations in (_FEW, _MORE):
            start = time.process_time()
            solve()
            seconds.append(time.process_time() - start)
        each = max(seconds[1] - seconds[0], 1e-9) / (_MORE - _FEW)
        settings.max_iterations = int(
            min(MOST, max(_FEW, _FEW + 1.1 * (LIMIT - seconds[0]) / each))
        )
    return solve


def _chosen(settings: Any, tolerance: float, given: dict[str, Any]) -> Any:
    settings.absolute_feasibility_tol = settings.absolute_complementarity_tol = tolerance
    settings.relative_feasibility_tol = settings.relative_complementarity_tol = 0.0
    settings.solve_ncp = False  # without friction there is nothing to correct
    settings.max_iterations = MOST
    for name, value in given.items():
        setattr(
            settings, name, getattr(pin.ADMMUpdateRule, value) if isinstance(value, str) else value
        )
    return settings
