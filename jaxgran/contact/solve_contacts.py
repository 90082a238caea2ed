"""Any frictionless contact problem, solved by the methods of the engines, and the residual of
impulses from any solver.

With w = u⁺ + α u⁻ = W J + (1 + α) u⁻ the law is 0 ≤ J ⟂ w ≥ 0. The residual is that of the natural
map, ‖min(W_cc J, w)‖ over the speed (1 + α) ‖min(u⁻, 0)‖ that stops every contact by itself. So it
does not depend on units, and a list of problems has comparable numbers.
"""

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from jaxgran.contact.problem import ContactProblem, as_problem, check_problem, require_shape
from jaxgran.contact.projected_methods import BarzilaiBorwein, ProjectedMethod, dot, require_solver
from jaxgran.contact.solver import natural_map, solve, unit_of
from jaxgran.model.checks import as_array, require_number
from jaxgran.model.flow import RANGES
from jaxgran.model.values import Value

_DEFAULT = BarzilaiBorwein(tolerance=1e-6)


@dataclass(frozen=True, eq=False, repr=False)
class ContactSolution(Value):
    """Impulses of a contact problem, and how good they are.

    ==========  ===========  ====  =================================================================
    field       shape        unit  meaning
    ==========  ===========  ====  =================================================================
    impulses    (contacts,)  mσγ̇   impulses J = (1 + α) J₀, never negative
    velocities  (contacts,)  σγ̇    relative normal velocities u⁺ = u⁻ + W J after
    residual    ()           –     what ``tolerance`` is compared with, see ``contact_residual``
    iterations  ()           –     products with W
    status      ()           –     ok, iteration_limit, infeasible or nonfinite: see Status
    ==========  ===========  ====  =================================================================
    """

    impulses: Float[Array, " contacts"]
    velocities: Float[Array, " contacts"]
    residual: Float[Array, ""]
    iterations: Int[Array, ""]
    status: Int[Array, ""]


def solve_contacts(
    problem: ContactProblem, restitution: float | Array = 0.0, solver: ProjectedMethod = _DEFAULT
) -> ContactSolution:
    """Impulses of a frictionless contact problem: 0 ≤ J ⟂ u⁺ + α u⁻ ≥ 0 with u⁺ = u⁻ + W J.

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
    mode. They are those of the solution, not of the iteration, and need a tolerance of 1e-8 or
    less. Where impulses are not unique, as in a cluster with more contacts than degrees of freedom,
    velocities are, and one solution is returned.

    With one α for all contacts no solution gains energy: it changes by −½ (1 − α²) J₀ᵀ W J₀, where
    J₀ is the solution at α = 0. A tolerance below the rounding of the velocities is met at 10
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
    require_number("restitution", restitution, *RANGES["restitution"])
    require_solver(solver)
    problem = as_problem(problem)
    kind: Any = problem.approach.dtype
    solver_of_kind = jax.tree.map(partial(_of_precision, kind), solver)
    return _solved(problem, jnp.asarray(restitution, kind), solver_of_kind)


def contact_residual(
    problem: ContactProblem, impulses: Any, restitution: float | Array = 0.0
) -> Float[Array, ""]:
    """The residual ‖min(W_cc J, w)‖ / ((1 + α) ‖min(u⁻, 0)‖) of impulses from any solver, with w =
    u⁺ + α u⁻; ``jit`` and ``vmap`` apply.

    ===========  ===============================  ====  ============================================
    argument     type or shape                    unit  meaning
    ===========  ===============================  ====  ============================================
    problem      ContactNetwork, DelassusProblem  –     the contact problem
    impulses     (contacts,)                      mσγ̇   impulses J to judge
    restitution  ()                               –     α in [0, 1]
    returns      ()                               –     zero at a solution; ‖min(W_cc J, w)‖ itself
                                                        where nothing approaches; no derivative
    ===========  ===============================  ====  ============================================

    Source: Facchinei and Pang, Finite-Dimensional Variational Inequalities (2003), chapter 1, for
    the natural map.

    Raises:
      InputError: (a ValueError) as ``solve_contacts``, or the impulses are not one number for each
        contact.

    Examples:
      The impulse 1 stops two discs of mass 2 that approach at speed 1; half of it does not:

      >>> from jaxgran.contact.problem import DelassusProblem
      >>> pair = DelassusProblem(jnp.array([[1.0]]), jnp.array([-1.0]))
      >>> [float(contact_residual(pair, jnp.array([p]))) for p in (1.0, 0.5)]
      [0.0, 0.5]
    """
    check_problem(problem)
    impulses = as_array(impulses)
    require_shape("impulses", impulses, problem.approach.shape, "a number for each contact")
    require_number("restitution", restitution, *RANGES["restitution"])
    problem = as_problem(problem)
    kind: Any = problem.approach.dtype
    return _residual(problem, jnp.asarray(impulses, kind), jnp.asarray(restitution, kind))


def _of_precision(kind: Any, number: Any) -> Array:
    """A number of the solver in the precision of the problem; whole numbers stay whole."""
    is_float = jnp.issubdtype(jnp.result_type(number), jnp.floating)
    return jnp.asarray(number, kind if is_float else jnp.int32)


@jax.jit
def _solved(
    problem: ContactProblem, restitution: Array, solver: ProjectedMethod
) -> ContactSolution:
    unit = unit_of(problem.approach)
    scaled = replace(problem, approach=problem.approach / unit)
    operator = scaled.operator()
    fastest = lax.stop_gradient(jnp.max(jnp.abs(operator.approach)))
    solution = solve(operator, fastest, solver, jnp.asarray(True))
    impulses = (1 + restitution) * solution.impulses * unit
    return ContactSolution(
        impulses=impulses,
        velocities=(operator.approach + (1 + restitution) * solution.response) * unit,
        residual=_residual(problem, impulses, restitution),
        iterations=solution.iterations,
        status=solution.status,
    )


@jax.jit
def _residual(problem: ContactProblem, impulses: Array, restitution: Array) -> Float[Array, ""]:
    unit = unit_of(problem.approach)
    operator = replace(problem, approach=problem.approach / unit).operator()
    impulses = impulses / unit
    after = operator.product(impulses) + (1 + restitution) * operator.approach
    stopped = (1 + restitution) * jnp.minimum(operator.approach, 0)
    speed = jnp.sqrt(dot(stopped, stopped))
    residual = natural_map(operator.diagonal(), impulses, after)
    return lax.stop_gradient(residual / jnp.where(speed > 0, speed, 1 / unit))
