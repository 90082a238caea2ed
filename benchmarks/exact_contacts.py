"""Exact solutions of the contact problem, each with a certificate: the reference of tests and
benchmarks.

The problem is 0 ≤ J ⟂ w = W J + u⁻ ≥ 0 with W = G Gᵀ and G = H M^-½; see ``jaxgran.solver``. W is
often singular. No method is trusted. Whatever a method returns is polished and then checked in
extended precision; where the check fails, the next method is tried, and where all fail, an error is
raised. So an answer cannot be wrong in silence, whatever the processor and its linear algebra.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from scipy.optimize import nnls

from jaxgran.contact.network import Contacts

EPS = float(np.finfo(float).eps)
# Of the largest term of w, that a residual may reach; the collection needs less than one.
ROUNDINGS = 16
RESIDUAL, ENERGY, OBSTACLE = 1e-11, 1e-10, 1e-12  # largest relative errors of what is certified
_POLISHING_STEPS, _INTERIOR_STEPS = 10, 100
Method = Callable[[np.ndarray, np.ndarray], np.ndarray]


class Exact(NamedTuple):
    """Exact solution of a network.

    ==========  ===========  ====  =============================================================
    field       shape        unit  meaning
    ==========  ===========  ====  =============================================================
    impulses    (contacts,)  mσγ̇   impulses J₀ at restitution zero; zero where there are none
    changes     (grains, 2)  σγ̇    velocity changes M⁻¹ Hᵀ J₀, which are unique
    residual    number       –     ‖min(diag(W) J, W J + u⁻)‖ over ‖min(u⁻, 0)‖
    feasible    flag         –     False where no velocities satisfy all contacts
    ==========  ===========  ====  =============================================================
    """

    impulses: np.ndarray
    changes: np.ndarray
    residual: float
    feasible: bool


def exact(contacts: Contacts, masses: np.ndarray) -> Exact:
    """The exact solution of a network.

    Args:
      contacts: the network, in any padding.
      masses: (grains,) in m.

    Returns:
      The certified solution. Where there is none, zero impulses.

    Raises:
      ArithmeticError: no method gave an answer that passes its check.
    """
    used = np.asarray(contacts.used)
    roots = np.repeat(np.sqrt(masses), 2)
    g = incidence(contacts, len(masses))[used] / roots
    p = certified_impulses(g, np.asarray(contacts.approach)[used])
    feasible = p is not None
    p = np.zeros(len(g)) if p is None else p
    impulses = np.zeros(len(used))
    impulses[used] = p
    residual = natural_residual(g, np.asarray(contacts.approach)[used], p)
    return Exact(impulses, (g.T @ p / roots).reshape(-1, 2), residual, feasible)


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


def active_set(g: np.ndarray, approach: np.ndarray) -> np.ndarray:
    """Multipliers q ≥ 0 from SciPy's non-negative least squares; they can be wrong, as it can end
    early.

    The velocity changes are the shortest vector x that satisfies G x ≥ −u⁻. Lawson and Hanson
    (Solving Least Squares Problems, 1974, chapter 23) turn this into min ‖E q − e‖ over q ≥ 0 with
    the columns (G_c, −u⁻_c) in E and e = (0, …, 0, 1). With r = 1 + u⁻·q, the impulses are q / r;
    where r = 0, there is no such x.
    """
    unit = np.concatenate([np.zeros(g.shape[1]), [1.0]])
    return nnls(np.concatenate([g.T, -approach[None]]), unit, maxiter=100 * len(g))[0]


def interior_point(g: np.ndarray, approach: np.ndarray) -> np.ndarray:
    """The same multipliers from a primal-dual interior-point method, which never chooses a set of
    contacts.

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
        dq, ds = _step(factor, q, s, missing, np.zeros_like(q))
        gap, after = q @ s / len(q), (q + _reach(q, dq) * dq) @ (s + _reach(s, ds) * ds) / len(q)
        dq, ds = _step(factor, q, s, missing, (after / gap) ** 3 * gap - dq * ds)
        length = 0.995 * min(_reach(q, dq), _reach(s, ds))
        if not length > 1e-8:
            break
        q, s = q + length * dq, s + length * ds
    return q


def _step(
    factor: tuple, q: np.ndarray, s: np.ndarray, missing: np.ndarray, target: np.ndarray
) -> tuple:
    """The Newton step of q and s to q s = target and to no missing part of s."""
    change = cho_solve(factor, (target - q * s) / q - missing)
    return change, (target - q * s - s * change) / q


def _reach(values: np.ndarray, changes: np.ndarray) -> float:
    """The largest part of a step, at most one, that leaves all values positive."""
    falling = changes < 0
    return float(np.min(-values[falling] / changes[falling], initial=1.0))


