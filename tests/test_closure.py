"""The closure finds known laws within their errors, tends to kinetic theory, and finds a restitution from stresses."""

from collections.abc import Iterator
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr
from made_up_maps import ALPHA, NU, RELATIVE, SCATTER, TRUE, known_closure, made_up_map
from synthetic import refused

from jaxgran.inference import closure_fit
from jaxgran.inference.closure import LAWS, Closure, Law, predict
from jaxgran.inference.closure_fit import closure_points, fit_closure
from jaxgran.inference.cross_validation import leave_one_out
from jaxgran.inference.stress_inversion import restitution_from_stresses
from jaxgran.sampling.prediction import kinetic_theory
from jaxgran.theory.steady_shear import SteadyShear

PREDICTED = ("pressure", "shear_stress", "force_ratio", "pressure_stderr", "force_ratio_stderr")


@pytest.fixture(autouse=True, scope="module")
def theory_once() -> Iterator[None]:
    """Kinetic theory is solved once for each grid of points: ensembles of maps have the same grid."""
    known = {}

    def theory(*numbers: np.ndarray) -> SteadyShear:
        key = tuple(x.tobytes() for x in numbers)
        if key not in known:
            known[key] = kinetic_theory(*numbers)
        return known[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(closure_fit, "kinetic_theory", theory)
        yield


def with_a_bad_point(data: xr.Dataset) -> xr.Dataset:
    """The map with a point whose status is bad, the same in all tests that leave points out: one compilation."""
    status = np.zeros(data.pressure.shape, int)
    status[0, 0] = 2
    flags = {"flag_values": [0, 2], "flag_meanings": "ok bad"}
    return data.assign(status=(data.pressure.dims, status, flags))


def laws(closure: Closure) -> list[Law]:
    return [getattr(closure, name) for name in LAWS]


def test_laws_without_noise_are_found() -> None:
    found = fit_closure(made_up_map(seed=None, noise=0.1))
    for name, law in zip(LAWS, laws(found), strict=True):
        np.testing.assert_allclose(law.coefficients, TRUE[name], rtol=1e-3)
        assert law.scatter < 1e-6
    np.testing.assert_array_equal(found.restitution_range, [0.2, 0.8])
    np.testing.assert_array_equal(found.packing_fraction_range, [0.5, 0.79])
    assert found.timestep == 1e-3


def test_coefficients_lie_about_the_true_ones_as_their_covariance_says() -> None:
    seeds, squares, scatters = 40, [], []
    for seed in range(seeds):
        found = fit_closure(made_up_map(seed, SCATTER))
        for name, law in zip(LAWS, laws(found), strict=True):
            pulls = np.linalg.solve(law.deviations, law.coefficients - TRUE[name])
            squares.append(np.mean(pulls**2))
            scatters.append(law.scatter)
            np.testing.assert_allclose(law.covariance, law.deviations @ law.deviations.T)
    # the scatter is itself estimated, with 24 degrees of freedom, so that the squares are those of Student's t
    expected = 24 / 22
    assert np.mean(squares) == pytest.approx(expected, abs=4 * np.std(squares) / np.sqrt(len(squares)) + 0.05)
    assert np.sqrt(np.mean(np.square(scatters))) == pytest.approx(SCATTER, rel=0.2)


def test_standard_errors_of_predictions_are_those_of_an_ensemble() -> None:
    alpha, nu = np.array([0.275, 0.575, 0.8]), np.array([0.55, 0.72, 0.79])
    truth, pulls = predict(known_closure(), alpha, nu), []
    for seed in range(100, 140):
        seen = predict(fit_closure(made_up_map(seed)), alpha, nu)
        pulls += [
            (getattr(seen, name) - getattr(truth, name)) / getattr(seen, f"{name}_stderr")
            for name in ("pressure", "shear_stress", "force_ratio")
        ]
    squares = np.mean(np.square(pulls), axis=1)
    # a map without scatter is at times given some, which makes errors larger and never smaller
    assert 0.5 < np.mean(squares) < 1 + 4 * np.std(squares) / np.sqrt(len(squares))


def test_scatter_is_zero_where_errors_explain_the_points_and_grows_where_they_do_not() -> None:
    data = made_up_map(seed=1)
    modest = data.assign({f"{name}_stderr": 3 * data[f"{name}_stderr"] for name in LAWS})
    proud = data.assign({f"{name}_stderr": data[f"{name}_stderr"] / 10 for name in LAWS})
    assert all(law.scatter == 0 for law in laws(fit_closure(modest)))
    for name, law in zip(LAWS, laws(fit_closure(proud)), strict=True):
        assert law.scatter == pytest.approx(RELATIVE[name], rel=4 / np.sqrt(2 * 24))


def test_derivatives_equal_finite_differences() -> None:
    closure = fit_closure(made_up_map())

    @jax.jit
    def values(flow):
        seen = predict(closure, *flow)
        return jnp.stack([getattr(seen, name) for name in PREDICTED])

    derivatives = jax.jit(jax.jacrev(values))
    for flow in (jnp.array([0.3, 0.78]), jnp.array([0.6, 0.62])):
        steps = 1e-5 * jnp.eye(2)
        expected = [(values(flow + step) - values(flow - step)) / 2e-5 for step in steps]
        np.testing.assert_allclose(derivatives(flow).T, expected, rtol=1e-5)


def test_a_batch_is_the_same_as_its_flows_one_by_one() -> None:
    closure, alpha, nu = known_closure(SCATTER), np.array([0.3, 0.6, 0.9]), np.array([0.6, 0.7, 0.8])
    one_by_one = [predict(closure, float(a), float(n)) for a, n in zip(alpha, nu, strict=True)]
    expected = jax.tree.map(lambda *x: np.stack(x), *one_by_one)
    for batch in (
        predict(closure, alpha, nu),
        jax.vmap(predict, (None, 0, 0))(closure, jnp.asarray(alpha), jnp.asarray(nu)),
    ):
        for name, value in vars(batch).items():
            np.testing.assert_allclose(value, getattr(expected, name), rtol=1e-12)
    np.testing.assert_array_equal(expected.extrapolated, [False, False, True])
    assert predict(closure, 0.5, 0.7).pressure.shape == ()


@pytest.mark.parametrize(("alpha", "nu"), [(1 - 1e-6, 0.7), (0.3, 1e-6)])
def test_stresses_tend_to_kinetic_theory_in_elastic_and_in_dilute_flow(alpha: float, nu: float) -> None:
    seen, theory = predict(known_closure(), alpha, nu), kinetic_theory([alpha], [nu])
    np.testing.assert_allclose(seen.pressure, theory.pressure, rtol=2e-5)
    np.testing.assert_allclose(seen.shear_stress, theory.shear_stress, rtol=2e-5)


def test_force_ratio_is_one_in_elastic_flow_and_grows_with_density_and_dissipation() -> None:
    np.testing.assert_allclose(predict(known_closure(), 1 - 1e-6, 0.8).force_ratio, 1, atol=1e-6)
    ratio = predict(known_closure(), np.array(ALPHA), np.array(NU)[:, None]).force_ratio
    assert np.all(ratio > 1)
    assert np.all(np.diff(ratio, axis=0) > 0) and np.all(np.diff(ratio, axis=1) < 0)


def test_a_point_left_out_does_not_enter_its_own_prediction() -> None:
    data = with_a_bad_point(made_up_map())
    changed = data.copy(deep=True)
    for name in (*LAWS, "shear_stress"):
        for end in ("", "_stderr"):
            changed[f"{name}{end}"][2, 3] *= 1.7
    before, after = leave_one_out(data), leave_one_out(changed)
    others = np.ones(before.edge.shape, bool)
    others[[2, 0], [3, 0]] = False
    for name in ("pressure", "shear_stress", "force_ratio"):
        first, second = before[f"{name}_predicted"].values, after[f"{name}_predicted"].values
        assert first[2, 3] == second[2, 3]
        assert np.all(first[others] != second[others])
        expected = first / data[name].values - 1
        np.testing.assert_allclose(before[f"{name}_error"], expected, rtol=1e-12)


@cache
def left_out() -> xr.Dataset:
    """Of a map with its axes in the other order and a bad point."""
    data = with_a_bad_point(made_up_map(seed=3, scatter=SCATTER))
    return leave_one_out(data.transpose("restitution", "packing_fraction"))


def test_errors_of_points_left_out_have_the_size_that_is_quoted() -> None:
    errors = left_out()
    assert errors.edge.values.sum() == 18 and not errors.edge[1:-1, 1:-1].any()
    for name in ("pressure", "shear_stress", "force_ratio"):
        pulls = (errors[f"{name}_error"] / errors[f"{name}_stderr"]).values
        assert np.nanmean(pulls**2) == pytest.approx(1, abs=4 * np.sqrt(2 / 24))
    pulls = ((errors.restitution_found - errors.restitution) / errors.restitution_stderr).values
    assert np.nanmean(pulls**2) < 1 + 4 * np.sqrt(2 / 24)


def test_points_of_bad_status_or_without_a_value_are_neither_fitted_nor_predicted() -> None:
    data = with_a_bad_point(made_up_map())
    assert len(closure_points(data).place) == 29
    errors = left_out()
    np.testing.assert_array_equal(np.argwhere(np.isnan(errors.pressure_error.values)), [[0, 0]])
    assert errors.pressure_error.dims == ("packing_fraction", "restitution")
    data.force_ratio[1, 1] = np.nan
    assert set(range(30)) - set(closure_points(data).place.tolist()) == {0, 6}


def test_shortest_time_step_and_largest_number_of_grains_are_fitted() -> None:
    data = made_up_map()
    other = data.assign(pressure=2 * data.pressure)
    several = xr.concat([other, data], xr.Variable("timestep", [1e-3, 1e-4]))
    several = xr.concat([several, several.assign(pressure=3 * several.pressure)], xr.Variable("grains", [1000, 256]))
    found = fit_closure(several)
    np.testing.assert_array_equal(found.pressure.coefficients, fit_closure(data).pressure.coefficients)
    assert found.timestep == 1e-4


def test_restitution_of_exact_stresses_is_found() -> None:
    alpha, closure = np.array([0.25, 0.55, 0.75]), known_closure(1e-3)
    for nu in (0.5, 0.6, 0.7):
        seen = predict(closure, alpha, np.full(3, nu))
        found = restitution_from_stresses(closure, nu, seen.pressure, seen.shear_stress)
        np.testing.assert_allclose(found.restitution, alpha, atol=1e-6)
        assert np.all(found.determined) and np.all(found.chi_squared < 1e-9)


def test_restitutions_scatter_by_their_standard_error() -> None:
    """Of stresses whose errors are correlated."""
    count, correlation, random, errors = 100, 0.95, np.random.default_rng(4), np.array([0.03, 0.03])
    closure, alpha, nu = known_closure(1e-3), 0.55, 0.65
    covariance = np.outer(errors, errors) * np.array([[1, correlation], [correlation, 1]])
    shifts = np.exp(random.multivariate_normal([0, 0], covariance + 1e-6 * np.array([[1, 1], [1, 2]]), count))
    seen = predict(closure, alpha, nu)
    stresses = np.asarray(seen.pressure) * shifts[:, 0], np.asarray(seen.shear_stress) * shifts[:, 1]
    found = restitution_from_stresses(closure, nu, *stresses, *(0.03 * x for x in stresses), correlation)
    pulls = (found.restitution - alpha) / found.stderr
    assert np.mean(pulls**2) == pytest.approx(1, abs=4 * np.sqrt(2 / count) + 0.05)
    assert np.mean(found.chi_squared) == pytest.approx(1, abs=4 * np.sqrt(2 / count) + 0.05)


def test_restitution_is_not_determined_by_stresses_with_large_errors() -> None:
    seen = predict(known_closure(), 0.3, 0.79)
    found = restitution_from_stresses(
        known_closure(), 0.79, seen.pressure, seen.shear_stress, 0.8 * seen.pressure, 0.8 * seen.shear_stress
    )
    assert not found.determined
    assert 0.2 <= found.restitution <= 0.8


def with_timesteps_by_point() -> xr.Dataset:
    data = made_up_map()
    return data.assign_coords(point_timestep=1e-3 / data.pressure)


MISTAKES = {
    "no map": lambda: fit_closure({"pressure": 1}),
    "no shear stress": lambda: leave_one_out(made_up_map().drop_vars("shear_stress")),
    "few points": lambda: fit_closure(made_up_map().isel(restitution=slice(2), packing_fraction=slice(3))),
    "none to spare": lambda: leave_one_out(made_up_map().isel(restitution=slice(3), packing_fraction=slice(4))),
    "several time steps": lambda: fit_closure(with_timesteps_by_point()),
    "jamming": lambda: fit_closure(made_up_map(), 0.7),
    "no closure": lambda: predict(None, 0.5, 0.7),
    "restitution": lambda: predict(known_closure(), 1.0, 0.7),
    "shapes": lambda: predict(known_closure(), np.full(2, 0.5), np.full(3, 0.7)),
    "pressure": lambda: restitution_from_stresses(known_closure(), 0.7, -1.0, 1.0),
    "correlation": lambda: restitution_from_stresses(known_closure(), 0.7, 1.0, 1.0, 0.1, 0.1, 2.0),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_mistakes_end_with_one_sentence(mistake: str) -> None:
    with refused():
        MISTAKES[mistake]()
