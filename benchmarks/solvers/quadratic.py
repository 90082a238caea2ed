"""Solvers of quadratic programs: OSQP, ProxQP, Clarabel and PIQP, and the non-negative least
squares of SciPy.

A solve begins with the sparse matrices and ends with the impulses, since in a flow all of them
change from step to
step: analysis and factors are part of it. Iterations are those that a package reports, and no two
  packages count the same.
"""

from typing import Any

import clarabel
import numpy as np
import osqp as osqp_package
import piqp as piqp_package
from proxsuite import proxqp
from scipy.optimize import nnls
from scipy.sparse import eye_array, triu

from benchmarks.collection import Entry
from benchmarks.collection.compare import Answer, Solve
from benchmarks.solvers.forms import columns, program_of, scaled, weighted

LIMIT = 1.0  # seconds of a solve, where a package has a limit of time
OSQP = {"adaptive_rho_interval": 25, "alpha": 1.8, "eps_dual_inf": 1e-8}
# The back end that ProxQP chooses for large problems does not factor
PROXQP = {
    "sparse_backend": "SparseCholesky",
    "max_iter": 100,
    "max_iter_in": 100,
    "eps_dual_inf": 1e-10,
}
CLARABEL = {"static_regularization_constant": 1e-12}
_FREE = 1e20  # an upper bound that does not bind
_LEAST_REST = 1e-12  # of the least-distance problem: less is none


def osqp(entry: Entry, tolerance: float) -> Solve:
    """Alternating directions, Stellato et al., Math. Program. Comput. 12, 637 (2020)."""
    program = program_of(entry)
    p, g = columns(triu(program.p)), columns(eye_array(program.count))
    lower, upper = np.zeros(program.count), np.full(program.count, np.inf)
    settings = {
        "eps_abs": tolerance,
        "eps_rel": 0.0,
        "max_iter": 20_000,
        "time_limit": LIMIT,
        "verbose": False,
    } | OSQP

    def solve() -> Answer | None:
        solver = osqp_package.OSQP()
        solver.setup(P=p, q=program.q, A=g, l=lower, u=upper, **settings)
        result = solver.solve(raise_error=False)
        if "infeasible" in result.info.status:
            return None
        return Answer(program.scale * np.maximum(result.x, 0), result.info.iter)

    return solve


def proximal(entry: Entry, tolerance: float) -> Solve:
    """Augmented Lagrangian with semismooth Newton steps, Bambade et al., Robotics: Science and
    Systems (2022).
    """
    program = program_of(entry)
    g, lower, upper = (
        columns(eye_array(program.count)),
        np.zeros(program.count),
        np.full(program.count, _FREE),
    )

    def solve() -> Answer | None:
        solver = proxqp.sparse.QP(program.count, 0, program.count)
        for name, value in {"eps_abs": tolerance, "eps_rel": 0.0, **PROXQP}.items():
            setattr(
                solver.settings,
                name,
                getattr(proxqp.SparseBackend, value) if isinstance(value, str) else value,
            )
        solver.init(program.p, program.q, None, None, g, lower, upper)
        solver.solve()
        if "INFEASIBLE" in str(solver.results.info.status):
            return None
        return Answer(program.scale * np.maximum(solver.results.x, 0), solver.results.info.iter)

    return solve


def interior(entry: Entry, tolerance: float) -> Solve:
    """Clarabel: an interior-point method, Goulart and Chen, arXiv:2405.12762 (2024)."""
    program = program_of(entry)
    chosen = clarabel.DefaultSettings()
    given = {"verbose": False, "max_threads": 1, "time_limit": LIMIT}
    given |= dict.fromkeys(("tol_feas", "tol_gap_abs", "tol_gap_rel", "tol_ktratio"), tolerance)
    for name, value in (given | CLARABEL).items():
        setattr(chosen, name, value)
    p, g = columns(triu(program.p)), columns(-eye_array(program.count))
    cones = [clarabel.NonnegativeConeT(program.count)]

    def solve() -> Answer | None:
        result = clarabel.DefaultSolver(
            p, program.q, g, np.zeros(program.count), cones, chosen
        ).solve()
        if "Infeasible" in str(result.status):
            return None
        return Answer(program.scale * np.maximum(np.array(result.x), 0), result.iterations)

    return solve


def proximal_interior(entry: Entry, tolerance: float) -> Solve:
    """PIQP: a proximal interior-point method, Schwan et al., IEEE Conf. Decis. Control (2023)."""
    program = program_of(entry)
    settings: dict[str, Any] = {"eps_abs": tolerance, "eps_rel": 0.0, "num_threads": 1}
    settings |= {"eps_duality_gap_abs": tolerance, "eps_duality_gap_rel": 0.0}
    settings["kkt_solver"] = piqp_package.sparse_ldlt

    def solve() -> Answer | None:
        solver = piqp_package.SparseSolver()
        for name, value in settings.items():
            setattr(solver.settings, name, value)
        solver.setup(
            program.p, program.q, None, None, None, None, None, np.zeros(program.count), None
        )
        if "INFEASIBLE" in str(solver.solve()):
            return None
        return Answer(program.scale * np.maximum(solver.result.x, 0), solver.result.info.iter)

    return solve


def least_squares(entry: Entry, tolerance: float) -> Solve:
    """Non-negative least squares of SciPy, an active-set method, which has no tolerance.

    With velocity changes as unknowns the problem is a least-distance problem: ‖Gᵀ y‖² + (h·y − 1)²
    with h = −u⁻ is least over y ≥ 0 where p = y/(1 − h·y), and a vanishing rest 1 − h·y says that
    no velocities satisfy all contacts.

    Source: Lawson and Hanson, Solving Least Squares Problems (1974), chapter 23.
    """
    rates, scale = scaled(entry)
    rows = np.vstack([weighted(entry).toarray().T, -rates])
    wanted = np.zeros(len(rows))
    wanted[-1] = 1.0

    def solve() -> np.ndarray | None:
        weights, _ = nnls(rows, wanted)
        rest = 1 + rates @ weights
        return None if rest < _LEAST_REST else scale * weights / rest

    return solve
