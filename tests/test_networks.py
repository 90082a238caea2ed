"""Where methods for the contact problem fail, and where they do not: laws on the collection of the
benchmarks.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import delassus

from benchmarks import networks as module
from benchmarks.exact_contacts import exact, incidence
from benchmarks.gauss_seidel import gauss_seidel
from benchmarks.networks import CHAINS, INFEASIBLE, chain, collection
from jaxgran.contact.delassus import NetworkOperator
from jaxgran.contact.projected_methods import BarzilaiBorwein, Jacobi, Nesterov
from jaxgran.contact.solver import solve
from jaxgran.model.status import Status

compiled_bound = jax.jit(NetworkOperator.spectral_bound)


@pytest.fixture(scope="module")
def networks():
    """The quick collection without one of the flows; the others are sheared less, and compiled
    sooner.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "FLOWS", (module.FLOWS[0], *module.FLOWS[2:]))
        sheared = module.sheared
        patch.setattr(module, "sheared", lambda *flow: sheared(*flow[:3], strain=0.5))
        return collection(quick=True)


@pytest.fixture(scope="module")
def feasible(networks):
    return [
        network for group, members in networks.items() if group != INFEASIBLE for network in members
    ]


@pytest.fixture(scope="module")
def solution_of():
    """``solution_of(network, tolerance, max_steps, method)``: the contact solve, compiled."""
    compiled = jax.jit(solve)

    def call(network, tolerance=1e-4, max_steps=5000, method=BarzilaiBorwein):
        operator = NetworkOperator(network.contacts, network.grains)
        solver = method(tolerance, max_steps)
        return compiled(operator, jnp.asarray(1.0), solver, jnp.asarray(True))

    return call


@pytest.fixture(scope="module")
def exact_of():
    """``exact_of(network)``: the exact solution, computed once."""
    known = {}

    def call(network):
        if id(network) not in known:
            known[id(network)] = network, exact(network.contacts, network.masses)
        return known[id(network)][1]

    return call


def changes(network, impulses) -> np.ndarray:
    """Changes of the velocities (grains, 2) by the impulses."""
    matrix = incidence(network.contacts, network.grains)
    return (matrix.T @ np.asarray(impulses)).reshape(-1, 2) / network.masses[:, None]


def energy(network, velocities) -> float:
    return float(np.sum(network.masses[:, None] * velocities**2) / 2)


def operator_and_approach(network) -> tuple[np.ndarray, np.ndarray]:
    """W and u⁻ of the contacts in use, dense."""
    used = np.asarray(network.contacts.used)
    matrix = delassus(network.contacts, network.masses)
    return matrix[np.ix_(used, used)], np.asarray(network.contacts.approach)[used]


def test_default_converges_to_the_exact_velocities(feasible, solution_of, exact_of):
    for network in feasible:
        solution, reference = solution_of(network, 1e-10, 20_000), exact_of(network)
        assert solution.status == Status.ok
        error = energy(network, changes(network, solution.impulses) - reference.changes)
        assert error < 1e-12 * energy(network, reference.changes)


def test_jacobi_with_the_spectral_bound_lowers_the_objective_in_every_step(feasible, solution_of):
    """The iteration J ← max(0, J − ω D⁻¹(W J + b)) for ω close to 2, dense; compiled, capped solves
    follow it.
    """
    for number, network in enumerate(feasible):
        used = np.asarray(network.contacts.used)
        matrix, approach = operator_and_approach(network)
        bound = np.asarray(compiled_bound(NetworkOperator(network.contacts, network.grains)))[used]
        impulses, objectives, residuals, iterates = np.zeros(len(approach)), [0.0], [], []
        for _ in range(30):
            impulses = np.maximum(0, impulses - 1.99 * (matrix @ impulses + approach) / bound)
            objectives.append(impulses @ (matrix @ impulses / 2 + approach))
            residuals.append(
                np.linalg.norm(np.minimum(np.diag(matrix) * impulses, matrix @ impulses + approach))
            )
            iterates.append(impulses)
        assert np.all(np.diff(objectives) <= 1e-14 * abs(objectives[-1]))
        for cap in range(1, 31) if number % 8 == 0 else ():
            found = np.asarray(
                solution_of(network, 1e-12, cap, partial(Jacobi, relaxation=1.99)).impulses
            )[used]
            best = iterates[int(np.argmin(residuals[:cap]))]
            np.testing.assert_allclose(found, best, rtol=0, atol=1e-9 * max(np.max(best), 1e-3))


def test_iterations_on_chains_grow_no_faster_than_their_length(solution_of):
    """A shock must travel along the chain; diffusion would take the square of the length."""
    products = [
        int(solution_of(chain(discs), 1e-6, method=Nesterov).iterations) for discs in CHAINS
    ]
    exponent = np.polyfit(np.log(CHAINS), np.log(products), 1)[0]
    assert exponent < 1.2
    sweeps = [
        int(gauss_seidel(chain(n).contacts, chain(n).grains, 1e-6, 100_000).iterations)
        for n in CHAINS[:4]
    ]
    assert np.polyfit(np.log(CHAINS[:4]), np.log(sweeps), 1)[0] > 1.5
