"""Exact solutions of small contact problems, each with a certificate.

The problem is 0 ≤ J ⟂ w = W J + u⁻ ≥ 0 with W = G Gᵀ and G = H M^-½; W is often singular. The
method is not trusted: what it returns is polished and then checked in extended precision, and an
error is raised where the check fails. So an answer cannot be wrong in silence, whatever the
processor and its linear algebra.
"""

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from jaxgran.contact.network import Contacts

EPS = float(np.finfo(float).eps)
ROUNDINGS = 16  # of the largest term of w, that a residual may reach
RESIDUAL, ENERGY, OBSTACLE = 1e-11, 1e-10, 1e-12  # largest relative errors of what is certified
_POLISHING_STEPS, _INTERIOR_STEPS = 10, 100


def incidence(contacts: Contacts, grains: int) -> np.ndarray:
    """H (contacts, 2 grains): relative normal velocities are H v. Rows of unused slots are zero."""
    i, j, normals, used = (
        np.asarray(getattr(contacts, name)) for name in ("i", "j", "normals", "used")
    )
    matrix = np.zeros((len(i), grains, 2))
    rows = np.arange(len(i))
    np.add.at(matrix, (rows, i), normals)
    np.add.at(matrix, (rows, j), -normals)
    matrix[~used] = 0
    return matrix.reshape(len(i), 2 * grains)


def delassus(contacts: Contacts, masses: np.ndarray) -> np.ndarray:
    """W = H M⁻¹ Hᵀ as a dense matrix."""
    matrix = incidence(contacts, len(masses))
    return matrix / np.repeat(masses, 2) @ matrix.T


