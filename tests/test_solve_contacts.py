"""Any contact problem: against independent solvers, by the law, and as JAX transforms it."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse
from contact_networks import MAX_DISCS, random_network
from exact_contacts import delassus, exact_changes
from hypothesis import given, settings
from hypothesis import strategies as st
from jax.experimental.sparse import BCOO
from scipy.optimize import nnls

from jaxgran import (
    BarzilaiBorwein,
    ContactNetwork,
    DelassusProblem,
    InputError,
    Jacobi,
    Nesterov,
    Status,
    solve_contacts,
)
from jaxgran.contact.solve_contacts import contact_residual

SIZE = 12  # contacts of the matrices
seeds = st.integers(0, 2**32 - 1)
restitutions = st.floats(0, 1)


def network_of(seed: int, discs: int = MAX_DISCS) -> tuple[ContactNetwork, np.ndarray, np.ndarray]:
    """A random network in 192 slots, with W dense, and the velocities of the grains before."""
    contacts, masses, velocities = random_network(seed, discs)
    ends = jnp.stack([contacts.i, contacts.j], axis=1)
    network = ContactNetwork(ends, contacts.normals, jnp.asarray(masses), contacts.approach)
    return network, delassus(contacts, masses), velocities


def matrix_problem(seed: int, size: int = SIZE) -> DelassusProblem:
    """A dense matrix without a network behind it, with scales over two decades."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(size, size)) * 10 ** rng.uniform(-1, 1, (size, 1))
    return DelassusProblem(jnp.asarray(root @ root.T), jnp.asarray(root @ rng.normal(size=size)))


def by_nnls(problem: DelassusProblem) -> np.ndarray:
    """Impulses at restitution zero: with W = L Lᵀ they make |Lᵀp + L⁻¹u⁻| least."""
    lower = np.linalg.cholesky(np.asarray(problem.matrix))
    return nnls(lower.T, -np.linalg.solve(lower, np.asarray(problem.approach)))[0]


@settings(max_examples=10)
@given(seeds, st.integers(2, MAX_DISCS), restitutions)
def test_network_and_its_matrix_have_the_exact_velocities(seed, discs, restitution):
    network, matrix, velocities = network_of(seed, discs)
    contacts, masses, _ = random_network(seed, discs)
    normals, (i, j), used = (
        np.asarray(network.normals),
        np.asarray(network.ends).T,
        np.asarray(contacts.used),
    )
    stopped = velocities + exact_changes(contacts, masses)
    before, after = (np.sum(normals * (v[i] - v[j]), axis=1) for v in (velocities, stopped))
    expected = before + (1 + restitution) * (after - before)
    as_matrix = DelassusProblem(
        jnp.asarray(np.where(np.eye(len(used)) > used, 1, matrix)), network.approach
    )
    for problem in (network, as_matrix):
        solution = solve_contacts(problem, restitution, solver=BarzilaiBorwein(1e-11, 100_000))
        assert solution.status == Status.ok
        np.testing.assert_allclose(
            np.asarray(solution.velocities)[used], expected[used], rtol=0, atol=1e-8
        )
        assert np.all(np.asarray(solution.impulses)[~used] == 0)


@given(seeds, restitutions)
def test_any_matrix_has_the_impulses_of_non_negative_least_squares(seed, restitution):
    problem = matrix_problem(seed)
    expected = (1 + restitution) * by_nnls(problem)
    solution = solve_contacts(problem, restitution, solver=BarzilaiBorwein(1e-12, 1_000_000))
    error, matrix = np.asarray(solution.impulses) - expected, np.asarray(problem.matrix)
    assert error @ matrix @ error <= 1e-14 * (expected @ matrix @ expected)


@given(seeds, restitutions)
def test_residual_is_that_of_the_natural_map(seed, restitution):
    rng = np.random.default_rng(seed)
    problem, impulses = matrix_problem(seed), rng.normal(size=SIZE)
    matrix, approach = np.asarray(problem.matrix), np.asarray(problem.approach)
    after = matrix @ impulses + (1 + restitution) * approach
    speed = (1 + restitution) * np.linalg.norm(np.minimum(approach, 0))
    expected = np.linalg.norm(np.minimum(np.diag(matrix) * impulses, after)) / speed
    residual = contact_residual(problem, jnp.asarray(impulses), restitution)
    np.testing.assert_allclose(residual, expected, rtol=1e-9)


