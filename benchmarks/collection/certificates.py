"""Solutions of contact problems in extended precision, and certificates that anyone can check.

The problem is 0 ≤ J ⟂ w = W J + u⁻ ≥ 0. What is certified are the numbers that stand in the file:
normals, masses and u⁻ as the doubles that they are, and impulses as sums of two doubles. w of these
is computed in fixed-point numbers of ``BITS`` binary places, by integers of Python, so a
certificate depends on no processor. Errors of it are below 10⁻⁹⁰.

An approximate solution, of any origin, tells which contacts press: A = {W_cc J > w}. On these W_AA
J = −u⁻_A is solved by iterative refinement (Wilkinson, Rounding Errors in Algebraic Processes,
1963): sparse factors in double precision give the corrections, and residuals in fixed point say
what is left. A is read again after each. Where more contacts press than have independent normals,
impulses are not unique, and rounding of the data decides which contacts carry them. Refinement then
begins at the centre of all solutions and ends near the rounding of doubles; the certificate says
so.
"""

from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array, csc_array, diags_array, eye_array
from scipy.sparse.linalg import splu

from benchmarks.exact_contacts import balanced, interior_point

BITS = 320  # binary places of a fixed-point number
TARGET = 1e-30  # natural residual, relative to ‖min(u⁻, 0)‖, at which a refinement ends
# of the diagonal, which keeps a singular matrix regular; refinement takes its effect back
_SHIFT = 1e-12
_REFINEMENTS, _PATIENCE = 60, 8  # at most, and how many of them may gain nothing
Fixed = np.ndarray  # of Python's integers, in units of 2^-BITS


class Problem(NamedTuple):
    """A network of contacts between grains that do not rotate, at restitution zero.

    ========  =============  ====  =========================================================
    field     shape          unit  meaning
    ========  =============  ====  =========================================================
    ends      (contacts, 2)  –     numbers i and j of the two grains
    normals   (contacts, 2)  –     unit vectors n from grain j to grain i
    masses    (grains,)      m     masses of the grains
    approach  (contacts,)    σγ̇    relative normal velocity u⁻ before, negative if approaching
    ========  =============  ====  =========================================================
    """

    ends: np.ndarray
    normals: np.ndarray
    masses: np.ndarray
    approach: np.ndarray


class Solved(NamedTuple):
    """Impulses as the sum of two arrays of doubles, the velocities w after, and the certificate:
    see ``certificate``.

    Without a solution, ``impulses`` are the weights q of ``obstacle`` and ``velocities`` are empty.
    """

    feasible: bool
    impulses: np.ndarray
    impulses_low: np.ndarray
    velocities: np.ndarray
    certificate: dict[str, float]


def incidence(problem: Problem) -> csc_array:
    """H (contacts, 2 grains): relative normal velocities are H v with v by grain, x before y."""
    count, (i, j) = len(problem.approach), problem.ends.T
    rows, (nx, ny) = np.arange(count), problem.normals.T
    columns = np.concatenate([2 * i, 2 * i + 1, 2 * j, 2 * j + 1])
    return coo_array(
        (np.concatenate([nx, ny, -nx, -ny]), (np.tile(rows, 4), columns)),
        shape=(count, 2 * len(problem.masses)),
    ).tocsc()


def delassus(problem: Problem) -> csc_array:
    """W = H M⁻¹ Hᵀ in double precision."""
    h = incidence(problem)
    return (h @ diags_array(np.repeat(1 / problem.masses, 2)) @ h.T).tocsc()


def solved(problem: Problem, guess: np.ndarray) -> Solved:
    """The solution near a guess, refined as far as the data allow, with its certificate."""
    matrix, scale = delassus(problem), np.linalg.norm(np.minimum(problem.approach, 0))
    own, exact = matrix.diagonal(), _Exact(problem)
    impulses = fixed(guess)
    best, least, waited, pressing, factor = impulses, np.inf, 0, None, None
    for _ in range(_REFINEMENTS):
        after, push = rounded(exact.after(impulses)), own * rounded(impulses)
        residual = np.linalg.norm(np.minimum(push, after)) / scale
        waited = 0 if residual < least / 2 else waited + 1
        if residual < least:
            best, least = impulses, residual
        if least <= TARGET or waited > _PATIENCE:
            break
        if pressing is None or np.any(pressing != (push > after)):
            pressing = push > after
            inner = matrix[pressing][:, pressing]
            factor = (
                splu((inner + _SHIFT * diags_array(inner.diagonal())).tocsc())
                if np.any(pressing)
                else None
            )
        impulses = np.where(pressing, impulses, 0)
        if factor is not None:
            impulses[pressing] -= fixed(factor.solve(after[pressing]))
    high = rounded(np.maximum(best, 0))
    low = rounded(np.maximum(best, 0) - fixed(high))
    total = fixed(high) + fixed(low)
    return Solved(True, high, low, rounded(exact.after(total)), certificate(problem, high, low))


