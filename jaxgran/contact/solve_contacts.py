"""One call that solves any frictionless contact problem with the methods of the engines."""

from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxgran.contact.problem import ContactNetwork, ContactProblem, as_contacts
from jaxgran.contact.problem_checks import as_problem, check_problem
from jaxgran.contact.projected_methods import BarzilaiBorwein, ProjectedMethod, require_solver
from jaxgran.contact.residuals import ContactResiduals, residuals_of
from jaxgran.contact.solver import solve
from jaxgran.model.batches import equal_values
from jaxgran.model.checks import require_number
from jaxgran.model.flow import RANGES

_DEFAULT = BarzilaiBorwein(tolerance=1e-6)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ContactSolution:
    """Impulses of a contact problem, and how good they are.

    ==========  ================  ====  =========================================================
    field       shape             unit  meaning
    ==========  ================  ====  =========================================================
    impulses    (contacts,)       mσγ̇   impulses p = (1 + α) p₀, never negative
    velocities  (contacts,)       σγ̇    relative normal velocities u⁺ = u⁻ + W p after
    residuals   ContactResiduals  –     by each definition in use
    iterations  ()                –     products with W
    status      ()                –     ok, iteration_limit, infeasible or nonfinite: see Status
    ==========  ================  ====  =========================================================
    """

    impulses: Float[Array, " contacts"]
    velocities: Float[Array, " contacts"]
    residuals: ContactResiduals
    iterations: Int[Array, ""]
    status: Int[Array, ""]

    __eq__ = equal_values


def solve_contacts(
    problem: ContactProblem,
    restitution: float | Array = 0.0,
    solver: ProjectedMethod = _DEFAULT,
) -> ContactSolution:
    """Impulses of a frictionless contact problem: 0 ≤ p ⟂ u⁺ + α u⁻ ≥ 0 with u⁺ = u⁻ + W p.

    ===========  ===============================  ==================================================
    argument     type or shape                    meaning
    ===========  ===============================  ==================================================
    problem      ContactNetwork, DelassusProblem  the contacts, or W and u⁻
    restitution  ()                               α in [0, 1], Newton's: u⁺ = −α u⁻ where an impulse
                                                  acts
    solver       ProjectedMethod                  the method, and the residual of the natural map to
                                                  reach
    ===========  ===============================  ==================================================

    ``jit``, ``vmap`` and derivatives of impulses and velocities apply, in forward and in reverse
    mode. They are those of the solution, not of the iteration, and want a tolerance of 1e-8 or
    less. Where impulses are not unique, as in a cluster with more contacts than degrees of freedom,
    velocities are, and one solution is returned.

    With one α for all contacts no solution gains energy: it changes by −½ (1 − α²) p₀ᵀ W p₀, where
      p₀ is the solution at α = 0. A tolerance below the rounding of the velocities is met at 10
      roundings of the largest |u⁻|.

    Raises:
      InputError: (a ValueError) a number is outside its range; a problem is empty, its shapes do
        not fit, or its values are not finite; a normal is no unit vector or a grain does not exist;
        a matrix is not symmetric, or has a negative eigenvalue or no positive diagonal (above 2048
        contacts, eigenvalues are judged by the 2×2 minors alone). Values that JAX traces are not
        checked, and end in a status.

    Examples:
      Three equal discs in a row, the first of which is hit; all impulses of the row act together:

      >>> from jaxgran.contact.problem import DelassusProblem
      >>> row = DelassusProblem(jnp.array([[2.0, -1.0], [-1.0, 2.0]]), jnp.array([-1.0, 0.0]))
      >>> solution = solve_contacts(row, restitution=1.0)
      >>> solution.impulses.round(3).tolist(), solution.velocities.round(3).tolist()
      ([1.333, 0.667], [1.0, 0.0])
    """
    check_problem(problem)
    problem = as_problem(problem)
    require_number("restitution", restitution, *RANGES["restitution"])
    require_solver(solver)
    kind: Any = problem.approach.dtype
    return _solved(
        problem, jnp.asarray(restitution, kind), jax.tree.map(partial(_of_precision, kind), solver)
    )


def _of_precision(kind: Any, number: Any) -> Array:
    """A number of the solver in the precision of the problem; whole numbers stay whole."""
    return jnp.asarray(
        number, kind if jnp.issubdtype(jnp.result_type(number), jnp.floating) else jnp.int32
    )


@jax.jit
def _solved(
    problem: ContactProblem, restitution: Array, solver: ProjectedMethod
) -> ContactSolution:
    network = isinstance(problem, ContactNetwork)
    operator = as_contacts(problem) if network else problem
    grains = problem.masses.size if network else 0
    fastest = jax.lax.stop_gradient(jnp.max(jnp.abs(operator.approach)))
    always = jnp.asarray(True)
    solution = solve(operator, grains, fastest, solver, always)
    impulses = (1 + restitution) * solution.impulses
    return ContactSolution(
        impulses=impulses,
        velocities=operator.approach + (1 + restitution) * solution.response,
        residuals=residuals_of(problem, impulses, restitution),
        iterations=solution.iterations,
        status=solution.status,
    )
