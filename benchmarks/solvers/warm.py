"""Cold against warm: what a solver gains when it starts near the solution.

It starts from zero, from the exact impulses with relative errors of 10 %, 1 % and 0.1 % of each, or from the impulses
of the step before, contact by contact. The last is what a flow could give; the others show what a good guess would do.
The problems are networks of flows.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jaxgran as jg
from benchmarks import networks
from benchmarks.collection import Entry
from benchmarks.collection.certificates import Problem, Solved
from benchmarks.collection.compare import Answer, Solve
from benchmarks.collection.make import padded
from benchmarks.collection.problems import compact
from benchmarks.gauss_seidel import gauss_seidel
from benchmarks.solvers.measure import natural_residual
from benchmarks.timing import timed
from jaxgran.contact.network import Contacts
from jaxgran.contact.problem import as_contacts
from jaxgran.dynamics.collision import contacts_now

TOLERANCE = 1e-4
ERRORS = (0.1, 0.01, 0.001)
STEPS = ((0.5, 0.7, 1e-3), (0.1, 0.8, 1e-4), (0.5, 0.8, 1e-4), (0.9, 0.82, 1e-3), (0.5, 0.82, 1e-4))
_GRAINS, _STRAIN, _BETWEEN, _FEWEST = 256, 1.0, 0.02, 10  # grains, strains, contacts
_MOST_SWEEPS = 20_000
Startable = Callable[[Entry, float, np.ndarray | None], Solve]


class WarmRow(NamedTuple):
    """A solve from a start: cold, exact but for an error, or the step before; not a number where it failed."""

    solver: str
    problem: str
    start: str
    distance: float
    seconds: float
    iterations: float


def startable() -> dict[str, Startable]:
    """Solvers that take a start; ours and the interior-point methods take none."""
    from benchmarks.solvers import pinocchio, quadratic

    return {
        "Gauss–Seidel": swept_from,
        "Pinocchio PGS": pinocchio.gauss_seidel,
        "Pinocchio ADMM": pinocchio.multipliers,
        "OSQP": quadratic.osqp,
    }


def swept_from(entry: Entry, tolerance: float, start: np.ndarray | None = None) -> Solve:
    """Gauss–Seidel sweeps from given impulses."""
    contacts = jax.tree.map(np.asarray, as_contacts(jg.ContactNetwork(*map(jnp.asarray, entry.problem))))

    def solve() -> Answer:
        solution = gauss_seidel(contacts, len(entry.problem.masses), tolerance, _MOST_SWEEPS, start=start)
        return Answer(solution.impulses, int(solution.iterations))

    return solve


def compared(entries: Sequence[Entry], quick: bool) -> list[WarmRow]:
    """All starts of all solvers that take one."""
    rows, solvers = [], startable()
    flows = [one for one in entries if one.family == "flow" and len(one.problem.approach) >= _FEWEST]
    noise = np.random.default_rng(0)
    cases = []
    for entry in flows[:: 12 if quick else 1]:
        exact = entry.solution.impulses
        starts = {f"exact to {error:g}": exact * (1 + error * noise.standard_normal(len(exact))) for error in ERRORS}
        cases.append((entry, {name: np.maximum(p, 0) for name, p in starts.items()}))
    for entry, before in following(STEPS[:1] if quick else STEPS, 1 if quick else 6):
        cases.append((entry, {"step before": before}))
    for entry, starts in cases:
        matrix = entry.matrix
        for name, solver in solvers.items():
            for label, start in {"cold": None, **starts}.items():
                seconds, answer = timed(solver(entry, TOLERANCE / 10, start))
                good = natural_residual(entry, matrix, answer.impulses) <= TOLERANCE
                costs = (seconds, float(answer.products)) if good else (np.nan, np.nan)
                rows.append(WarmRow(name, entry.name, label, distance(entry, start), *costs))
    return rows


def distance(entry: Entry, start: np.ndarray | None) -> float:
    """‖start − p‖ / ‖p‖."""
    exact = entry.solution.impulses
    return 1.0 if start is None else float(np.linalg.norm(start - exact) / np.linalg.norm(exact))


def following(points: Sequence[tuple], number: int) -> list[tuple[Entry, np.ndarray]]:
    """Networks of steps, with the impulses that their contacts had in the step before: zero for new ones."""
    found = []
    for restitution, packing_fraction, timestep in points:
        flow = jg.ShearFlow(_GRAINS, restitution, packing_fraction, timestep)
        coarse = jg.ShearFlow(_GRAINS, restitution, packing_fraction, 1e-3)
        state = networks.moving(_packed(coarse, jax.random.key(_GRAINS)), _GRAINS)
        state = _advanced(coarse, state, jnp.int32(_STRAIN / 1e-3))
        masses = np.asarray(state.grains.masses)
        for instant in range(number):
            state = _advanced(flow, state, jnp.int32(round(_BETWEEN / timestep)))
            contacts = _contacts(flow, state)
            while np.sum(contacts.used) < _FEWEST or not _moving(contacts):
                state = _advanced(flow, state, jnp.int32(1))
                contacts = _contacts(flow, state)
            before = dict(zip(pairs(contacts), impulses_of(compact(contacts, masses)), strict=True))
            state = _advanced(flow, state, jnp.int32(1))
            contacts = _contacts(flow, state)
            if np.sum(contacts.used) < _FEWEST or not _moving(contacts):
                continue
            problem = compact(contacts, masses)
            solution = Solved(True, impulses_of(problem), np.zeros(0), np.zeros(0), {})
            name = f"{packing_fraction:g}, {restitution:g}, {timestep:g}, {instant}"
            start = np.array([before.get(pair, 0.0) for pair in pairs(contacts)])
            found.append((Entry(name, "step", name, problem, solution), start))
    return found


def pairs(contacts: Contacts) -> list[tuple[int, int]]:
    """The grains of each contact that is used, the smaller number first."""
    used = np.asarray(contacts.used)
    ends = np.sort(np.stack([np.asarray(contacts.i), np.asarray(contacts.j)], axis=1)[used], axis=1)
    return list(map(tuple, ends.tolist()))


def impulses_of(problem: Problem) -> np.ndarray:
    """The solution to 1e-9."""
    solution = _solved(padded(problem), solver=jg.BarzilaiBorwein(1e-9, 100_000))
    return np.asarray(solution.impulses)[: len(problem.approach)]


_solved = jax.jit(jg.solve_contacts)
_packed = jax.jit(lambda flow, key: jg.pack(flow, key)[0])
_advanced = jax.jit(lambda flow, state, steps: jg.advance(flow, state, steps)[0])
_contacts = jax.jit(contacts_now)


def _moving(contacts: Contacts) -> bool:
    return bool(np.any(np.asarray(contacts.used) & (np.asarray(contacts.approach) < 0)))
