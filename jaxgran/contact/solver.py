"""Impulses of a contact network: the loop that runs a projected method until the residual is small.

With normal impulses J and the Delassus operator W = H M⁻¹ Hᵀ the contact law of a step is

    u⁺ = u⁻ + W J,    0 ≤ J ⟂ u⁺ + α u⁻ ≥ 0.

Its solution is J = (1 + α) J₀, where J₀ solves it at α = 0; so only 0 ≤ J₀ ⟂ W J₀ + u⁻ ≥ 0 is ever
solved.

Derivatives do not go through the iteration. On the contacts that press, A = {J₀ > 0}, the solution
satisfies W_AA J₀ + u⁻_A = 0, and every small change keeps it so where no contact is about to press
or to part:

    W_AA dJ₀ = −(dW J₀ + du⁻)_A,    dJ₀ = 0 elsewhere.

This linear system is solved by conjugate gradients, in forward and in reverse mode, whose memory
does not depend on the iterations. Where W_AA is singular, as in a cluster with more contacts than
degrees of freedom, velocities after the step have this derivative and the impulses are not unique,
nor are their derivatives: one solution is returned. The set A is that of the solution found, so
derivatives want a small tolerance (1e-8 or less).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from jaxgran.contact.delassus import DelassusOperator, NetworkOperator
from jaxgran.contact.law import JAMMED_RESPONSE, relative_residual, residual_target
from jaxgran.contact.projected_methods import IMPULSES, RESPONSE, Iterate, ProjectedMethod, dot
from jaxgran.model.control_flow import any_replica, where_active
from jaxgran.model.status import Status

# Relative residuals; a derivative above the latter is NaN
_DERIVATIVE_TOLERANCE, _WORST_DERIVATIVE = 1e-12, 1e-6
_DERIVATIVE_ITERATIONS = 50  # at most, for each slot of a contact


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Solution:
    """Result of one contact solve."""

    impulses: Float[Array, " contacts"]  # J₀ at restitution zero, never negative
    response: Float[Array, " contacts"]  # velocity change W J₀ of the contacts
    residual: Float[Array, ""]  # ‖min(diag(W) J, W J + u⁻)‖ over ‖min(u⁻, 0)‖
    iterations: Int[Array, ""]  # products with W
    status: Int[Array, ""]  # ok, iteration_limit, infeasible or nonfinite


def natural_map(
    diagonal: Float[Array, " contacts"],
    impulses: Float[Array, " contacts"],
    after: Float[Array, " contacts"],
) -> Float[Array, ""]:
    """The residual ‖min(W_cc J, w)‖ with w the velocities after; zero at a solution."""
    error = jnp.minimum(diagonal * impulses, after)
    return jnp.sqrt(dot(error, error))


def unit_of(values: Float[Array, " contacts"]) -> Float[Array, ""]:
    """A power of two near the largest of some values, in which no square of them over- or
    underflows; division by it is exact.
    """
    largest = lax.stop_gradient(jnp.max(jnp.abs(values)))
    exponent = jnp.frexp(jnp.where((largest > 0) & jnp.isfinite(largest), largest, 1))[1]
    return jnp.ldexp(jnp.ones((), largest.dtype), exponent - 1)


@jax.custom_jvp
def solve(
    operator: DelassusOperator, shear_rate: float | Array, solver: ProjectedMethod, active: Array
) -> Solution:
    """Impulses J₀ of the network at restitution zero: 0 ≤ J₀ ⟂ W J₀ + u⁻ ≥ 0.

    Args:
      operator: W and u⁻ of the contacts.
      shear_rate: γ̇; sets the absolute floor of the residual.
      solver: the projected method, with its tolerance and its largest number of iterations.
      active: whether this replica has something to solve; others of its batch return zero impulses.

    Impulses and response have derivatives with respect to the operator, see the module; all else
    has none.
    """
    b, w_diagonal = operator.approach, operator.diagonal()
    bound = solver.bound(operator)
    closing = jnp.minimum(b, 0)
    scale = jnp.sqrt(dot(closing, closing))
    tolerance = jnp.asarray(solver.tolerance, b.dtype)
    max_steps = jnp.asarray(solver.max_steps, jnp.int32)
    target = residual_target(scale, tolerance, shear_rate, jnp.finfo(b.dtype).eps)

    def as_numbers(values: Any) -> Any:
        """What a method returns, in the precision of the contacts."""
        return jax.tree.map(lambda x: jnp.asarray(x, b.dtype), values)

    def iterate(now: _Progress) -> _Progress:
        at, iterations = now.at, now.at.iterations + 1
        start, step_length = as_numbers(solver.propose(at))
        velocities = start[RESPONSE] + b
        impulses = jnp.maximum(0, start[IMPULSES] - step_length * velocities / bound)
        response = operator.product(impulses)
        point = jnp.stack([impulses, response])
        residual = natural_map(w_diagonal, impulses, response + b)
        better = residual < at.best_residual
        best_residual = jnp.where(better, residual, at.best_residual)
        memory = as_numbers(solver.learn(at, start, point, bound, best_residual))
        new = _Progress(
            at=Iterate(point, at.point, memory, best_residual, iterations),
            residual=residual,
            best=jnp.where(better, point, now.best),
            unfinished=~(residual <= target) & (iterations < max_steps) & jnp.isfinite(residual),
        )
        return where_active(now.unfinished, new, now)

    zero, infinite = jnp.zeros((2, b.size), b.dtype), jnp.asarray(jnp.inf, b.dtype)
    first = Iterate(zero, zero, as_numbers(solver.init(b)), infinite, jnp.int32(0))
    end = lax.while_loop(
        lambda now: any_replica(now.unfinished),
        iterate,
        _Progress(first, infinite, zero, jnp.asarray(active)),
    )
    impulses, response = end.best

    def is_jammed():
        # The best iterate may be an early one, whose impulses have not grown yet.
        last_impulses, last_response = end.at.point
        return dot(last_impulses, last_response) < JAMMED_RESPONSE * -dot(b, last_impulses)

    capped = active & ~(end.residual <= target)
    jammed = lax.cond(any_replica(capped), is_jammed, lambda: jnp.bool_(False))
    failure = jnp.where(jammed, Status.infeasible, Status.iteration_limit)
    nonfinite = active & ~jnp.isfinite(end.at.best_residual)
    status = jnp.where(nonfinite, Status.nonfinite, jnp.where(capped, failure, Status.ok))
    return Solution(
        impulses=impulses,
        response=response,
        residual=jnp.where(active, relative_residual(end.at.best_residual, scale, target), 0),
        iterations=end.at.iterations,
        status=status.astype(jnp.int32),
    )


@solve.defjvp
def _solve_jvp(primals: tuple, tangents: tuple) -> tuple[Solution, Solution]:
    operator, change = primals[0], tangents[0]
    solution = solve(*primals)
    impulses, loaded = solution.impulses, solution.impulses > 0
    w_diagonal = operator.diagonal()

    def loaded_product(x: Array) -> Array:
        """W_AA on the contacts that press, and the identity on the others."""
        return jnp.where(loaded, operator.product(jnp.where(loaded, x, 0)), x)

    def by_conjugate_gradients(matvec: Callable, target: Array) -> Array:
        unit = unit_of(target)
        target = target / unit
        square = dot(target, target)

        def unfinished(now: _Gradients) -> Array:
            few = now.iterations < _DERIVATIVE_ITERATIONS * impulses.size
            return few & (now.least > _DERIVATIVE_TOLERANCE**2 * square) & jnp.isfinite(now.weight)

        def iterate(now: _Gradients) -> _Gradients:
            change = matvec(now.direction)
            length = now.weight / dot(now.direction, change)
            x, residual = now.x + length * now.direction, now.residual - length * change
            scaled, size = residual / w_diagonal, dot(residual, residual)
            weight, better = dot(residual, scaled), size < now.least
            return _Gradients(
                x,
                residual,
                scaled + weight / now.weight * now.direction,
                weight,
                jnp.where(better, x, now.best),
                jnp.where(better, size, now.least),
                now.iterations + 1,
            )

        zero, scaled = jnp.zeros_like(target), target / w_diagonal
        start = _Gradients(
            zero, target, scaled, dot(target, scaled), zero, square, jnp.zeros((), jnp.int32)
        )
        x = lax.while_loop(unfinished, iterate, start).best
        residual = target - matvec(x)
        converged = dot(residual, residual) <= _WORST_DERIVATIVE**2 * square
        return jnp.where(converged & jnp.isfinite(square), unit * x, jnp.nan)

    _, response_change = jax.jvp(lambda w: w.product(impulses), (operator,), (change,))
    target = jnp.where(loaded, -(response_change + change.approach), 0)
    impulse_change = lax.custom_linear_solve(
        loaded_product, target, by_conjugate_gradients, symmetric=True
    )
    no_tangent: Any = np.zeros((), jax.dtypes.float0)
    return solution, Solution(
        impulses=impulse_change,
        response=response_change + operator.product(impulse_change),
        residual=jnp.zeros_like(solution.residual),
        iterations=no_tangent,
        status=no_tangent,
    )


class _Gradients(NamedTuple):
    """Conjugate gradients: rounding lets them diverge where a matrix is singular, so the best
    iterate is kept.
    """

    x: Array
    residual: Array
    direction: Array
    weight: Array  # of the residual, in the norm of the preconditioner
    best: Array
    least: Array  # squared residual of the best
    iterations: Array


def single_contact(operator: NetworkOperator) -> Solution:
    """The closed form of a single contact, for which the iteration would need one product."""
    w_diagonal = operator.diagonal()
    impulses = jnp.maximum(0, -operator.approach / w_diagonal)
    status = jnp.where(jnp.any(jnp.isnan(impulses)), Status.nonfinite, Status.ok).astype(jnp.int32)
    return Solution(
        impulses, w_diagonal * impulses, jnp.zeros((), impulses.dtype), jnp.int32(1), status
    )


class _Progress(NamedTuple):
    at: Iterate
    residual: Array
    best: Array  # (2, contacts): the point of the smallest residual
    unfinished: Array
