"""How far impulses are from a solution of a contact problem, by the definitions in use.

With w = u⁺ + α u⁻ = W p + (1 + α) u⁻ the law is 0 ≤ p ⟂ w ≥ 0. All definitions are made
dimensionless by what stops every contact by itself: the speed v = (1 + α) ‖min(u⁻, 0)‖ and the
energy E = (1 + α)² Σ min(u⁻, 0)²/W_cc. So they do not depend on units, and a list of problems has
comparable numbers.
"""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxgran.contact.delassus import delassus_product, diagonal
from jaxgran.contact.problem import ContactNetwork, ContactProblem, as_contacts
from jaxgran.contact.problem_checks import as_problem, check_problem, require_impulses
from jaxgran.contact.projected_methods import dot
from jaxgran.model.batches import equal_values
from jaxgran.model.checks import require_number
from jaxgran.model.flow import RANGES


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ContactResiduals:
    """How far impulses p are from a solution; all are zero at one, and none has a derivative.

    ==================  =====  ====  ===============================================================
    field               shape  unit  meaning
    ==================  =====  ====  ===============================================================
    natural_map         ()     –     ‖min(W_cc p, w)‖ / v; what ``tolerance`` is compared with
    fischer_burmeister  ()     –     ‖a + w − √(a² + w²)‖ / v with a = W_cc p
    complementarity     ()     –     largest |p w| of a contact / E
    energy              ()     –     |p·w| / E; the energy after differs from that of the law by
                                     p·w/(1 + α)
    approach            ()     –     largest speed −w at which a contact still approaches / v
    tension             ()     –     largest speed −W_cc p of an impulse that pulls / v
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

    __eq__ = equal_values


def contact_residuals(
    problem: ContactProblem, impulses: Any, restitution: float | Array = 0.0
) -> ContactResiduals:
    """Residuals of impulses from any solver; ``jit`` and ``vmap`` apply.

    ===========  ===============================  ====  ===========================
    argument     type or shape                    unit  meaning
    ===========  ===============================  ====  ===========================
    problem      ContactNetwork, DelassusProblem  –     the contact problem
    impulses     (contacts,)                      mσγ̇   impulses p to judge
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
    problem = as_problem(problem)
    impulses = require_impulses(problem, impulses)
    require_number("restitution", restitution, *RANGES["restitution"])
    return residuals_of(problem, impulses, jnp.asarray(restitution, impulses.dtype))


@jax.jit
def residuals_of(problem: ContactProblem, impulses: Array, restitution: Array) -> ContactResiduals:
    """The residuals, without checks."""
    network = isinstance(problem, ContactNetwork)
    operator = as_contacts(problem) if network else problem
    grains = problem.masses.size if network else 0
    w_diagonal, one_plus_alpha = diagonal(operator, grains), 1 + restitution
    after = delassus_product(operator, impulses, grains) + one_plus_alpha * operator.approach
    stopped = one_plus_alpha * jnp.minimum(operator.approach, 0)
    speed, energy = jnp.sqrt(dot(stopped, stopped)), dot(stopped, stopped / w_diagonal)
    speed, energy = (jnp.where(x > 0, x, 1) for x in (speed, energy))
    push, work = w_diagonal * impulses, impulses * after
    least, merged = jnp.minimum(push, after), _fischer_burmeister(push, after)
    found = ContactResiduals(
        natural_map=jnp.sqrt(dot(least, least)) / speed,
        fischer_burmeister=jnp.sqrt(dot(merged, merged)) / speed,
        complementarity=jnp.max(jnp.abs(work)) / energy,
        energy=jnp.abs(jnp.sum(work)) / energy,
        approach=jnp.maximum(0, -jnp.min(after)) / speed,
        tension=jnp.maximum(0, -jnp.min(push)) / speed,
    )
    return jax.tree.map(lax.stop_gradient, found)


def _fischer_burmeister(a: Array, b: Array) -> Array:
    """a + b − √(a² + b²), without the cancellation that hides one small number beside a large
    one.
    """
    length, total = jnp.hypot(a, b), a + b
    return jnp.where(total > 0, 2 * a * b / jnp.where(total > 0, total + length, 1), total - length)
