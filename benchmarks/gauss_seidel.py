"""Another way to solve the contact problem, for comparison only: Gauss–Seidel sweeps.

The problem is 0 ≤ J ⟂ W J + u⁻ ≥ 0 on a network of contacts, see ``jaxgran.contact.network`` and
``jaxgran.contact.solver``.
"""

import numba
import numpy as np

from jaxgran.contact.network import Contacts
from jaxgran.contact.solver import Solution
from jaxgran.model.status import Status


def gauss_seidel(
    contacts: Contacts,
    grains: int,
    tolerance: float,
    max_sweeps: int,
    shear_rate: float = 1,
) -> Solution:
    """Impulses by projected Gauss–Seidel sweeps over the contacts in their order.

    The residual and the tolerance are those of ``jaxgran.contact.solver.solve``. The updates of a
    sweep estimate the residual for nothing; it is computed only when that estimate has met the
    tolerance, and then decides.

    Args:
      contacts: the network.
      grains: number of grains.
      tolerance: relative residual to reach.
      max_sweeps: cap of the sweeps.
      shear_rate: γ̇; sets the absolute floor of the residual.

    Returns:
      The solution, of NumPy arrays; ``iterations`` counts the sweeps, each of the cost of one
      product with W.
    """
    i, j, normals, _, approach, inverse_i, inverse_j, used = (
        np.asarray(values) for values in vars(contacts).values()
    )
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
    return Solution(
        impulses, response, residual / max(scale, target), np.int32(sweeps), np.int32(status)
    )


@numba.njit(cache=True, error_model="numpy")
def _sweep(
    i, j, normals, inverse_i, inverse_j, approach, impulses, kicks, count, target, max_sweeps
):
    """Sweeps until the square of the residual meets ``target``; impulses and velocity changes are
    updated in place.

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
            after = (
                nx * (kicks[a, 0] - kicks[b, 0]) + ny * (kicks[a, 1] - kicks[b, 1]) + approach[c]
            )
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
