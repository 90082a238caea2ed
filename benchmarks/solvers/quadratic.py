"""Solvers of quadratic programs: OSQP, ProxQP, Clarabel and PIQP, and the non-negative least squares of SciPy.

Each has the form that is better for it, see ``forms``. A solve begins with the sparse matrices and ends with the
impulses, since in a flow all of them change from step to step: analysis and factors are part of it. Iterations are
those that a package reports, and no two packages count the same.
"""

from typing import Any

import clarabel
import numpy as np
import osqp as osqp_package
import piqp as piqp_package
from proxsuite import proxqp
from scipy.optimize import nnls
from scipy.sparse import triu

from benchmarks.collection import Entry
from benchmarks.collection.compare import Answer, Solve
from benchmarks.solvers.forms import columns, in_impulses, in_velocities, scaled, weighted

FORMS = {"impulses": in_impulses, "velocities": in_velocities}
LIMIT = 1.0  # seconds of a solve, where a package has a limit of time
OSQP = {"form": "impulses", "adaptive_rho_interval": 25, "alpha": 1.8, "eps_dual_inf": 1e-8}
PROXQP_DENSE = {"form": "impulses", "max_iter": 100, "max_iter_in": 100, "eps_dual_inf": 1e-10}
PROXQP = {"sparse_backend": "SparseCholesky"} | PROXQP_DENSE  # its own choice for large problems has no factors
CLARABEL = {"form": "impulses", "static_regularization_constant": 1e-12}
PIQP = {"form": "impulses"}
_FREE = 1e20  # an upper bound that does not bind
_LEAST_REST = 1e-12  # of the least-distance problem: less is none


def osqp(entry: Entry, tolerance: float, start: np.ndarray | None = None, settings: dict = OSQP) -> Solve:
    """Alternating directions, Stellato et al., Math. Program. Comput. 12, 637 (2020)."""
    own = dict(settings)
    form = own.pop("form")
    program = FORMS[form](entry)
    p, above = columns(triu(program.p)), np.full(len(program.h), np.inf)

    def solve() -> Answer | None:
        solver = osqp_package.OSQP()
        given = {"eps_abs": tolerance, "eps_rel": 0.0, "max_iter": 20_000, "time_limit": LIMIT, "verbose": False} | own
        solver.setup(P=p, q=program.q, A=program.g, l=program.h, u=above, **given)
        if start is not None:
            solver.warm_start(x=start / program.scale)
        result = solver.solve(raise_error=False)
        if "infeasible" in result.info.status:
            return None
        impulses = result.x if form == "impulses" else -result.y
        return Answer(program.scale * np.maximum(impulses, 0), result.info.iter)

    return solve


def proximal(
    entry: Entry,
    tolerance: float,
    start: np.ndarray | None = None,
    settings: dict = PROXQP,
    sparse: bool = True,
) -> Solve:
    """Augmented Lagrangian with semismooth Newton steps, Bambade et al., Robotics: Science and Systems (2022)."""
    own = dict(settings)
    form = own.pop("form")
    program = FORMS[form](entry)
    count, above = len(program.h), np.full(len(program.h), _FREE)
    p, g = (program.p, program.g) if sparse else (program.p.toarray(), program.g.toarray())
    box = not sparse and form == "impulses"

    def solve() -> Answer | None:
        if sparse:
            solver = proxqp.sparse.QP(p.shape[0], 0, count)
        else:
            solver = proxqp.dense.QP(p.shape[0], 0, 0 if box else count, box)
        for name, value in {"eps_abs": tolerance, "eps_rel": 0.0, **own}.items():
            setattr(solver.settings, name, getattr(proxqp.SparseBackend, value) if isinstance(value, str) else value)
        bounds = (None, None, None, program.h, above) if box else (g, program.h, above)
        solver.init(p, program.q, None, None, *bounds)
        if start is None:
            solver.solve()
        else:
            solver.settings.initial_guess = proxqp.InitialGuess.WARM_START
            after = entry.matrix @ start + entry.problem.approach
            solver.solve(start / program.scale, np.zeros(0), -np.maximum(after, 0) / program.scale)
        if "INFEASIBLE" in str(solver.results.info.status):
            return None
        impulses = solver.results.x if form == "impulses" else -solver.results.z
        return Answer(program.scale * np.maximum(impulses, 0), solver.results.info.iter)

    return solve


def interior(entry: Entry, tolerance: float, settings: dict = CLARABEL) -> Solve:
    """Clarabel: an interior-point method, Goulart and Chen, arXiv:2405.12762 (2024)."""
    own = dict(settings)
    form = own.pop("form")
    program = FORMS[form](entry)
    chosen = clarabel.DefaultSettings()
    given = {"verbose": False, "max_threads": 1, "time_limit": LIMIT}
    given |= dict.fromkeys(("tol_feas", "tol_gap_abs", "tol_gap_rel", "tol_ktratio"), tolerance)
    for name, value in (given | own).items():
        setattr(chosen, name, value)
    p, g, cones = columns(triu(program.p)), columns(-program.g), [clarabel.NonnegativeConeT(len(program.h))]

    def solve() -> Answer | None:
        result = clarabel.DefaultSolver(p, program.q, g, -program.h, cones, chosen).solve()
        if "Infeasible" in str(result.status):
            return None
        impulses = np.array(result.x if form == "impulses" else result.z)
        return Answer(program.scale * np.maximum(impulses, 0), result.iterations)

    return solve


def proximal_interior(entry: Entry, tolerance: float, settings: dict = PIQP) -> Solve:
    """PIQP: a proximal interior-point method, Schwan et al., IEEE Conf. Decis. Control (2023)."""
    own = dict(settings)
    form = own.pop("form")
    program = FORMS[form](entry)
    given: dict[str, Any] = {"eps_abs": tolerance, "eps_rel": 0.0, "num_threads": 1} | own
    given |= {"eps_duality_gap_abs": tolerance, "eps_duality_gap_rel": 0.0}
    given["kkt_solver"] = getattr(piqp_package, given.pop("kkt_solver", "sparse_ldlt"))
    unbound = (None, None, None, None, None)

    def solve() -> Answer | None:
        solver = piqp_package.SparseSolver()
        for name, value in given.items():
            setattr(solver.settings, name, value)
        if form == "impulses":
            solver.setup(program.p, program.q, *unbound, program.h, None)
        else:
            solver.setup(program.p, program.q, None, None, program.g, program.h, None, None, None)
        status = str(solver.solve())
        if "INFEASIBLE" in status:
            return None
        impulses = solver.result.x if form == "impulses" else solver.result.z_l
        return Answer(program.scale * np.maximum(impulses, 0), solver.result.info.iter)

    return solve


def least_squares(entry: Entry, tolerance: float) -> Solve:
    """Non-negative least squares of SciPy, an active-set method, which has no tolerance.

    The program in velocities is a least-distance problem: ‖Gᵀ y‖² + (h·y − 1)² is least over y ≥ 0 where
    p = y/(1 − h·y), and a vanishing rest 1 − h·y says that no velocities satisfy all contacts.

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
