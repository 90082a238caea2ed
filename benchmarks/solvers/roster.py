"""All solvers that are compared, by name."""

from dataclasses import dataclass
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from typing import NamedTuple

import jax.numpy as jnp

import jaxgran as jg
from benchmarks.collection.compare import Prepare, projected, swept
from benchmarks.solvers.numba_engine import by_cluster
from benchmarks.stability import JacobiDiagonal
from jaxgran.contact.projected_methods import SOLVERS

DEFAULT = "barzilai-borwein"
NUMBA_ENGINE = "numba engine"
PACKAGES = ("pin", "proxsuite", "osqp", "clarabel", "piqp", "scipy")


class Solver(NamedTuple):
    """A solver: how it is prepared, what its count means, and the settings that it does not have by
    default.
    """

    prepare: Prepare
    counts: str
    settings: dict
    ours: bool = False


@dataclass(frozen=True)
class JacobiCount(jg.Jacobi):
    """``Jacobi`` with D the numbers of contacts of both grains over their masses (mass splitting),
    which bounds W.

    Source: R. Tonge, F. Benevolenski and A. Voroshilov, ACM Trans. Graph. 31, 105 (2012).
    """

    def bound(self, operator):
        contacts = operator.contacts
        used = contacts.used.astype(contacts.normals.dtype)
        count = jnp.zeros(operator.grains, used.dtype)
        count = count.at[contacts.i].add(used).at[contacts.j].add(used)
        bound = (
            count[contacts.i] * contacts.inverse_mass_i
            + count[contacts.j] * contacts.inverse_mass_j
        )
        return jnp.where(contacts.used, bound, 1)


def our_solvers() -> dict[str, Solver]:
    """The solvers of this program, and plain Gauss–Seidel sweeps."""
    settings = {"jacobi": {"relaxation": 1.8}, "jacobi-count": {"relaxation": 1.8}}
    settings |= {
        "jacobi-diagonal": {"relaxation": 1.0}
    }  # nothing bounds W there, so a longer step does harm alone
    methods = {}
    for name, method in {
        **SOLVERS,
        "jacobi-count": JacobiCount,
        "jacobi-diagonal": JacobiDiagonal,
    }.items():
        chosen = settings.get(name, {})
        methods[name] = Solver(
            partial(projected, method(**chosen)), "products with W", chosen, True
        )
    return {
        NUMBA_ENGINE: Solver(
            by_cluster, "sweeps or products with W of the slowest cluster", {}, True
        ),
        **methods,
        "Gauss–Seidel": Solver(swept, "sweeps", {}, True),
    }


def package_solvers() -> dict[str, Solver]:
    """The solvers of other packages.

    Raises:
      ModuleNotFoundError: they are not installed; the message says what to do.
    """
    try:
        from benchmarks.solvers import pinocchio, quadratic
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            f'{error.name} is missing: pip install "jaxgran[solver-peers]"'
        ) from error
    return {
        "Pinocchio PGS": Solver(pinocchio.gauss_seidel, "sweeps", pinocchio.PGS),
        "Pinocchio ADMM": Solver(pinocchio.multipliers, "iterations", pinocchio.ADMM),
        "ProxQP": Solver(quadratic.proximal, "iterations", quadratic.PROXQP),
        "OSQP": Solver(quadratic.osqp, "iterations", quadratic.OSQP),
        "Clarabel": Solver(quadratic.interior, "iterations", quadratic.CLARABEL),
        "PIQP": Solver(quadratic.proximal_interior, "iterations", {}),
        "SciPy NNLS": Solver(quadratic.least_squares, "", {}),
    }


def versions() -> dict[str, str]:
    """Versions of the packages that are installed."""
    installed = {}
    for name in PACKAGES:
        try:
            installed[name] = version(name)
        except PackageNotFoundError:
            continue
    return installed