def weighted(contacts: Contacts, masses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """G and u⁻ of the contacts in use."""
    used = np.asarray(contacts.used)
    g = incidence(contacts, len(masses))[used] / np.repeat(np.sqrt(masses), 2)
    return g, np.asarray(contacts.approach)[used]


def exact_changes(contacts: Contacts, masses: np.ndarray) -> np.ndarray:
    """Velocity changes M⁻¹ Hᵀ J (grains, 2) at restitution zero, which are unique: the projection,
    in the norm of the kinetic energy, of the velocities on those that let no contact approach.
    """
    g, approach = weighted(contacts, masses)
    impulses = certified_impulses(g, approach)
    assert impulses is not None, "no impulses stop these contacts"
    return (impulses @ g).reshape(-1, 2) / np.sqrt(masses)[:, None]


def certified_impulses(g: np.ndarray, approach: np.ndarray) -> np.ndarray | None:
    """Impulses J with 0 ≤ J ⟂ G Gᵀ J + u⁻ ≥ 0, to rounding.

    The velocity changes are the shortest vector x that satisfies G x ≥ −u⁻. Lawson and Hanson
    (Solving Least Squares Problems, 1974, chapter 23) turn this into min ‖E q − e‖ over q ≥ 0 with
    the columns (G_c, −u⁻_c) in E and e = (0, …, 0, 1). With r = 1 + u⁻·q, the impulses are q / r;
    where r = 0, there is no such x.

    Args:
      g: (contacts, freedoms), G = H M^-½; no row may be zero.
      approach: (contacts,), u⁻.

    Returns:
      Impulses for which ``is_solution`` holds; None where there are none, as shown by
      ``is_obstacle``.

    Raises:
      ArithmeticError: neither was found.
    """
    if not np.any(approach < 0):
        return np.zeros(len(g))
    g = g[:, np.any(g != 0, axis=0)]  # without grains that have no contact
    lengths = np.linalg.norm(g, axis=1)
    rows, rates = g / lengths[:, None], approach / lengths
    unit = np.linalg.norm(np.minimum(rates, 0))
    q = np.maximum(_interior_point(rows, rates / unit), 0)
    remainder = 1 + q @ rates / unit
    if remainder > 0:
        impulses = _polished(g, approach, unit * q / remainder / lengths)
        if is_solution(g, approach, impulses):
            return impulses
    if is_obstacle(g, approach, _balanced(rows, q) / lengths):
        return None
    raise ArithmeticError(f"no certificate for {len(g)} contacts")


def _interior_point(g: np.ndarray, approach: np.ndarray) -> np.ndarray:
    """The multipliers q by a primal-dual interior-point method.

    Their conditions are 0 ≤ q ⟂ s = (G Gᵀ + u⁻u⁻ᵀ) q + u⁻ ≥ 0, a linear complementarity problem
    that always has a solution. Steps of a predictor and a corrector after Mehrotra; Wright
    (Primal-Dual Interior-Point Methods, 1997), chapters 8 and 10. Ends where q or s of each contact
    is at rounding, or where rounding stops the steps.
    """
    matrix = g @ g.T + np.outer(approach, approach)
    q, s = np.ones(len(g)), np.ones(len(g))
    for _ in range(_INTERIOR_STEPS):
        missing = matrix @ q + approach - s
        if max(np.max(np.minimum(q, s)), np.max(np.abs(missing))) < 4 * EPS:
            break
        try:
            factor = cho_factor(matrix + np.diag(s / q))
        except LinAlgError:
            break
        dq, ds = _newton_step(factor, q, s, missing, np.zeros_like(q))
        gap, after = q @ s / len(q), (q + _reach(q, dq) * dq) @ (s + _reach(s, ds) * ds) / len(q)
        dq, ds = _newton_step(factor, q, s, missing, (after / gap) ** 3 * gap - dq * ds)
        length = 0.995 * min(_reach(q, dq), _reach(s, ds))
        if not length > 1e-8:
            break
        q, s = q + length * dq, s + length * ds
    return q


def _newton_step(
    factor: tuple, q: np.ndarray, s: np.ndarray, missing: np.ndarray, target: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The step of q and s to q s = target and to no missing part of s."""
    change = cho_solve(factor, (target - q * s) / q - missing)
    return change, (target - q * s - s * change) / q


def _reach(values: np.ndarray, changes: np.ndarray) -> float:
    """The largest part of a step, at most one, that leaves all values positive."""
    falling = changes < 0
    return float(np.min(-values[falling] / changes[falling], initial=1.0))


def natural_residual(g: np.ndarray, approach: np.ndarray, impulses: np.ndarray) -> float:
    """‖min(diag(W) J, W J + u⁻)‖ over ‖min(u⁻, 0)‖, in extended precision."""
    least = np.minimum(np.sum(g**2, axis=1) * impulses, _after(g, approach, impulses))
    return float(np.linalg.norm(least) / np.linalg.norm(np.minimum(approach, 0)))


def is_solution(g: np.ndarray, approach: np.ndarray, impulses: np.ndarray) -> bool:
    """Whether impulses solve the contact problem to rounding: the certificate, in extended
    precision.

    No impulse may be negative, and three errors must be small:

    - max |min(diag(W) J, w)|, at most ``ROUNDINGS`` ε of the largest |G| |Gᵀ| J + |u⁻|, the terms
      that w is the sum of. As min(diag(W) J, w) ≤ w, no contact approaches faster than that after;
    - the natural residual, at most ``RESIDUAL``, as impulses that are huge and cancel hide an
      approach in rounding;
    - a bound of the kinetic energy of the error of the velocity changes, at most ``ENERGY`` of that
      of the changes. For exact J₀ and w₀, (J − J₀)ᵀ W (J − J₀) = (J − J₀)·(w − w₀) ≤ J·w − J₀·w ≤ Σ
      J |w| + Σ J₀ max(−w), where Σ J stands for the unknown Σ J₀.
    """
    if not (np.all(np.isfinite(impulses)) and np.all(impulses >= 0)):
        return False
    after = _after(g, approach, impulses)
    terms = np.abs(g) @ (impulses @ np.abs(g)) + np.abs(approach)
    least = np.minimum(np.sum(g**2, axis=1) * impulses, after)
    changes = impulses @ g
    error = impulses @ np.abs(after) + np.sum(impulses) * max(0.0, float(-np.min(after)))
    return bool(
        np.max(np.abs(least)) <= ROUNDINGS * EPS * np.max(terms)
        and natural_residual(g, approach, impulses) <= RESIDUAL
        and error <= ENERGY * (changes @ changes)
    )


def is_obstacle(g: np.ndarray, approach: np.ndarray, weights: np.ndarray) -> bool:
    """Whether weights q ≥ 0 show that no velocities satisfy all contacts (Farkas): Gᵀ q = 0 and
    q·u⁻ < 0, to rounding.

    Changes x with G x ≥ −u⁻ have (Gᵀq)·x ≥ −q·u⁻, so ‖x‖ ≥ −q·u⁻ / ‖Gᵀq‖. Here that is more than 1
    / ``OBSTACLE`` times what stops the approach of the contacts one by one.
    """
    if not (np.all(np.isfinite(weights)) and np.all(weights >= 0)):
        return False
    singly = np.linalg.norm(np.minimum(approach, 0) / np.linalg.norm(g, axis=1))
    return bool(
        -weights @ approach * OBSTACLE > np.linalg.norm(weights @ g.astype(np.longdouble)) * singly
    )


def _after(g: np.ndarray, approach: np.ndarray, impulses: np.ndarray) -> np.ndarray:
    """w = G Gᵀ J + u⁻ in the longest numbers of NumPy, added without linear algebra."""
    wide = g.astype(np.longdouble)
    return wide @ (impulses.astype(np.longdouble) @ wide) + approach


def _polished(g: np.ndarray, approach: np.ndarray, impulses: np.ndarray) -> np.ndarray:
    """The best of the impulses and of those after Newton steps on the natural residual (Facchinei
    and Pang, Finite-Dimensional Variational Inequalities, 2003, chapter 9), whose right-hand side
    is in extended precision.
    """
    diagonal = np.sum(g**2, axis=1)
    best, least = impulses, natural_residual(g, approach, impulses)
    for _ in range(_POLISHING_STEPS):
        after = _after(g, approach, impulses)
        pressing = diagonal * impulses > after
        left, lengths, _ = np.linalg.svd(g[pressing], full_matrices=False)
        kept = lengths > 1e-10 * np.max(lengths, initial=0)
        left = left[:, kept]
        step = left @ ((left.T @ after[pressing].astype(float)) / lengths[kept] ** 2)
        changed = np.zeros_like(impulses)
        changed[pressing] = impulses[pressing] - step
        impulses = changed
        residual = natural_residual(g, approach, np.maximum(impulses, 0))
        if residual < least:
            best, least = np.maximum(impulses, 0), residual
        elif least <= RESIDUAL:
            break
    return best


def _balanced(rows: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """The nearest weights on the same contacts with Gᵀ q = 0, none negative."""
    held = weights > 1e-8 * np.max(weights)
    result = np.where(held, weights, 0)
    for _ in range(2):
        result[held] -= np.linalg.lstsq(rows[held].T, result[held] @ rows[held])[0]
    return np.maximum(result, 0)