def certificate(
    problem: Problem, impulses: np.ndarray, impulses_low: np.ndarray
) -> dict[str, float]:
    """How far impulses are from a solution, in fixed point; all are zero at one.

    ===============  ===============================================================
    natural_map      ‖min(W_cc J, w)‖ / v
    complementarity  largest |J w| of a contact / E
    energy           |J·w| / E
    approach         largest speed −w at which a contact still approaches / v
    tension          largest speed −W_cc J of an impulse that pulls / v
    ===============  ===============================================================

    v = ‖min(u⁻, 0)‖ and E = Σ min(u⁻, 0)²/W_cc are what stops every contact by itself.
    """
    impulses_fixed = fixed(impulses) + fixed(impulses_low)
    after_fixed = _Exact(problem).after(impulses_fixed)
    own = delassus(problem).diagonal()
    push, after = own * rounded(impulses_fixed), rounded(after_fixed)
    stopped = np.minimum(problem.approach, 0)
    speed, energy = np.linalg.norm(stopped), np.sum(stopped**2 / own)
    work = rounded((impulses_fixed * after_fixed) >> BITS)
    total = float(rounded(np.array([np.sum((impulses_fixed * after_fixed) >> BITS)], object))[0])
    return {
        "natural_map": float(np.linalg.norm(np.minimum(push, after)) / speed),
        "complementarity": float(np.max(np.abs(work)) / energy),
        "energy": float(abs(total) / energy),
        "approach": float(max(0.0, -np.min(after)) / speed),
        "tension": float(max(0.0, -np.min(push)) / speed),
    }


class Centre(NamedTuple):
    """Multipliers q of an interior-point method, see ``exact_contacts``: impulses are unit · q /
    left / lengths.
    """

    rows: np.ndarray  # of G = H M^-½, of length one
    lengths: np.ndarray
    multipliers: np.ndarray
    impulses: np.ndarray | None  # None where left = 0: there is no solution


def centre(problem: Problem) -> Centre:
    """The solution in the middle of all, to some digits: where impulses are not unique, it leaves
    out no contact.
    """
    g = (incidence(problem) @ diags_array(np.repeat(problem.masses**-0.5, 2))).toarray()
    lengths = np.linalg.norm(g, axis=1)
    rows, rates = g / lengths[:, None], problem.approach / lengths
    unit = np.linalg.norm(np.minimum(rates, 0))
    q = np.maximum(interior_point(rows, rates / unit), 0)
    left = 1 + q @ rates / unit
    return Centre(rows, lengths, q, unit * q / left / lengths if left > 0 else None)


def obstructed(problem: Problem) -> Solved | None:
    """Weights q ≥ 0 with Hᵀ q = 0 and q·u⁻ < 0, refined: no velocities satisfy all contacts
    (Farkas). None without.
    """
    rows, lengths, multipliers, _ = centre(problem)
    weights = balanced(rows, multipliers) / lengths
    weights = weights / np.max(weights)
    held, exact, q = weights > 0, _Exact(problem), fixed(weights)
    g = incidence(problem)[held]
    normal = (g.T @ g).tocsc()
    factor = splu((normal + _SHIFT * eye_array(normal.shape[0])).tocsc())
    for _ in range(_PATIENCE):
        left = rounded(exact.momenta(q)).ravel()
        if np.linalg.norm(left) <= TARGET:
            break
        q[held] -= fixed(g @ factor.solve(left))
    high = rounded(q)
    low = rounded(q - fixed(high))
    bound = obstacle(problem, high, low)
    return Solved(False, high, low, np.zeros(0), {"obstacle": bound}) if bound < np.inf else None


def obstacle(problem: Problem, weights: np.ndarray, weights_low: np.ndarray) -> float:
    """‖M^-½ Hᵀ q‖ · x₁ / (−q·u⁻) in fixed point, infinite where q is no certificate.

    Velocity changes x, in the norm of the kinetic energy, that satisfy all contacts have x ≥
    −q·u⁻/‖M^-½ Hᵀ q‖. So they are longer than 1/obstacle times x₁ = (Σ min(u⁻, 0)²/W_cc)^½, which
    stops the contacts one by one.
    """
    q, exact = fixed(weights) + fixed(weights_low), _Exact(problem)
    gain = -float(rounded(np.array([np.sum((q * exact.approach) >> BITS)], object))[0])
    if np.any(q < 0) or not gain > 0:
        return np.inf
    left = rounded(exact.momenta(q)) / np.sqrt(problem.masses)[:, None]
    singly = np.sqrt(np.sum(np.minimum(problem.approach, 0) ** 2 / delassus(problem).diagonal()))
    return float(np.linalg.norm(left) * singly / gain)


def fixed(values: np.ndarray) -> Fixed:
    """Doubles as fixed-point numbers; exact for all that are multiples of 2^-BITS."""
    mantissas, exponents = np.frexp(values)
    whole, shifts = np.ldexp(mantissas, 53).astype(np.int64), exponents + (BITS - 53)
    pairs = zip(whole.ravel().tolist(), shifts.ravel().tolist(), strict=True)
    numbers = [m << s if s >= 0 else m >> -s for m, s in pairs]
    return np.array(numbers, dtype=object).reshape(np.shape(values))


def rounded(numbers: Fixed) -> np.ndarray:
    """Fixed-point numbers as the nearest doubles."""
    unit = 1 << BITS
    return np.array([x / unit for x in numbers.ravel().tolist()], float).reshape(numbers.shape)


class _Exact:
    """The products of a problem in fixed point."""

    def __init__(self, problem: Problem) -> None:
        self.ends, self.grains = problem.ends, len(problem.masses)
        self.normals, self.masses, self.approach = (fixed(x) for x in problem[1:])

    def momenta(self, impulses: Fixed) -> Fixed:
        """Hᵀ J, (grains, 2)."""
        along = (self.normals * impulses[:, None]) >> BITS
        total = np.zeros((self.grains, 2), object)
        np.add.at(total, self.ends[:, 0], along)
        np.subtract.at(total, self.ends[:, 1], along)
        return total

    def after(self, impulses: Fixed) -> Fixed:
        """w = H M⁻¹ Hᵀ J + u⁻, (contacts,)."""
        changes = (self.momenta(impulses) << BITS) // self.masses[:, None]
        i, j = self.ends.T
        return self.approach + (np.sum(self.normals * (changes[i] - changes[j]), axis=1) >> BITS)
