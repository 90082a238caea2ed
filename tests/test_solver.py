"""Contact solves: against dense matrices and exact solutions, and where there is none."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from contact_networks import MAX_DISCS, padded_network, random_network
from exact_contacts import delassus, exact_changes
from hypothesis import given, settings
from hypothesis import strategies as st
from synthetic import refused

from jaxgran.contact.delassus import NetworkOperator, grain_impulses
from jaxgran.contact.network import Contacts
from jaxgran.contact.projected_methods import BarzilaiBorwein, Jacobi, Nesterov, ProjectedMethod
from jaxgran.contact.solver import solve
from jaxgran.model.status import Status

EPS = np.finfo(float).eps
METHODS = [Nesterov, BarzilaiBorwein, Jacobi]
networks = st.tuples(st.integers(0, 2**32 - 1), st.integers(1, MAX_DISCS))

compiled_bound = jax.jit(NetworkOperator.spectral_bound)
compiled_product = jax.jit(NetworkOperator.product)
compiled_impulses = jax.jit(grain_impulses, static_argnums=2)


def velocities_after(
    network: Contacts, masses: np.ndarray, velocities: np.ndarray, impulses
) -> np.ndarray:
    return (
        velocities + np.asarray(compiled_impulses(network, impulses, MAX_DISCS)) / masses[:, None]
    )


@settings(max_examples=30)
@given(networks, st.sampled_from([1.0, 100.0, 1e6]))
def test_delassus_operator_never_exceeds_its_bound(network_of, heaviest):
    network, masses, _ = random_network(*network_of, heaviest)
    scale = 1 / np.sqrt(np.asarray(compiled_bound(NetworkOperator(network, MAX_DISCS))))
    largest = np.linalg.eigvalsh(delassus(network, masses) * scale[:, None] * scale[None, :])[-1]
    assert largest <= 1 + MAX_DISCS * EPS


@settings(max_examples=20)
@given(networks)
def test_delassus_product_equals_the_dense_matrix(network_of):
    network, masses, _ = random_network(*network_of)
    # unused slots too: they are inert
    impulses = np.random.default_rng(network_of[0]).normal(size=network.used.size)
    matrix = delassus(network, masses)
    rounding = 16 * EPS * (np.abs(matrix) @ np.abs(impulses))
    operator = NetworkOperator(network, MAX_DISCS)
    assert np.all(
        np.abs(compiled_product(operator, jnp.asarray(impulses)) - matrix @ impulses) <= rounding
    )


@pytest.mark.parametrize("method", METHODS)
@settings(max_examples=20)
@given(networks, st.sampled_from([1.0, 4.0, 100.0]))
def test_velocities_equal_the_exact_solution(solved, method, network_of, heaviest):
    network, masses, velocities = random_network(*network_of, heaviest)
    solution = solved(network, method=method)
    assert solution.status == Status.ok
    after = velocities_after(network, masses, velocities, solution.impulses)
    exact = velocities + exact_changes(network, masses)
    assert np.max(np.abs(after - exact)) < 1e-8


@pytest.mark.parametrize("method", METHODS)
@settings(max_examples=20)
@given(networks, st.sampled_from([1e-3, 1e-6, 1e-10]))
def test_impulses_push_and_are_complementary_to_the_velocities_after(
    solved, method, network_of, tolerance
):
    network, masses, _ = random_network(*network_of)
    solution = solved(network, tolerance, method=method)
    matrix = delassus(network, masses)
    impulses = np.asarray(solution.impulses)
    approach = np.asarray(network.approach)
    assert solution.status == Status.ok
    assert np.all(impulses >= 0)
    rounding = 32 * EPS * np.linalg.norm(np.abs(matrix) @ impulses + np.abs(approach))
    assert np.linalg.norm(solution.response - matrix @ impulses) <= rounding
    residual = np.linalg.norm(np.minimum(np.diag(matrix) * impulses, matrix @ impulses + approach))
    scale = np.linalg.norm(np.minimum(approach, 0))
    assert residual <= tolerance * scale + 10 * EPS + rounding
    if scale > 0:
        assert abs(solution.residual * scale - residual) <= rounding


@pytest.mark.parametrize("method", METHODS)
def test_isolated_pairs_are_exact_at_once(solved, method):
    rng = np.random.default_rng(1)
    grains, angles = np.arange(0, MAX_DISCS, 2), rng.uniform(0, 2 * np.pi, MAX_DISCS // 2)
    masses, approach = 100 ** rng.uniform(0, 1, MAX_DISCS), rng.normal(size=MAX_DISCS // 2)
    normals = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    solution = solved(padded_network(grains, grains + 1, normals, approach, masses), method=method)
    exact = np.maximum(0, -approach) / (1 / masses[::2] + 1 / masses[1::2])
    if method is Nesterov:
        assert solution.iterations == 1
        np.testing.assert_allclose(solution.impulses[: len(exact)], exact, rtol=16 * EPS)
    np.testing.assert_allclose(solution.impulses[: len(exact)], exact, rtol=1e-11)


@pytest.mark.parametrize("method", METHODS)
def test_order_of_the_contacts_changes_velocities_by_rounding_only(solved, method):
    for seed in range(5):
        network, masses, velocities = random_network(seed, MAX_DISCS)
        order = np.random.default_rng(seed).permutation(network.used.size)
        shuffled = jax.tree.map(lambda values, order=order: values[order], network)
        results = [
            velocities_after(each, masses, velocities, solved(each, 1e-12, 10, method).impulses)
            for each in (network, shuffled)
        ]
        np.testing.assert_allclose(*results, rtol=0, atol=1000 * EPS * np.max(np.abs(velocities)))


@pytest.mark.parametrize("method", METHODS)
def test_cap_of_iterations_returns_the_best_iterate(solved, method):
    for seed in range(3):
        network, masses, _ = random_network(seed, MAX_DISCS)
        residuals = []
        for cap in range(1, 12):
            solution = solved(network, 1e-12, cap, method)
            assert solution.status == Status.iteration_limit
            assert solution.iterations == cap
            matrix, impulses = delassus(network, masses), np.asarray(solution.impulses)
            residual = np.linalg.norm(
                np.minimum(np.diag(matrix) * impulses, matrix @ impulses + network.approach)
            )
            np.testing.assert_allclose(
                solution.residual * np.linalg.norm(np.minimum(network.approach, 0)), residual
            )
            residuals.append(residual)
        assert np.all(np.diff(residuals) <= 0)


def squeezed(grains: int) -> Contacts:
    """A row closed through the boundary, all of whose contacts approach: nothing stops them."""
    i = np.arange(grains)
    normals, approach = np.tile([1.0, 0.0], (grains, 1)), np.full(grains, -1.0)
    return padded_network(i, (i + 1) % grains, normals, approach, np.ones(MAX_DISCS))


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("grains", [2, 10])
def test_jammed_network_is_infeasible_and_stays_finite(solved, method, grains):
    solution = solved(squeezed(grains), 1e-4, 5000, method)
    assert solution.status == Status.infeasible
    assert solution.iterations <= 5000
    assert np.all(np.isfinite(solution.impulses)) and np.all(np.isfinite(solution.response))
    assert np.isfinite(solution.residual)


@pytest.mark.parametrize("field", ["approach", "normals", "inverse_mass_i"])
def test_solve_of_something_that_is_not_a_number_stops(solved, field):
    network, _, _ = random_network(0, 20)
    spoilt = replace(network, **{field: getattr(network, field).at[2].set(jnp.nan)})
    solution = solved(spoilt, 1e-4, 5000)
    assert solution.status == Status.nonfinite
    assert solution.iterations <= 2


def test_network_without_approach_needs_no_impulse(solved):
    network, _, _ = random_network(0, MAX_DISCS)
    solution = solved(replace(network, approach=jnp.abs(network.approach)))
    assert solution.status == Status.ok
    assert solution.iterations <= 1
    assert np.all(solution.impulses == 0)


def test_inactive_replica_is_not_solved(solved):
    solution = solved(random_network(0, 20)[0], active=False)
    assert np.all(solution.impulses == 0)
    assert (solution.iterations, solution.residual, solution.status) == (0, 0, Status.ok)


def test_compiled_solve_equals_the_interpreted_one(solved):
    """Some releases of JAX return wrong numbers from compiled code, silently."""
    network, _, _ = random_network(0, 12)
    compiled = solved(network, 1e-4, 8)
    operator, solver = NetworkOperator(network, MAX_DISCS), BarzilaiBorwein(1e-4, 8)
    with jax.disable_jit():
        interpreted = solve(operator, jnp.asarray(1.0), solver, jnp.asarray(True))
    np.testing.assert_allclose(compiled.impulses, interpreted.impulses, rtol=0, atol=1e-12)
    np.testing.assert_allclose(compiled.residual, interpreted.residual, rtol=1e-10)


def test_a_method_that_no_solve_calls_is_refused() -> None:
    with refused("and step of Own would never be called; name a function of your own _step"):
        type("Own", (ProjectedMethod,), {"step": lambda self, now: 1.0})
    type("Own", (ProjectedMethod,), {"propose": lambda self, now: (now.point, 1.0)})
