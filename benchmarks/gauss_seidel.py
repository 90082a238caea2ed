"""Other ways to solve the contact problem, for comparison only: Gauss–Seidel sweeps, and the exact solution.

The problem is 0 ≤ p ⟂ W p + u⁻ ≥ 0 on a network of contacts, see ``jaxgran.contact.network`` and
``jaxgran.contact.solver``.
"""

from typing import NamedTuple

import numba
import numpy as np
from scipy.optimize import nnls

from jaxgran.contact.network import Contacts
from jaxgran.contact.solver import Solution
from jaxgran.model.status import Status


def gauss_seidel(contacts: Contacts, grains: int, tolerance: float, max_sweeps: int, shear_rate: float = 1) -> Solution:
    """Impulses by projected Gauss–Seidel sweeps over the contacts in their order, from zero impulses.

    The residual and the tolerance are those of ``jaxgran.contact.solver.solve``. The updates of a sweep estimate the
    residual for nothing; it is computed only when that estimate has met the tolerance, and then decides.

    Args:
      contacts: the network.
      grains: number of grains.
      tolerance: relative residual to reach.
      max_sweeps: cap of the sweeps.
      shear_rate: γ̇; sets the absolute floor of the residual.

    Returns:
      The solution, of NumPy arrays; ``iterations`` counts the sweeps, each of the cost of one product with W.
    """
    i, j, normals, _, approach, inverse_i, inverse_j, used = (np.asarray(values) for values in vars(contacts).values())
    kind, eps = normals.dtype.type, np.finfo(normals.dtype).eps
    scale = np.linalg.norm(np.minimum(approach, 0))
    target = kind(tolerance * scale + 10 * eps * shear_rate)
    count = int(np.sum(used))
    impulses, kicks = np.zeros_like(approach), np.zeros((grains, 2), normals.dtype)
    sweeps, residual = _sweep(
        i, j, normals, inverse_i, inverse_j, approach, impulses, kicks, count, target**2, max_sweeps
    )
    status = Status.ok if residual <= target else Status.iteration_limit
    status = status if np.isfinite(residual) else Status.nonfinite
    response = np.sum(normals * (kicks[i] - kicks[j]), axis=1)
    return Solution(impulses, response, residual / max(scale, target), np.int32(sweeps), np.int32(status))


@numba.njit(cache=True, error_model="numpy")
def _sweep(i, j, normals, inverse_i, inverse_j, approach, impulses, kicks, count, target, max_sweeps):
    """Sweeps until the square of the residual meets ``target``; impulses and velocity changes are updated in place.

    Returns:
      The sweeps done and the residual.
    """
    zero = approach.dtype.type(0)
    for sweep in range(max_sweeps):
        last = sweep == max_sweeps - 1
        seen = zero
        for c in range(count):
            a, b = i[c], j[c]
            nx, ny = normals[c, 0], normals[c, 1]
            own = inverse_i[c] + inverse_j[c]
            after = nx * (kicks[a, 0] - kicks[b, 0]) + ny * (kicks[a, 1] - kicks[b, 1]) + approach[c]
            change = max(-after / own, -impulses[c])
            impulses[c] += change
            kicks[a, 0] += change * inverse_i[c] * nx
            kicks[a, 1] += change * inverse_i[c] * ny
            kicks[b, 0] -= change * inverse_j[c] * nx
            kicks[b, 1] -= change * inverse_j[c] * ny
            seen += (own * change) ** 2
        if seen <= target or last or not np.isfinite(seen):
            true = zero
            for c in range(count):
                a, b = i[c], j[c]
                own = inverse_i[c] + inverse_j[c]
                after = (
                    normals[c, 0] * (kicks[a, 0] - kicks[b, 0])
                    + normals[c, 1] * (kicks[a, 1] - kicks[b, 1])
                    + approach[c]
                )
                true += min(own * impulses[c], after) ** 2
            if not true > target or last:
                break
    return sweep + 1, np.sqrt(true)


class Exact(NamedTuple):
    """Exact solution of a network.

    ==========  ===========  ====  =============================================================
    field       shape        unit  meaning
    ==========  ===========  ====  =============================================================
    impulses    (contacts,)  mσγ̇   impulses p₀ at restitution zero; zero where there are none
    changes     (grains, 2)  σγ̇    velocity changes M⁻¹ Hᵀ p₀, which are unique
    residual    number       –     ‖min(diag(W) p, W p + u⁻)‖ over ‖min(u⁻, 0)‖
    feasible    flag         –     False where no velocities satisfy all contacts
    ==========  ===========  ====  =============================================================
    """

    impulses: np.ndarray
    changes: np.ndarray
    residual: float
    feasible: bool


def exact(contacts: Contacts, masses: np.ndarray) -> Exact:
    """The exact solution from a dense active-set method.

    The velocity changes are the shortest vector x, in the norm of the kinetic energy, that satisfies G x ≥ −u⁻ with
    G = H M^-½. Lawson and Hanson (Solving Least Squares Problems, 1974, chapter 23) turn this into non-negative least
    squares, min ‖E q − e‖ with the columns (G_c, −u⁻_c) in E and e = (0, …, 0, 1); where the residual is zero, there is
    no such x, else p = q / (1 + u⁻·q). The set of pushing contacts is exact; Newton steps on it remove the rounding.
    """
    used = np.asarray(contacts.used)
    roots = np.repeat(np.sqrt(masses), 2)
    incidence = _incidence(contacts, len(masses))[used] / roots
    moved = np.any(incidence != 0, axis=0)
    g, approach = incidence[:, moved], np.asarray(contacts.approach)[used]
    scale = np.linalg.norm(np.minimum(approach, 0))
    operator = g @ g.T
    own = np.diag(operator)
    h = approach / scale
    unit = np.concatenate([np.zeros(g.shape[1]), [1.0]])
    q, left = nnls(np.concatenate([g.T, -h[None]]), unit, maxiter=100 * len(h))
    feasible = left > 1e-9
    p = scale * q / left**2 if feasible else np.zeros_like(q)

    def error(p):
        return np.linalg.norm(np.minimum(own * p, operator @ p + approach))

    for _ in range(5 if feasible else 0):
        push = p > 0
        better = p.copy()
        better[push] -= np.linalg.lstsq(operator[np.ix_(push, push)], (operator @ p + approach)[push])[0]
        if not error(np.maximum(better, 0)) < error(p):
            break
        p = np.maximum(better, 0)
    impulses, changes = np.zeros(len(used)), np.zeros(2 * len(masses))
    impulses[used], changes[moved] = p, g.T @ p / roots[moved]
    return Exact(impulses, changes.reshape(-1, 2), error(p) / scale, feasible)


def _incidence(contacts: Contacts, grains: int) -> np.ndarray:
    """H (contacts, 2 grains): relative normal velocities are H v."""
    rows, normals = np.arange(contacts.used.size), np.asarray(contacts.normals)
    matrix = np.zeros((len(rows), grains, 2))
    matrix[rows, np.asarray(contacts.i)] += normals
    matrix[rows, np.asarray(contacts.j)] -= normals
    return matrix.reshape(len(rows), 2 * grains)
