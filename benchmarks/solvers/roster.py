"""All solvers that are compared, by name."""

from functools import partial
from importlib.metadata import PackageNotFoundError, version
from typing import NamedTuple

from benchmarks.collection.compare import Prepare, projected, swept
from benchmarks.solvers.numba_engine import by_cluster
from benchmarks.solvers.single_precision import projected_in_float32
from jaxgran.contact.projected_methods import DEFAULT_SOLVER, SOLVERS

DEFAULT = "barzilai-borwein"
MACHINE_CODE = "numba engine"
PACKAGES = ("pin", "proxsuite", "osqp", "clarabel", "piqp", "scipy")


class Solver(NamedTuple):
    """A solver: how it is prepared, what its count means, and the settings that it does not have by default."""

    prepare: Prepare
    counts: str
    settings: dict
    ours: bool = False


def own() -> dict[str, Solver]:
    """The solvers of this program, and plain Gauss–Seidel sweeps."""
    settings = {"jacobi": {"relaxation": 1.8}, "jacobi-count": {"relaxation": 1.8}}
    settings |= {"jacobi-diagonal": {"relaxation": 1.0}}  # nothing bounds W there, so a longer step does harm alone
    methods = {}
    for name, method in SOLVERS.items():
        chosen = settings.get(name, {})
        methods[name] = Solver(partial(projected, method(**chosen)), "products with W", chosen, True)
    return {
        MACHINE_CODE: Solver(by_cluster, "sweeps or products with W of the slowest cluster", {}, True),
        **methods,
        f"{DEFAULT}, float32": Solver(partial(projected_in_float32, DEFAULT_SOLVER), "products with W", {}, True),
        "Gauss–Seidel": Solver(swept, "sweeps", {}, True),
    }


def peers() -> dict[str, Solver]:
    """The solvers of other packages.

    Raises:
      ModuleNotFoundError: they are not installed; the message says what to do.
    """
    try:
        from benchmarks.solvers import pinocchio, quadratic
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(f'{error.name} is missing: pip install "jaxgran[solver-peers]"') from error
    dense_admm = partial(pinocchio.multipliers, sparse=False)
    dense_proxqp = partial(quadratic.proximal, sparse=False, settings=quadratic.PROXQP_DENSE)
    return {
        "Pinocchio PGS": Solver(pinocchio.gauss_seidel, "sweeps", pinocchio.PGS),
        "Pinocchio ADMM": Solver(pinocchio.multipliers, "iterations", pinocchio.ADMM),
        "Pinocchio ADMM, dense": Solver(dense_admm, "iterations", pinocchio.ADMM),
        "ProxQP": Solver(quadratic.proximal, "iterations", quadratic.PROXQP),
        "ProxQP, dense": Solver(dense_proxqp, "iterations", quadratic.PROXQP_DENSE),
        "OSQP": Solver(quadratic.osqp, "iterations", quadratic.OSQP),
        "Clarabel": Solver(quadratic.interior, "iterations", quadratic.CLARABEL),
        "PIQP": Solver(quadratic.proximal_interior, "iterations", quadratic.PIQP),
        "SciPy NNLS": Solver(quadratic.least_squares, "", {}),
    }


def versions() -> dict[str, str]:
    """Versions of the packages of the peers that are installed."""
    found = {}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found
