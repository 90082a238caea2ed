"""Model of one collision and its noise, fitted to many collisions at a trial restitution.

A collision of two frictionless discs changes their relative velocity u into u − (1 + α)(u·n) n. Its five unknowns are
the separation at contact, whose direction is n, the time of contact, and u. The observations are separations and
relative velocities in some frames before and after, with noise, and the contact distance given by the diameters, with
an error. χ² is minimised over the unknowns of all collisions at once, with its derivatives with respect to α.
"""

from functools import cached_property
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from jaxgran.inference.collisions import Candidates, Noise

UNKNOWNS = 5  # of a collision
_CHUNK = 256  # collisions fitted at once
_STEPS, _MORE_STEPS = 15, 10  # from the initial guess, and from the optimum at a nearby restitution


class Fitted(NamedTuple):
    """Fitted collisions at one restitution; each field is (collisions,), ``unknowns`` (collisions, 5).

    ``misfit``, ``gradient`` and ``curvature`` are the minimal χ² and half its first and second derivatives with respect
    to α. ``gap`` is the fitted contact distance minus that of the diameters, with its variance.
    """

    unknowns: np.ndarray
    misfit: np.ndarray
    gradient: np.ndarray
    curvature: np.ndarray
    normal_velocity: np.ndarray
    normal_error: np.ndarray
    gap: np.ndarray
    gap_variance: np.ndarray


class Collisions:
    """Candidate collisions and their noise, padded to whole chunks."""

    def __init__(self, pairs: Candidates, noise: Noise):
        self.pairs = pairs
        observed = pairs.before | pairs.after
        has_velocity = pairs.has_velocity & observed
        self.freedom = 2.0 * (has_velocity.sum(axis=1) + observed.sum(axis=1)) - UNKNOWNS
        count, rows = len(pairs.window), -(-len(pairs.window) // _CHUNK) * _CHUNK
        self.count, self.guess = count, _padded(pairs.guess, rows)
        root = np.sqrt(2)
        self.data = tuple(
            _padded(x, rows)
            for x in (
                pairs.time,
                pairs.separation,
                pairs.velocity,
                observed / (root * noise.position),
                has_velocity / (root * noise.velocity),
                pairs.after.astype(float),
                pairs.reach,
                np.full(count, noise.diameter),
            )
        )

    def fitted(self, restitution: float, unknowns: np.ndarray | None = None) -> Fitted:
        """Fit at a trial restitution, starting from the initial guess or from nearly optimal unknowns."""
        start = self.guess if unknowns is None else _padded(unknowns, len(self.guess))
        alpha, most = jnp.asarray(restitution), jnp.asarray(_STEPS if unknowns is None else _MORE_STEPS)
        chunks = [
            _best_unknowns(alpha, most, jnp.asarray(start[k * _CHUNK : (k + 1) * _CHUNK]), *data)
            for k, data in enumerate(self._chunks)
        ]
        best, misfit, products, gradient = (np.concatenate(x)[: self.count] for x in zip(*chunks, strict=True))
        inner, mixed = products[:, :UNKNOWNS, :UNKNOWNS], products[:, :UNKNOWNS, UNKNOWNS]
        covariance = np.linalg.pinv(inner, hermitian=True)
        curvature = products[:, UNKNOWNS, UNKNOWNS] - np.einsum("ci,cij,cj->c", mixed, covariance, mixed)
        contact, velocity = best[:, :2], best[:, 3:]
        distance = np.linalg.norm(contact, axis=1)
        approach = -np.sum(contact * velocity, axis=1) / distance
        across = (
            -(velocity + (approach / distance)[:, None] * contact) / distance[:, None]
        )  # derivative with respect to contact
        slope = np.concatenate([across, np.zeros((len(best), 1)), -contact / distance[:, None]], axis=1)
        error = np.sqrt(np.maximum(np.einsum("ci,cij,cj->c", slope, covariance, slope), 0))
        towards = contact / distance[:, None]
        spread = np.einsum("ci,cij,cj->c", towards, covariance[:, :2, :2], towards)
        gap = distance - self.data[-2][: self.count]
        return Fitted(best, misfit, gradient[:, UNKNOWNS], curvature, approach, error, gap, spread)

    @cached_property
    def _chunks(self) -> list[tuple[Array, ...]]:
        ends = range(0, len(self.guess), _CHUNK)
        return [tuple(jnp.asarray(x[k : k + _CHUNK]) for x in self.data) for k in ends]

    def part(self, chosen: np.ndarray) -> "Collisions":
        """A subset of the collisions."""
        part = object.__new__(Collisions)
        count = int(chosen.sum())
        rows = -(-count // _CHUNK) * _CHUNK
        part.pairs, part.freedom, part.count = None, self.freedom[chosen], count
        part.guess, *data = (_padded(x[: self.count][chosen], rows) for x in (self.guess, *self.data))
        part.data = tuple(data)
        return part


def _padded(x: np.ndarray, rows: int) -> np.ndarray:
    """Pad an array to a number of rows by repeating its last row."""
    return np.concatenate([x, np.repeat(x[-1:], rows - len(x), axis=0)])


def _residuals(
    unknowns: Array, restitution: Array, time, separation, velocity, wx, wv, after, reach, diameter
) -> Array:
    """Observations of a collision minus their model, over the noise."""
    contact, when, u = unknowns[:2], unknowns[2], unknowns[3:]
    distance = jnp.sqrt(contact @ contact)
    normal = contact / distance
    lost = (1 + restitution) * (u @ normal) * normal
    velocities = u[None] - jnp.outer(after, lost)
    positions = contact[None] + (time - when)[:, None] * u[None] - jnp.outer(jnp.maximum(time - when, 0), lost)
    return jnp.concatenate(
        [
            (wx[:, None] * (separation - positions)).ravel(),
            (wv[:, None] * (velocity - velocities)).ravel(),
            ((distance - reach) / diameter)[None],
        ]
    )


@jax.jit
def _best_unknowns(restitution: Array, steps: Array, start: Array, *data: Array):
    """Least squares over the five unknowns of every collision, by the Levenberg-Marquardt method.

    Returns the unknowns, χ², and the products JᵀJ and Jᵀr, with r the residuals and J their derivatives with respect to
    the unknowns and α.
    """

    def one(start, *data):
        def residuals(parameters):
            r = _residuals(parameters[:UNKNOWNS], parameters[UNKNOWNS], *data)
            return r, r

        def step(_, carry):
            unknowns, misfit, curvature, gradient, damping = carry
            inner = curvature[:UNKNOWNS, :UNKNOWNS]
            move = jnp.linalg.solve(inner + damping * jnp.diag(jnp.diag(inner)), gradient[:UNKNOWNS])
            moved = unknowns - move
            slopes, r = jax.jacfwd(residuals, has_aux=True)(jnp.append(moved, restitution))
            now = moved, r @ r, slopes.T @ slopes, slopes.T @ r
            better = now[1] <= misfit
            kept = jax.tree.map(lambda new, old: jnp.where(better, new, old), now, carry[:4])
            return *kept, jnp.clip(jnp.where(better, damping / 10, damping * 10), 1e-12, 1e12)

        size = UNKNOWNS + 1
        begin = start, jnp.inf, jnp.eye(size), jnp.zeros(size), jnp.asarray(1e-2)
        return lax.fori_loop(0, steps, step, begin)[:4]

    return jax.vmap(one)(start, *data)