METHODS: tuple[Method, ...] = (interior_point, active_set)


def certified_impulses(
    g: np.ndarray, approach: np.ndarray, methods: Sequence[Method] = METHODS
) -> np.ndarray | None:
    """Impulses J with 0 ≤ J ⟂ G Gᵀ J + u⁻ ≥ 0, to rounding.

    Args:
      g: (contacts, freedoms), G = H M^-½; no row may be zero.
      approach: (contacts,), u⁻.
      methods: tried in turn. Each returns multipliers q for contacts whose rows of G have the
        length 1 and whose u⁻ has the length 1 where it is negative; see ``active_set``.

    Returns:
      Impulses for which ``is_solution`` holds; None where there are none, as shown by
      ``is_obstacle``.

    Raises:
      ValueError: something is not finite, or a row is zero.
      ArithmeticError: no method gave either.
    """
    lengths = np.linalg.norm(g, axis=1)
    if not (np.all(np.isfinite(approach)) and np.all(np.isfinite(lengths)) and np.all(lengths > 0)):
        raise ValueError(
            "the contacts must have finite approach velocities and finite rows of G that are not "
            "zero"
        )
    if not np.any(approach < 0):
        return np.zeros(len(g))
    g = g[:, np.any(g != 0, axis=0)]  # without grains that have no contact
    rows, rates = g / lengths[:, None], approach / lengths
    unit = np.linalg.norm(np.minimum(rates, 0))
    for method in methods:
        try:
            q = np.maximum(method(rows, rates / unit), 0)
            left = 1 + q @ rates / unit
            if left > 0 and is_solution(
                g, approach, p := _polished(g, approach, unit * q / left / lengths)
            ):
                return p
            if is_obstacle(g, approach, balanced(rows, q) / lengths):
                return None
        except (LinAlgError, RuntimeError):  # a factorisation fails, or SciPy's iterations end
            continue
    raise ArithmeticError(
        f"no exact solution of {len(g)} contacts: none of {len(methods)} methods passed the check"
    )


def natural_residual(g: np.ndarray, approach: np.ndarray, impulses: np.ndarray) -> float:
    """‖min(diag(W) J, W J + u⁻)‖ over ‖min(u⁻, 0)‖, in extended precision; zero where nothing
    approaches or pushes.
    """
    least = np.minimum(np.sum(g**2, axis=1) * impulses, _after(g, approach, impulses))
    scale = np.linalg.norm(np.minimum(approach, 0))
    return float(np.linalg.norm(least) / scale) if scale > 0 else float(np.linalg.norm(least))


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
      J |w| + Σ J₀ max(−w), where Σ J stands for the unknown Σ J₀. Rounding of J alone makes it ε Σ
      J |w|, at a mass ratio of 10⁴ some 10⁻¹¹.
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
    """w = G Gᵀ J + u⁻ in the longest numbers that NumPy has; it adds them without the processor's
    linear algebra.
    """
    wide = g.astype(np.longdouble)
    return wide @ (impulses.astype(np.longdouble) @ wide) + approach


def _polished(g: np.ndarray, approach: np.ndarray, impulses: np.ndarray) -> np.ndarray:
    """The best of the impulses and of those after Newton steps on the natural residual (Facchinei
    and Pang, Finite-Dimensional Variational Inequalities, 2003, chapter 9), whose right-hand side
    is in extended precision."""
    own = np.sum(g**2, axis=1)
    best, least = impulses, natural_residual(g, approach, impulses)
    for _ in range(_POLISHING_STEPS):
        after = _after(g, approach, impulses)
        push = own * impulses > after
        left, lengths, _ = np.linalg.svd(g[push], full_matrices=False)
        kept = lengths > 1e-10 * np.max(lengths, initial=0)
        left = left[:, kept]
        better = np.zeros_like(impulses)
        better[push] = impulses[push] - left @ (
            (left.T @ after[push].astype(float)) / lengths[kept] ** 2
        )
        impulses = better
        residual = natural_residual(g, approach, np.maximum(impulses, 0))
        if residual < least:
            best, least = np.maximum(impulses, 0), residual
        elif least <= RESIDUAL:
            break
    return best


def balanced(rows: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """The nearest weights on the same contacts with Gᵀ q = 0, none negative."""
    held = weights > 1e-8 * np.max(weights)
    result = np.zeros_like(weights)
    result[held] = weights[held]
    for _ in range(2):
        result[held] -= np.linalg.lstsq(rows[held].T, result[held] @ rows[held])[0]
    return np.maximum(result, 0)
