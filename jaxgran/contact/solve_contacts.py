"""Any frictionless contact problem: solved by the methods of the engines, and residuals of impulses
by the definitions in use.

With w = u⁺ + α u⁻ = W J + (1 + α) u⁻ the law is 0 ≤ J ⟂ w ≥ 0. All residuals are made dimensionless
by what stops every contact by itself: the speed v = (1 + α) ‖min(u⁻, 0)‖ and the energy
E = (1 + α)² Σ min(u⁻, 0)²/W_cc. So they do not depend on units, and a list of problems has
comparable numbers.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from jaxgran.contact.delassus import Operator, delassus_product, diagonal
from jaxgran.contact.problem import (
    ContactNetwork,
    ContactProblem,
    as_contacts,
    as_problem,
    check_problem,
    require_shape,
)
from jaxgran.contact.projected_methods import (
    BarzilaiBorwein,
    ProjectedMethod,
    dot,
    require_solver,
)
from jaxgran.contact.solver import solve
from jaxgran.model.checks import as_array, require_number
from jaxgran.model.flow import RANGES
from jaxgran.model.values import Value

_DEFAULT = BarzilaiBorwein(tolerance=1e-6)


@dataclass(frozen=True, eq=False, repr=False)
class ContactResiduals(Value):
    """How far impulses J are from a solution; all are zero at one, and none has a derivative.

    ==================  =====  ====  ===============================================================
    field               shape  unit  meaning
    ==================  =====  ====  ===============================================================
    natural_map         ()     –     ‖min(W_cc J, w)‖ / v; what ``tolerance`` is compared with
    fischer_burmeister  ()     –     ‖a + w − √(a² + w²)‖ / v with a = W_cc J
    complementarity     ()     –     largest |J w| of a contact / E
    energy              ()     –     |J·w| / E; the energy after differs from that of the law by
                                     J·w/(1 + α)
    approach            ()     –     largest speed −w at which a contact still approaches / v
    tension             ()     –     largest speed −W_cc J of an impulse that pulls / v
    ==================  =====  ====  ===============================================================

    w = u⁺ + α u⁻; v = (1 + α) ‖min(u⁻, 0)‖ and E = (1 + α)² Σ min(u⁻, 0)²/W_cc, or 1 where nothing
    approaches.
    """

    natural_map: Float[Array, ""]
    fischer_burmeister: Float[Array, ""]
    complementarity: Float[Array, ""]
    energy: Float[Array, ""]
    approach: Float[Array, ""]
    tension: Float[Array, ""]


@dataclass(frozen=True, eq=False, repr=False)
class ContactSolution(Value):
    """Impulses of a contact problem, and how good they are.

    ==========  ================  ====  =========================================================
    field       shape             unit  meaning
    ==========  ================  ====  =========================================================
    impulses    (contacts,)       mσγ̇   impulses J = (1 + α) J₀, never negative
    velocities  (contacts,)       σγ̇    relative normal velocities u⁺ = u⁻ + W J after
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


def solve_contacts(
    problem: ContactProblem,
    restitution: float | Array = 0.0,
    solver: ProjectedMethod = _DEFAULT,
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


def contact_residuals(
    problem: ContactProblem, impulses: Any, restitution: float | Array = 0.0
) -> ContactResiduals:
    """Residuals of impulses from any solver; ``jit`` and ``vmap`` apply.

    ===========  ===============================  ====  ===========================
    argument     type or shape                    unit  meaning
    ===========  ===============================  ====  ===========================
    problem      ContactNetwork, DelassusProblem  –     the contact problem
    impulses     (contacts,)                      mσγ̇   impulses J to judge
    restitution  ()                               –     α in [0, 1]
    ===========  ===============================  ====  ===========================

    Sources: Fischer, Optimization 24, 269 (1992); Facchinei and Pang, Finite-Dimensional
    Variational Inequalities (2003), chapter 1, for the natural map.

    Raises:
      InputError: (a ValueError) as ``solve_contacts``, or the impulses are not one number for each
        contact.

    Examples:
      The impulse 1 stops two discs of mass 2 that approach at speed 1; half of it does not:

      >>> from jaxgran.contact.problem import DelassusProblem
      >>> pair = DelassusProblem(jnp.array([[1.0]]), jnp.array([-1.0]))
      >>> [float(contact_residuals(pair, jnp.array([p])).natural_map) for p in (1.0, 0.5)]
      [0.0, 0.5]
    """
    check_problem(problem)
    impulses = as_array(impulses)
    require_shape("impulses", impulses, problem.approach.shape, "a number for each contact")
    require_number("restitution", restitution, *RANGES["restitution"])
    problem = as_problem(problem)
    kind: Any = problem.approach.dtype
    return _residuals(problem, jnp.asarray(impulses, kind), jnp.asarray(restitution, kind))


def _of_precision(kind: Any, number: Any) -> Array:
    """A number of the solver in the precision of the problem; whole numbers stay whole."""
    return jnp.asarray(
        number, kind if jnp.issubdtype(jnp.result_type(number), jnp.floating) else jnp.int32
    )


def _operator(problem: ContactProblem) -> tuple[Operator, int]:
    """The Delassus operator of a problem, and its number of grains, 0 for a matrix."""
    if isinstance(problem, ContactNetwork):
        return as_contacts(problem), problem.masses.size
    return problem, 0


@jax.jit
def _solved(
    problem: ContactProblem, restitution: Array, solver: ProjectedMethod
) -> ContactSolution:
    operator, grains = _operator(problem)
    fastest = lax.stop_gradient(jnp.max(jnp.abs(operator.approach)))
    solution = solve(operator, grains, fastest, solver, jnp.asarray(True))
    impulses = (1 + restitution) * solution.impulses
    return ContactSolution(
        impulses=impulses,
        velocities=operator.approach + (1 + restitution) * solution.response,
        residuals=_residuals(problem, impulses, restitution),
        iterations=solution.iterations,
        status=solution.status,
    )


@jax.jit
def _residuals(problem: ContactProblem, impulses: Array, restitution: Array) -> ContactResiduals:
    operator, grains = _operator(problem)
    w_diagonal = diagonal(operator, grains)
    after = delassus_product(operator, impulses, grains) + (1 + restitution) * operator.approach
    stopped = (1 + restitution) * jnp.minimum(operator.approach, 0)
    speed, energy = jnp.sqrt(dot(stopped, stopped)), dot(stopped, stopped / w_diagonal)
    speed, energy = (jnp.where(x > 0, x, 1) for x in (speed, energy))
    push, work = w_diagonal * impulses, impulses * after
    least, merged = jnp.minimum(push, after), _fischer_burmeister(push, after)
    residuals = ContactResiduals(
        natural_map=jnp.sqrt(dot(least, least)) / speed,
        fischer_burmeister=jnp.sqrt(dot(merged, merged)) / speed,
        complementarity=jnp.max(jnp.abs(work)) / energy,
        energy=jnp.abs(jnp.sum(work)) / energy,
        approach=jnp.maximum(0, -jnp.min(after)) / speed,
        tension=jnp.maximum(0, -jnp.min(push)) / speed,
    )
    return jax.tree.map(lax.stop_gradient, residuals)


def _fischer_burmeister(a: Array, b: Array) -> Array:
    """a + b − √(a² + b²), without the cancellation that hides one small number beside a large
    one.
    """
    length, total = jnp.hypot(a, b), a + b
    return jnp.where(total > 0, 2 * a * b / jnp.where(total > 0, total + length, 1), total - length)