def test_residual_vanishes_at_a_solution_and_where_nothing_approaches():
    problem = matrix_problem(0)
    assert contact_residual(problem, jnp.asarray(by_nnls(problem))) < 1e-10
    apart = replace(problem, approach=jnp.abs(problem.approach))
    assert contact_residual(apart, jnp.zeros(SIZE)) == 0


@pytest.mark.parametrize(
    ("speed", "kind"), [(1e-3, np.float16), (1e-25, np.float32), (1e-200, float), (1e200, float)]
)
def test_solution_does_not_depend_on_the_unit_of_speed(speed, kind):
    """Half precision is solved in single precision."""
    normals, ends = np.array([[1, 0], [1, 0]], kind), np.array([[1, 0], [2, 1]], ">i4")
    row = ContactNetwork(ends, normals, np.ones(3, kind), np.array([-speed, 0], kind))
    solution = solve_contacts(row, 1.0)
    impulses = np.asarray(solution.impulses, float) / float(-row.approach[0])
    np.testing.assert_allclose(impulses, [4 / 3, 2 / 3], rtol=1e-5)
    assert solution.status == Status.ok and solution.residual < 1e-6
    for jacobian in (jax.jacfwd, jax.jacrev):
        changes = jacobian(lambda u: solve_contacts(replace(row, approach=u), 1.0).impulses)
        expected = [[-4 / 3, -2 / 3], [-2 / 3, -4 / 3]]
        np.testing.assert_allclose(changes(row.approach), expected, rtol=2e-3)
    apart = replace(row, approach=np.array([0, speed], kind))
    stuck = contact_residual(apart, np.array([0.5 * speed, 0], kind))
    np.testing.assert_allclose(stuck, speed, rtol=1e-2)


def test_dense_and_sparse_matrices_are_the_same_problem():
    network, matrix, _ = network_of(3, 20)
    matrix = matrix + np.diag(np.diag(matrix) == 0)
    approach, count = network.approach, len(matrix)
    rows, columns = np.nonzero(matrix)
    split = np.concatenate([matrix[rows, columns] / 4, 3 * matrix[rows, columns] / 4, [np.pi]])
    places = np.stack([rows, columns], 1)
    places = np.concatenate([places, places, [[count, count]]])
    # in two parts, and padded
    twice = BCOO((jnp.asarray(split), jnp.asarray(places)), shape=(count, count))
    of_scipy = scipy.sparse.csr_array(matrix), scipy.sparse.coo_matrix(matrix)
    forms = jnp.asarray(matrix), *of_scipy, BCOO.fromdense(matrix), twice
    problems = (DelassusProblem(form, approach) for form in forms)
    first, *others = (solve_contacts(x, solver=BarzilaiBorwein(1e-12)) for x in problems)
    for other in others:
        assert other.status == Status.ok
        np.testing.assert_allclose(other.velocities, first.velocities, rtol=0, atol=1e-9)


@pytest.mark.parametrize("method", [Nesterov, Jacobi])
def test_every_bounded_method_solves_a_matrix(method):
    problem = replace(
        matrix_problem(1),
        matrix=jnp.asarray(np.eye(SIZE) + 0.5 * (np.eye(SIZE, k=1) + np.eye(SIZE, k=-1))),
    )
    solution = solve_contacts(problem, solver=method(1e-9))
    assert solution.status == Status.ok
    np.testing.assert_allclose(
        solution.impulses, by_nnls(problem), atol=1e-7 * np.max(solution.impulses)
    )


def test_walls_do_not_move_and_one_contact_is_exact():
    wall = ContactNetwork(
        jnp.array([[0, 1]]), jnp.array([[0.0, 1.0]]), jnp.array([2.0, jnp.inf]), jnp.array([-3.0])
    )
    solution = solve_contacts(wall, restitution=0.5)
    assert solution.impulses == 9.0 and solution.velocities == 1.5
    assert (
        solve_contacts(DelassusProblem(jnp.array([[0.5]]), jnp.array([-3.0])), 0.5).impulses == 9.0
    )


def test_single_precision_stays_single():
    problem = jax.tree.map(lambda x: x.astype(jnp.float32), matrix_problem(0))
    solution = solve_contacts(problem, 0.5, solver=BarzilaiBorwein(1e-4))
    assert solution.impulses.dtype == solution.residual.dtype == jnp.float32
    mixed = solve_contacts(
        replace(problem, approach=problem.approach.astype(float)), 0.5, solver=BarzilaiBorwein(1e-4)
    )
    assert mixed.impulses.dtype == float


