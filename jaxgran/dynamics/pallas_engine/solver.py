"""Impulses of the contacts of one step within a thread block, and what they add to the sums.

The problem and its solution are those of ``contact.solver``. A thread adds up the impulses of its contacts, which
change the grain's velocity. When all threads have exchanged these changes, a product with W is done. Each contact is
there twice, once for each of its grains, so sums over the block are halved.

Isolated pairs have a closed form. What is left, contacts of grains that touch several or whose partner does, goes
through the default of ``contact.projected_methods`` together.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from jaxgran.contact.law import (
    JAMMED_RESPONSE,
    LONGEST_STRIDE,
    PROGRESS,
    WINDOW,
    contact_terms,
    largest_eigenvalue,
    relative_residual,
    residual_target,
)
from jaxgran.dynamics.pallas_engine.memory import (
    APPROACH,
    BEST,
    BOUND,
    CHANGE,
    DISTANCE,
    DV_X,
    DV_Y,
    IMPULSE,
    INVERSE_MASS,
    LOADED,
    NX,
    NY,
    RADIUS,
    RESIDUALS,
    RESPONSE,
    STEP,
    TOUCHING,
    WIDTH,
    Counts,
    Motion,
    Thread,
    status_if,
)
from jaxgran.model.status import Status


class Solve(NamedTuple):
    """Outcome of a contact solve: iterations, squared residual, status."""

    iterations: Array
    squared: Array
    status: Array


class _Contact(NamedTuple):
    """One contact of each thread; all zero where there is none."""

    real: Array
    other: Array
    nx: Array
    ny: Array
    approach: Array
    mobility: Array  # 1/m of both grains together


def _contact(thread: Thread, m: Array, contacts: Array) -> _Contact:
    """The m-th contact of each thread, of as many as there are."""
    real = m < contacts
    nx, ny, approach = _read(thread, m, real, NX, NY, APPROACH)
    other = thread.read(thread.block.partners, m, mask=real)
    inverse_mass = thread.gather(thread.block.given, INVERSE_MASS, other, real)
    return _Contact(real, other, nx, ny, approach, thread.inverse_mass + inverse_mass)


def _read(thread: Thread, m: Array, real: Array, *rows: int) -> list[Array]:
    """Rows of the m-th contact of each thread."""
    return [thread.read(thread.block.network, row, m, mask=real) for row in rows]


def _write(thread: Thread, m: Array, mask: Array, values: dict[int, Array]) -> None:
    for row, value in values.items():
        thread.write(thread.block.network, row, m, value=value, mask=mask)


def _response(thread: Thread, contact: _Contact, x: Array, y: Array) -> Array:
    """Change of a contact's relative normal velocity, where x and y are those of this grain's velocity."""
    shared = thread.block.shared
    along = contact.nx * (x - thread.gather(shared, DV_X, contact.other, contact.real))
    return along + contact.ny * (y - thread.gather(shared, DV_Y, contact.other, contact.real))


def collided(
    thread: Thread, motion: Motion, contacts: Array, scale: Array, deepest: Array, counts: Counts
) -> tuple[Motion, Counts, Array]:
    """Motion after the impulses of the contacts of one step, counts with them, and the status.

    Args:
      contacts: (threads,) numbers of contacts, of which the network holds normal, approach, distance and partner.
      scale: Σ min(0, u⁻)² over the contacts.
      deepest: the deepest overlap.
    """
    flow, block = thread.flow, thread.block
    one_plus_alpha = 1 + flow.restitution
    target = residual_target(jnp.sqrt(scale), flow.tolerance, flow.shear_rate, flow.epsilon)
    thread.publish([TOUCHING], [contacts])
    most, zero = jnp.max(contacts), jnp.zeros_like(motion.x)

    def isolate(m: Array, shape: tuple[Array, ...]) -> tuple[Array, ...]:
        """Write the impulses of isolated pairs, and add up n ⊗ n of the others."""
        contact = _contact(thread, m, contacts)
        alone = (contacts == 1) & (thread.gather(block.counts, TOUCHING, contact.other, contact.real) == 1)
        impulse = jnp.maximum(0, -contact.approach) / jnp.where(contact.real, contact.mobility, 1)
        _write(thread, m, contact.real, {IMPULSE: jnp.where(alone, impulse, 0)})
        nx, ny = contact.nx, contact.ny
        return tuple(a + jnp.where(alone, 0, b) for a, b in zip(shape, (nx * nx, nx * ny, ny * ny), strict=True))

    xx, xy, yy = lax.fori_loop(0, most, isolate, (zero,) * 3)
    coupled = jnp.where(xx + yy > 0, contacts, 0)
    width = largest_eigenvalue(xx, xy, yy) * thread.inverse_mass
    most_coupled = jnp.max(coupled)
    solve = lax.cond(
        most_coupled > 0,
        lambda: _descend(thread, coupled, most_coupled, width, target * target),
        lambda: Solve(flow.ok + 1, 0 * target, flow.ok),
    )

    def pull(m: Array, total: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        x, y, loaded = total
        nx, ny, impulse = _read(thread, m, m < contacts, NX, NY, IMPULSE)
        return x + impulse * nx, y + impulse * ny, loaded + (impulse > 0).astype(jnp.int32)

    x, y, loaded = lax.fori_loop(0, most, pull, (zero, zero, jnp.zeros_like(contacts)))
    x, y = x * thread.inverse_mass, y * thread.inverse_mass
    x, y, loaded = thread.publish((DV_X, DV_Y, LOADED), (x, y, loaded))

    def tally(m: Array, ok: Array) -> Array:
        """Add a contact to the sums."""
        contact = _contact(thread, m, contacts)
        nx, ny, approach = contact.nx, contact.ny, contact.approach
        distance, impulse = _read(thread, m, contact.real, DISTANCE, IMPULSE)
        half_change = one_plus_alpha / 2 * _response(thread, contact, x, y)
        push, approaches = one_plus_alpha * impulse, contact.real & (approach < 0)
        single = jnp.where(approaches, -one_plus_alpha * approach / jnp.where(contact.real, contact.mobility, 1), 0)
        clustered = (loaded > 1) | (thread.gather(block.counts, LOADED, contact.other, contact.real) > 1)
        reach = thread.radius + thread.gather(block.given, RADIUS, contact.other, contact.real)
        overlap = jnp.where(contact.real, jnp.maximum(reach - distance, 0), 0)
        flags = (flag.astype(nx.dtype) for flag in (contact.real, push > 0, approaches))
        terms = contact_terms(
            nx,
            ny,
            distance,
            overlap,
            approach,
            half_change,
            one_plus_alpha,
            push,
            single,
            jnp.where(clustered, push, 0),
            *flags,
        )
        thread.add(0, terms)
        return ok

    lax.fori_loop(0, most, tally, flow.ok)
    residual = relative_residual(jnp.sqrt(solve.squared), jnp.sqrt(scale), target)
    mine = (residual > block.bins[0, :]) & (residual <= block.bins[1, :])
    thread.add(RESIDUALS, [mine.astype(zero.dtype)])
    counts = counts._replace(
        networks=counts.networks + 1,
        iterations=counts.iterations + solve.iterations.astype(target.dtype),
        unconverged=counts.unconverged + (solve.status > int(Status.ok)).astype(target.dtype),
        overlap=jnp.maximum(counts.overlap, deepest),
        residual=jnp.maximum(counts.residual, residual),
    )
    kicked = motion._replace(cx=motion.cx + one_plus_alpha * x, cy=motion.cy + one_plus_alpha * y)
    return kicked, counts, solve.status


class _Descent(NamedTuple):
    """Where the solve stands, as in ``contact.projected_methods``; residuals are squared."""

    iterations: Array
    stride: Array
    momentum: Array  # negative as long as the method is not Nesterov's
    judged: Array  # best residual when progress was last judged
    best: Array
    residual: Array
    improved: Array  # whether the last iterate is the best one


def _descend(thread: Thread, contacts: Array, most: Array, width: Array, target: Array) -> Solve:
    """Write the impulses p₀ of the contacts of clusters, by the guarded method of Barzilai and Borwein.

    Args:
      contacts, most: (threads,) their numbers, and the largest.
      width: (threads,) what each grain adds to the spectral bound of its contacts, λ/m.
      target: the squared residual to reach.
    """
    shared, flow = thread.block.shared, thread.flow
    (width,) = thread.publish([WIDTH], [width])

    def prepare(m: Array, ok: Array) -> Array:
        contact = _contact(thread, m, contacts)
        bound = width + thread.gather(shared, WIDTH, contact.other, contact.real)
        start = {row: jnp.zeros_like(bound) for row in (IMPULSE, RESPONSE, STEP, CHANGE, BEST)}
        _write(thread, m, contact.real, {BOUND: bound, **start})
        return ok

    lax.fori_loop(0, most, prepare, flow.ok)

    def iterate(now: _Descent) -> _Descent:
        momentum = jnp.maximum(now.momentum, 0)
        push, zero = momentum / (momentum + 3), jnp.zeros_like(width)

        def move(m: Array, total: tuple[Array, ...]) -> tuple[Array, ...]:
            """Take a projected step; keep the iterate before it if it is the best."""
            x, y, descent = total
            real = m < contacts
            nx, ny, approach, old = _read(thread, m, real, NX, NY, APPROACH, IMPULSE)
            response, step, change, bound = _read(thread, m, real, RESPONSE, STEP, CHANGE, BOUND)
            at = old + push * step
            slope = response + push * change + approach
            new = jnp.maximum(0, at - now.stride * slope / jnp.where(real, bound, 1))
            _write(thread, m, real & (now.improved > 0), {BEST: old})
            _write(thread, m, real, {STEP: new - old, IMPULSE: new})
            return x + new * nx, y + new * ny, descent + (at - new) * (new - old) * bound

        x, y, descent = lax.fori_loop(0, most, move, (zero,) * 3)
        x, y = x * thread.inverse_mass, y * thread.inverse_mass
        x, y = thread.publish((DV_X, DV_Y), (x, y))
        even = now.iterations % 2 == 0

        def feel(m: Array, total: tuple[Array, ...]) -> tuple[Array, ...]:
            """Products with W, the squared residual, and the curvature along the step."""
            contact = _contact(thread, m, contacts)
            impulse, last, step, bound = _read(thread, m, contact.real, IMPULSE, RESPONSE, STEP, BOUND)
            response = _response(thread, contact, x, y)
            error = jnp.minimum(contact.mobility * impulse, response + contact.approach)
            change = response - last
            _write(thread, m, contact.real, {RESPONSE: response, CHANGE: change})
            over = step * jnp.where(even, change, step * bound)
            under = change * jnp.where(even, change / jnp.where(contact.real, bound, 1), step)
            new = (jnp.where(contact.real, x, 0) for x in (error * error, over, under))
            return tuple(a + b for a, b in zip(total, new, strict=True))

        squared, over, under = lax.fori_loop(0, most, feel, (zero,) * 3)
        residual = jnp.sum(squared) / 2
        best, judging = jnp.where(residual < now.best, residual, now.best), now.iterations % WINDOW == WINDOW - 1
        guarded = (now.momentum >= 0) | (judging & ~(best < PROGRESS * PROGRESS * now.judged))
        over, under = jnp.sum(jnp.where(guarded, descent, over)), jnp.sum(under)
        stride = jnp.where(under > 0, over / jnp.where(under > 0, under, 1), LONGEST_STRIDE)
        momentum = jnp.where(over > 0, 0, jnp.maximum(now.momentum, -1) + 1)
        return _Descent(
            iterations=now.iterations + 1,
            stride=jnp.where(guarded, 1, jnp.minimum(stride, LONGEST_STRIDE)),
            momentum=jnp.where(guarded, momentum, -1),
            judged=jnp.where(judging, best, now.judged),
            best=best,
            residual=residual,
            improved=(residual < now.best).astype(jnp.int32),
        )

    def unfinished(now: _Descent) -> Array:
        going = ~(now.residual <= target) & (now.residual < jnp.inf) & (now.iterations < flow.max_steps)
        return going | (now.iterations == 0)

    infinite, one = jnp.full_like(target, jnp.inf), jnp.full_like(target, 1)
    start = _Descent(jnp.int32(0), one, 0 * target - 1, infinite, infinite, infinite, jnp.int32(0))
    end = lax.while_loop(unfinished, iterate, start)

    def settle(m: Array, total: tuple[Array, Array]) -> tuple[Array, Array]:
        """Go back to the best iterate; add up pᵀWp and −pᵀu⁻ of the last, as those of the best may still be small."""
        moved, felt = total
        real = m < contacts
        last, response, approach, best = _read(thread, m, real, IMPULSE, RESPONSE, APPROACH, BEST)
        _write(thread, m, real & (end.improved == 0), {IMPULSE: best})
        return moved + last * response, felt - last * approach

    moved, felt = lax.fori_loop(0, most, settle, (jnp.zeros_like(width),) * 2)
    jammed, missed = jnp.sum(moved) < JAMMED_RESPONSE * jnp.sum(felt), ~(end.residual <= target)
    status = jnp.maximum(status_if(missed, Status.iteration_limit), status_if(missed & jammed, Status.infeasible))
    return Solve(end.iterations, end.best, jnp.maximum(status, status_if(~(end.best < jnp.inf), Status.nonfinite)))
