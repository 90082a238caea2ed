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
    return total.at[_ends(contacts)].add(jnp.concatenate([along, -along]))


def _ends(contacts: Contacts) -> Int[Array, " two_contacts"]:
    """The grains at both ends of the contacts: one scatter over all ends costs less than one for each."""
    return jnp.concatenate([contacts.i, contacts.j])


def delassus_product(contacts: Contacts, impulses: Float[Array, " contacts"], grains: int) -> Float[Array, " contacts"]:
    """Change W p of the relative normal velocities that the impulses cause."""
    total = grain_impulses(contacts, impulses, grains)
    change = total[contacts.i] * contacts.inverse_mass_i[:, None] - total[contacts.j] * contacts.inverse_mass_j[:, None]
    return jnp.sum(contacts.normals * change, axis=-1)


def spectral_bound(contacts: Contacts, grains: int) -> Float[Array, " contacts"]:
    """Diagonal D with W ⪯ D; one in unused slots, so that it can be divided by."""
    nx, ny = contacts.normals[:, 0], contacts.normals[:, 1]
    outer = jnp.stack([nx * nx, nx * ny, ny * ny], axis=-1)
    total = jnp.zeros((grains, 3), outer.dtype).at[_ends(contacts)].add(jnp.concatenate([outer, outer]))
    xx, xy, yy = total[:, 0], total[:, 1], total[:, 2]
    largest = (xx + yy + jnp.sqrt((xx - yy) ** 2 + 4 * xy**2)) / 2
    bound = largest[contacts.i] * contacts.inverse_mass_i + largest[contacts.j] * contacts.inverse_mass_j
    return jnp.where(contacts.used, bound, 1)


def solve(
    contacts: Contacts,
    grains: int,
    shear_rate: float | Array,
    tolerance: float | Array,
    max_iterations: int | Array,
    method: Solver,
    active: Array,
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
    if b.size == 1:
        return _single_contact(b, jnp.where(contacts.used, diagonal, 1), active)
    relaxation = JACOBI_RELAXATION if method == "jacobi" else 1.0
    bound = spectral_bound(contacts, grains)
    scale = jnp.sqrt(_dot(jnp.minimum(b, 0), jnp.minimum(b, 0)))
    target = tolerance * scale + 10 * jnp.finfo(b.dtype).eps * shear_rate

    def unfinished(now: _Iterate):
        return active & ~(now.residual <= target) & (now.iterations < max_iterations) & ~jnp.isnan(now.residual)

    def iterate(now: _Iterate) -> _Iterate:
        extrapolation = now.momentum / (now.momentum + 3)
        start, response = now.point + extrapolation * (now.point - now.previous)
        impulses = jnp.maximum(0, start - relaxation * (response + b) / bound)
        response = delassus_product(contacts, impulses, grains)
        error = jnp.minimum(diagonal * impulses, response + b)
        residual = jnp.sqrt(_dot(error, error))
        uphill = _dot(bound * (start - impulses), impulses - now.point[0]) > 0
        keep_momentum = (method == "nesterov") & ~uphill
        point = jnp.stack([impulses, response])
        better = ~(residual >= now.best_residual)
        new = _Iterate(
            point=point,
            previous=now.point,
            momentum=jnp.where(keep_momentum, now.momentum + 1, 0).astype(b.dtype),
            residual=residual,
            best=jnp.where(better, point, now.best),
            best_residual=jnp.where(better, residual, now.best_residual),
            iterations=now.iterations + 1,
        )
        return where_active(unfinished(now), new, now)

    zero = jnp.zeros((2, b.size), b.dtype)
    infinite = jnp.asarray(jnp.inf, b.dtype)
    start = _Iterate(zero, zero, jnp.zeros((), b.dtype), infinite, zero, infinite, jnp.int32(0))
    end = lax.while_loop(lambda now: any_replica(unfinished(now)), iterate, start)
    impulses, response = end.best

    def is_jammed():
        return (_dot(b, impulses) < 0) & (
            jnp.linalg.norm(response) < _JAMMED_RESPONSE * jnp.linalg.norm(diagonal * impulses)
        )

    capped = active & ~(end.residual <= target)
    jammed = lax.cond(any_replica(capped), is_jammed, lambda: jnp.bool_(False))
    status = jnp.where(capped, jnp.where(jammed, Status.infeasible, Status.iteration_limit), Status.ok)
    return Solution(
        impulses=impulses,
        response=response,
        residual=jnp.where(active, end.best_residual / jnp.maximum(scale, target), 0),
        iterations=end.iterations,
        status=jnp.where(active & jnp.isnan(end.residual), Status.nonfinite, status).astype(jnp.int32),
    )


def _single_contact(b: Float[Array, "1"], diagonal: Float[Array, "1"], active: Array) -> Solution:
    """The exact solution of a network of one contact, for which the iteration would need one product."""
    impulses = jnp.where(active, jnp.maximum(0, -b / diagonal), 0)
    status = jnp.where(jnp.isnan(impulses[0]), Status.nonfinite, Status.ok).astype(jnp.int32)
    return Solution(impulses, diagonal * impulses, jnp.zeros((), b.dtype), active.astype(jnp.int32), status)


def _dot(a: Float[Array, " contacts"], b: Float[Array, " contacts"]) -> Float[Array, ""]:
    return jnp.dot(a, b, precision=lax.Precision.HIGHEST)


class _Iterate(NamedTuple):
    point: Array  # (2, contacts): impulses and their response
    previous: Array
    momentum: Array
    residual: Array
    best: Array
    best_residual: Array
    iterations: Array
