"""Impulses of a contact network: projected Jacobi and Nesterov iterations with a spectral bound.

With normal impulses p and the Delassus operator W = H M⁻¹ Hᵀ the contact law of a step is

    u⁺ = u⁻ + W p,    0 ≤ p ⟂ u⁺ + α u⁻ ≥ 0.

Its solution is p = (1 + α) p₀, where p₀ solves it at α = 0; so only 0 ≤ p₀ ⟂ W p₀ + u⁻ ≥ 0 is ever solved.

The step length of contact c between grains i and j is 1/D_c with D_c = λ(A_i)/m_i + λ(A_j)/m_j, where λ(A_b) is the
largest eigenvalue of A_b = Σ n nᵀ over the contacts of grain b, a 2×2 matrix. For any vector x,
xᵀWx = Σ_b |Σ_c ±n x_c|²/m_b ≤ Σ_b λ(A_b)/m_b Σ_{c∋b} x_c² = xᵀDx: so W ⪯ D, projected Jacobi falls monotonically
for every relaxation ω < 2, Nesterov's method converges at ω = 1, and an isolated pair (D = W) is exact at once.
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from jaxgran.contacts import Contacts
from jaxgran.flow import Solver
from jaxgran.replica import any_replica, where_active
from jaxgran.status import Status

JACOBI_RELAXATION = 1.8
_JAMMED_RESPONSE = 1e-3  # impulses that grow without moving anything: a direction of W p = 0 with p·u⁻ < 0


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Solution:
    """Result of one contact solve.

    ==========  ===========  ====  ======================================================
    field       shape        unit  meaning
    ==========  ===========  ====  ======================================================
    impulses    (contacts,)  mσγ̇   impulses p₀ at restitution zero, never negative
    response    (contacts,)  σγ̇    velocity change W p₀ of the contacts
    residual    ()           –     ‖min(diag(W) p, W p + u⁻)‖ over ‖min(u⁻, 0)‖
    iterations  ()           –     products with W
    status      ()           –     ok, iteration_limit, infeasible or nonfinite
    ==========  ===========  ====  ======================================================
    """

    impulses: Float[Array, " contacts"]
    response: Float[Array, " contacts"]
    residual: Float[Array, ""]
    iterations: Int[Array, ""]
    status: Int[Array, ""]


def grain_impulses(contacts: Contacts, impulses: Float[Array, " contacts"], grains: int) -> Float[Array, "grains 2"]:
    """Total impulse Hᵀp on every grain."""
    along = contacts.normals * impulses[:, None]
    total = jnp.zeros((grains, 2), along.dtype)
    return total.at[contacts.i].add(along).at[contacts.j].add(-along)


def delassus_product(contacts: Contacts, impulses: Float[Array, " contacts"], grains: int) -> Float[Array, " contacts"]:
    """Change W p of the relative normal velocities that the impulses cause."""
    total = grain_impulses(contacts, impulses, grains)
    change = total[contacts.i] * contacts.inverse_mass_i[:, None] - total[contacts.j] * contacts.inverse_mass_j[:, None]
    return jnp.sum(contacts.normals * change, axis=-1)


def spectral_bound(contacts: Contacts, grains: int) -> Float[Array, " contacts"]:
    """Diagonal D with W ⪯ D; one in unused slots, so that it can be divided by."""
    nx, ny = contacts.normals[:, 0], contacts.normals[:, 1]
    outer = jnp.stack([nx * nx, nx * ny, ny * ny], axis=-1)
    total = jnp.zeros((grains, 3), outer.dtype).at[contacts.i].add(outer).at[contacts.j].add(outer)
    xx, xy, yy = total[:, 0], total[:, 1], total[:, 2]
    largest = (xx + yy + jnp.sqrt((xx - yy) ** 2 + 4 * xy**2)) / 2
    bound = largest[contacts.i] * contacts.inverse_mass_i + largest[contacts.j] * contacts.inverse_mass_j
    return jnp.where(contacts.used, bound, 1)


def solve(
    contacts: Contacts, grains: int, shear_rate: Array, tolerance: Array, max_iterations: Array, method: Solver, active: Array
) -> Solution:
    """Impulses p₀ of the network at restitution zero: 0 ≤ p₀ ⟂ W p₀ + u⁻ ≥ 0.

    Args:
      contacts: the network.
      grains: number of grains.
      shear_rate: γ̇; sets the absolute floor of the residual.
      tolerance: relative residual to reach.
      max_iterations: cap; beyond it the best iterate is returned with a status.
      method: "nesterov" (momentum with gradient restart) or "jacobi" (relaxation 1.8).
      active: whether this replica has something to solve; others of its batch return zero impulses.

    Sources: Nesterov (1983) for the momentum; O'Donoghue and Candès (2015) for the restart.
    """
    b = contacts.approach
    diagonal = contacts.inverse_mass_i + contacts.inverse_mass_j
    relaxation = JACOBI_RELAXATION if method == "jacobi" else 1.0
    bound = spectral_bound(contacts, grains)
    scale = jnp.linalg.norm(jnp.minimum(b, 0))
    target = tolerance * scale + 10 * jnp.finfo(b.dtype).eps * shear_rate

    def unfinished(now: _Iterate):
        return active & ~(now.residual <= target) & (now.iterations < max_iterations) & ~jnp.isnan(now.residual)

    def iterate(now: _Iterate) -> _Iterate:
        next_momentum = (1 + jnp.sqrt(1 + 4 * now.momentum**2)) / 2
        extrapolation = (now.momentum - 1) / next_momentum
        start = now.impulses + extrapolation * (now.impulses - now.previous)
        gradient = now.response + extrapolation * (now.response - now.previous_response) + b
        impulses = jnp.maximum(0, start - relaxation * gradient / bound)
        response = delassus_product(contacts, impulses, grains)
        residual = jnp.linalg.norm(jnp.minimum(diagonal * impulses, response + b))
        uphill = jnp.sum(bound * (start - impulses) * (impulses - now.impulses)) > 0
        keep_momentum = (method == "nesterov") & ~uphill
        better = ~(residual >= now.best_residual)
        new = _Iterate(
            impulses=impulses,
            response=response,
            previous=now.impulses,
            previous_response=now.response,
            momentum=jnp.where(keep_momentum, next_momentum, 1.0).astype(b.dtype),
            residual=residual,
            best=jnp.where(better, impulses, now.best),
            best_response=jnp.where(better, response, now.best_response),
            best_residual=jnp.where(better, residual, now.best_residual),
            iterations=now.iterations + 1,
        )
        return where_active(unfinished(now), new, now)

    zero = jnp.zeros_like(b)
    infinite = jnp.asarray(jnp.inf, b.dtype)
    start = _Iterate(zero, zero, zero, zero, jnp.ones((), b.dtype), infinite, zero, zero, infinite, jnp.int32(0))
    end = lax.while_loop(lambda now: any_replica(unfinished(now)), iterate, start)
    jammed = (jnp.sum(b * end.best) < 0) & (
        jnp.linalg.norm(end.best_response) < _JAMMED_RESPONSE * jnp.linalg.norm(diagonal * end.best)
    )
    capped = active & ~(end.residual <= target)
    status = jnp.where(capped, jnp.where(jammed, Status.infeasible, Status.iteration_limit), Status.ok)
    return Solution(
        impulses=end.best,
        response=end.best_response,
        residual=jnp.where(active, end.best_residual / jnp.maximum(scale, target), 0),
        iterations=end.iterations,
        status=jnp.where(active & jnp.isnan(end.residual), Status.nonfinite, status).astype(jnp.int32),
    )


class _Iterate(NamedTuple):
    impulses: Array
    response: Array
    previous: Array
    previous_response: Array
    momentum: Array
    residual: Array
    best: Array
    best_response: Array
    best_residual: Array
    iterations: Array
