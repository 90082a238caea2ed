"""Solvers side by side on the collection: each is a function, and all are judged by the same
residual.

A solver is a function ``prepare(entry, tolerance)`` that returns a function ``solve()``. What a
program does once for a problem, such as building its matrices or compiling, belongs into
``prepare`` and is not timed. ``solve`` returns the impulses at restitution zero, (contacts,), or
``Answer(impulses, products)`` if it counts products with W or their equals, or None where it finds
that there is no solution. It has a limit of its own, so that it ends. Whether it succeeded is not
its own word: the residual of the natural map must be at most the tolerance. A ``ProjectedMethod``
stands for itself.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jaxgran as jg
from benchmarks.collection.files import Entry
from benchmarks.collection.make import padded
from benchmarks.gauss_seidel import gauss_seidel
from benchmarks.timing import timed
from jaxgran.contact.solve_contacts import ContactSolution, contact_residual
from jaxgran.model.status import Status

CAP = 20_000  # products with W of our own methods
TIGHTEST = 1e-12  # tolerance that a projected method accepts
_JUDGED = (
    1 + 1e-9
)  # of the tolerance: the residual is computed a second time, with another rounding


class Answer(NamedTuple):
    """Impulses and the products with W that they took."""

    impulses: np.ndarray
    products: float


Solve = Callable[[], np.ndarray | Answer | None]
Prepare = Callable[[Entry, float], Solve]


class Row(NamedTuple):
    """One solver on one problem.

    ``residual`` is that of the natural map in float64, not a number where the solver returned no
    impulses. ``products`` is not a number where it does not count them. ``solved`` says whether the
    answer is right: impulses within the tolerance, or none for a problem that has no solution.
    """

    solver: str
    problem: str
    family: str
    feasible: bool
    contacts: int
    tolerance: float
    seconds: float
    products: float
    residual: float
    solved: bool


def compare(
    solvers: Mapping[str, Prepare | jg.ProjectedMethod],
    entries: Sequence[Entry],
    tolerance: float = 1e-6,
    timings: int = 3,
) -> list[Row]:
    """Every solver on every problem, problem by problem, so that all meet the same load of the
    machine.
    """
    return [
        _row(name, prepare, entry, tolerance, timings)
        for entry in entries
        for name, prepare in solvers.items()
    ]


def _row(
    name: str, prepare: Prepare | jg.ProjectedMethod, entry: Entry, tolerance: float, timings: int
) -> Row:
    solve = (partial(projected, prepare) if isinstance(prepare, jg.ProjectedMethod) else prepare)(
        entry, tolerance
    )
    solve()  # compiles
    seconds, answer = timed(solve, timings)
    impulses, products = answer if isinstance(answer, Answer) else (answer, np.nan)
    residual = np.nan if impulses is None else residual_of(entry, impulses)
    right = residual <= tolerance * _JUDGED if entry.solution.feasible else impulses is None
    head = (
        name,
        entry.name,
        entry.family,
        entry.solution.feasible,
        len(entry.problem.approach),
        tolerance,
    )
    return Row(*head, float(seconds), float(products), residual, bool(right))


def residual_of(entry: Entry, impulses: np.ndarray) -> float:
    """Residual of the natural map; see ``jaxgran.contact.solve_contacts``."""
    network = padded(entry.problem)
    filled = np.zeros(len(network.approach))
    filled[: len(entry.problem.approach)] = impulses
    return float(contact_residual(network, jnp.asarray(filled)))


def projected(method: jg.ProjectedMethod, entry: Entry, tolerance: float) -> Solve:
    """A projected method, compiled for one of few shapes, with a tolerance and ``CAP`` in place of
    its own.
    """
    network, count = padded(entry.problem), len(entry.problem.approach)
    method = replace(method, tolerance=max(tolerance, TIGHTEST), max_steps=CAP)
    call = partial(solved_network, network, method)

    def solve() -> Answer | None:
        solution = jax.block_until_ready(call())
        if solution.status == Status.infeasible:
            return None
        return Answer(np.asarray(solution.impulses)[:count], int(solution.iterations))

    return solve


@jax.jit
def solved_network(network: jg.ContactNetwork, solver: jg.ProjectedMethod) -> ContactSolution:
    """The solution of a network."""
    return jg.solve_contacts(network, solver=solver)


def swept(entry: Entry, tolerance: float) -> Solve:
    """Gauss–Seidel sweeps, a loop in numba."""
    network = jg.ContactNetwork(*map(jnp.asarray, entry.problem))
    contacts = jax.tree.map(np.asarray, network.operator().contacts)

    def solve() -> Answer:
        solution = gauss_seidel(contacts, len(entry.problem.masses), tolerance, CAP)
        return Answer(solution.impulses, int(solution.iterations))

    return solve


OURS: dict[str, Prepare] = {
    "barzilai-borwein": partial(projected, jg.BarzilaiBorwein()),
    "nesterov": partial(projected, jg.Nesterov()),
    "Gauss–Seidel": swept,
}
