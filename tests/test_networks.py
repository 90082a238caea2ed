"""Laws of the methods on networks that are hard in one respect, and of a dense flow."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from contact_networks import (
    GRAINS,
    SLOTS,
    Network,
    chain,
    hexagonal,
    jammed_lattice,
    jammed_row,
    mass_ratio,
    padded_network,
    size_ratio,
    static_packing,
)
from exact_contacts import delassus, exact_changes, incidence

import jaxgran as jg
from jaxgran.contact.delassus import NetworkOperator
from jaxgran.contact.projected_methods import BarzilaiBorwein, Jacobi, Nesterov
from jaxgran.contact.solver import solve
from jaxgran.model.status import Status

CHAINS = (8, 16, 32, 64, 128, 256)
BUILT = (
    *(chain(discs) for discs in CHAINS),
    *(size_ratio(big, seed) for seed in range(2) for big in (1, 2)),
    *(mass_ratio(side, seed) for seed in range(2) for side in (4, 8)),
    *(hexagonal(rings, struck) for rings in (1, 2, 3, 4) for struck in (True, False)),
)
JAMMED = (*(jammed_row(discs) for discs in (3, 10, 40)), *map(jammed_lattice, (4, 8)))

compiled_bound = jax.jit(NetworkOperator.spectral_bound)


@pytest.fixture(scope="module")
def feasible() -> list[Network]:
    return [*BUILT, *(static_packing(64, seed) for seed in range(2)), *of_a_flow()]


def of_a_flow() -> list[Network]:
    """Networks that a dense, dissipative flow meets, in which grains approach."""
    flow = jg.ShearFlow(64, restitution=0.1, packing_fraction=0.82, timestep=1e-3)
    state = jg.prepare(flow, jax.random.key(0), equilibrate=0.5)
    _, snapshots = jg.snapshot_series(flow, state, 0.5, 8)
    masses = np.concatenate([np.asarray(state.grains.masses), np.ones(GRAINS - flow.grains)])
    networks = []
    for snapshot in snapshots:
        used = np.asarray(snapshot.contacts.used)
        fields = ("i", "j", "normals", "approach")
        contacts = [np.asarray(getattr(snapshot.contacts, name))[used] for name in fields]
        if np.any(contacts[-1] < 0):
            networks.append(Network(padded_network(*contacts, masses, SLOTS), masses))
    assert len(networks) > 3
    return networks


@pytest.fixture(scope="module")
def solution_of():
    """``solution_of(network, tolerance, max_steps, method)``: the contact solve, compiled."""
    compiled = jax.jit(solve)

    def call(network, tolerance=1e-4, max_steps=5000, method=BarzilaiBorwein):
        operator = NetworkOperator(network.contacts, GRAINS)
        solver = method(tolerance, max_steps)
        return compiled(operator, jnp.asarray(1.0), solver, jnp.asarray(True))

    return call


def energy(network: Network, velocities: np.ndarray) -> float:
    return float(np.sum(network.masses[:, None] * velocities**2) / 2)


def test_default_converges_to_the_exact_velocities(feasible, solution_of) -> None:
    for network in feasible:
        solution, exact = solution_of(network, 1e-10, 20_000), exact_changes(*network)
        assert solution.status == Status.ok
        matrix = incidence(network.contacts, GRAINS)
        momenta = (matrix.T @ np.asarray(solution.impulses)).reshape(-1, 2)
        error = energy(network, momenta / network.masses[:, None] - exact)
        assert error < 1e-12 * energy(network, exact)


def test_what_is_jammed_is_infeasible(solution_of) -> None:
    for network in JAMMED:
        assert solution_of(network).status == Status.infeasible


def test_jacobi_with_the_spectral_bound_lowers_the_objective_in_every_step(
    feasible, solution_of
) -> None:
    """J ← max(0, J − ω D⁻¹(W J + b)) for ω close to 2, dense; capped solves follow it."""
    for number, network in enumerate(feasible):
        used = np.asarray(network.contacts.used)
        matrix = delassus(*network)[np.ix_(used, used)]
        approach = np.asarray(network.contacts.approach)[used]
        bound = np.asarray(compiled_bound(NetworkOperator(network.contacts, GRAINS)))[used]
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


def test_iterations_on_chains_grow_no_faster_than_their_length(solution_of) -> None:
    """A shock must travel along the chain; diffusion would take the square of the length."""
    products = [
        int(solution_of(chain(discs), 1e-6, method=Nesterov).iterations) for discs in CHAINS
    ]
    assert np.polyfit(np.log(CHAINS), np.log(products), 1)[0] < 1.2