@pytest.mark.parametrize("sparse", [False, True])
def test_batch_has_the_results_of_its_problems_one_by_one(sparse):
    """The second is jammed and the third is no number: neither spoils the others."""
    several = [matrix_problem(seed) for seed in (0, 1, 2, 3)]
    squeezed = np.eye(SIZE)
    squeezed[0, 1] = squeezed[1, 0] = -1
    several[1] = DelassusProblem(jnp.asarray(squeezed), jnp.full(SIZE, -1.0))
    several[2] = replace(several[2], approach=several[2].approach.at[0].set(jnp.nan))
    batch = jax.tree.map(lambda *x: jnp.stack(x), *several)
    if sparse:
        batch = replace(batch, matrix=BCOO.fromdense(batch.matrix, n_batch=1))
    together = jax.vmap(partial(solve_contacts, solver=BarzilaiBorwein(1e-8, 20_000)))(
        batch, jnp.full(4, 0.5)
    )
    assert together.status.tolist() == [Status.ok, Status.infeasible, Status.nonfinite, Status.ok]
    for k in (0, 3):
        alone = solve_contacts(several[k], 0.5, solver=BarzilaiBorwein(1e-8, 20_000))
        np.testing.assert_allclose(together.velocities[k], alone.velocities, atol=1e-6)


def test_derivatives_of_a_network_are_those_of_finite_differences():
    network, _, _ = network_of(1, 14)
    weights = random_like(network.approach, 0)

    def function(at):
        fields = {name: value for name, value in at.items() if name != "restitution"}
        return weighted(weights, replace(network, **fields), at["restitution"])

    at = {name: getattr(network, name) for name in ("approach", "masses", "normals")} | {
        "restitution": jnp.array(0.3)
    }
    along = {name: random_like(value, 1) for name, value in at.items()}
    along["masses"] = along["masses"] * network.masses
    # unused slots stay unused
    along["normals"] = jnp.where(network.normals != 0, along["normals"], 0)
    assert_derivatives(function, at, along)


@pytest.mark.parametrize("form", [jnp.asarray, partial(BCOO.fromdense, nse=SIZE**2)])
def test_derivatives_of_a_matrix_are_those_of_finite_differences(form):
    problem = replace(matrix_problem(1), matrix=matrix_problem(1).matrix + jnp.eye(SIZE))
    weights = random_like(problem.approach, 0)

    def function(at):
        changed = problem.matrix + at["change"] + at["change"].T
        return weighted(weights, DelassusProblem(form(changed), at["approach"]), at["restitution"])

    at = {
        "change": jnp.zeros((SIZE, SIZE)),
        "approach": problem.approach,
        "restitution": jnp.array(0.3),
    }
    assert_derivatives(function, at, {name: random_like(value, 1) for name, value in at.items()})


def random_like(value, seed):
    return jnp.asarray(np.random.default_rng(seed).normal(size=value.shape))


def weighted(weights, problem, restitution):
    """A number that depends on all impulses and velocities."""
    solution = solve_contacts(problem, restitution, solver=BarzilaiBorwein(1e-12, 100_000))
    return jnp.sum(weights * solution.velocities) + jnp.sum(weights * solution.impulses)


def assert_derivatives(function, at, along, step=1e-6):
    """The slope along a direction, in both modes, is that of a central difference."""
    function = jax.jit(function)
    up, down = (
        function(jax.tree.map(lambda x, d, s=s: x + s * d, at, along)) for s in (step, -step)
    )
    slope = jax.grad(function)(at)
    reverse = sum(float(jnp.sum(slope[name] * along[name])) for name in at)
    forward = jax.jvp(function, (at,), (along,))[1]
    np.testing.assert_allclose([reverse, forward], (up - down) / (2 * step), rtol=1e-5)


def test_large_sparse_matrix_is_judged_and_solved_without_a_dense_copy():
    count = 5000
    beside = scipy.sparse.eye_array(count, k=1) + scipy.sparse.eye_array(count, k=-1)
    row = 2.0 * scipy.sparse.eye_array(count) - beside
    problem = DelassusProblem(row, jnp.zeros(count).at[0].set(-1.0))
    solution = solve_contacts(problem, solver=BarzilaiBorwein(1e-6, 300))
    assert solution.residual < 0.1  # a shock that has come 300 discs far
    with pytest.raises(InputError, match="negative eigenvalue"):
        solve_contacts(replace(problem, matrix=row - 3.0 * beside))
