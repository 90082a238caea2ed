"""What the reference table says: surfaces against algebra, series, verdicts, intervals."""

import json
import subprocess
import sys
from math import comb
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from command_line import jaxgran
from hypothesis import given, settings
from hypothesis import strategies as st

import jaxgran as jg
from benchmarks import reference
from jaxgran.cli.output import in_brackets
from jaxgran.reference.evaluation import Estimate
from jaxgran.reference.surface import Shape, Surface
from jaxgran.reference.table import MEASURED, shipped_table
from jaxgran.reference.validity import Validity
from jaxgran.theory import gaussian_moments, navier_stokes
from jaxgran.theory.assumptions import ASSUMPTIONS

RESULTS = Path(__file__).parents[1] / "benchmarks" / "results"
ALPHAS, NUS = st.floats(0.1, 0.98), st.floats(0.1, 0.82)


@pytest.fixture(scope="module")
def result() -> dict:
    return json.loads((RESULTS / "reference.json").read_text(encoding="utf-8"))


def a_surface(points: int = 12) -> Surface:
    rng = np.random.default_rng(0)
    where = rng.uniform(-1, 1, (points, 2))
    return Surface(
        where, np.sin(2 * where[:, 0]) + where[:, 1], np.full(points, 0.05), Shape(0.7, (1.2, 0.9))
    )


def test_a_surface_is_the_conditional_mean_of_a_gaussian_distribution() -> None:
    surface = a_surface()
    every = np.vstack([surface.points, [[0.3, -0.2], [0.9, 0.4]]])
    joint = surface.shape.covariance(every, every)
    known = joint[:12, :12] + 0.05**2 * np.eye(12)
    gain = np.linalg.solve(known, joint[:12, 12:]).T
    value, stderr = surface(every[12:])
    assert value == pytest.approx(gain @ surface.values, rel=1e-8)
    assert stderr**2 == pytest.approx(np.diag(joint[12:, 12:] - gain @ joint[:12, 12:]), rel=1e-6)


def test_errors_of_points_left_out_are_those_of_surfaces_without_them() -> None:
    surface = a_surface()
    errors, expected = surface.left_out()
    for k in range(12):
        others = np.arange(12) != k
        without = Surface(
            surface.points[others], surface.values[others], surface.stderrs[others], surface.shape
        )
        value, stderr = without(surface.points[k])
        assert errors[k] == pytest.approx(surface.values[k] - value, rel=1e-6)
        assert expected[k] == pytest.approx(np.hypot(stderr, 0.05), rel=1e-6)


@settings(max_examples=20, deadline=None)
@given(ALPHAS, NUS)
def test_the_series_is_the_theory(alpha: float, nu: float) -> None:
    name = shipped_table().head["theory"]
    theory = getattr(gaussian_moments if name == "gaussian_moments" else navier_stokes, name)(
        alpha, nu
    )
    said = jg.validity(alpha, nu).theory
    for key in ("pressure", "shear_stress", "granular_temperature"):
        assert said[key] == pytest.approx(float(getattr(theory, key)), rel=1e-5)


@settings(max_examples=20, deadline=None)
@given(ALPHAS, NUS)
def test_error_is_theory_over_measured_and_intervals_are_positive(alpha: float, nu: float) -> None:
    answer = jg.validity(alpha, nu)
    for name, error in answer.error.items():
        theory = answer.theory[name.removeprefix("local_")]
        assert 1 + error.value == pytest.approx(theory / answer.measured[name].value)
    assert answer.theory["dissipation_rate"] == answer.theory["shear_stress"]
    for estimates in (answer.measured, answer.error, answer.factors):
        assert all(estimate.ci95 > 0 for estimate in estimates.values())


def test_the_table_is_met_at_its_points_within_their_intervals() -> None:
    table = shipped_table()
    flows = table.columns["restitution"], table.columns["packing_fraction"]
    answer = jg.validity(*flows)
    for name in (*MEASURED, "force_ratio"):
        value, ci95 = answer.measured[name]
        apart = np.abs(value - table.columns[name])
        own = np.hypot(ci95, 1.96 * table.columns[f"{name}_stderr"])
        assert np.mean(apart < own) > 0.95


VARIANCE_ROUNDING = (
    1e-4  # of a half-width: eps × 500 × √294 points over 1e-8 is 2e-4 of the variance at most
)


def test_every_average_of_the_table_has_its_error() -> None:
    """An average without one would spoil the surface of all."""
    columns = shipped_table().columns
    names = [name.removesuffix("_stderr") for name in columns if name.endswith("_stderr")]
    assert len(names) > 10 and "force_ratio_at_1e-05" in names
    for name in names:
        known = np.isfinite(columns[name])
        assert known.sum() >= 100
        assert np.array_equal(np.isfinite(columns[f"{name}_stderr"]), known), name


def test_arrays_broadcast_and_jit_vmap_give_the_same_numbers() -> None:
    alphas, nus = np.array([0.2, 0.5, 0.9]), np.array([[0.3], [0.7]])
    answer = jg.validity(alphas, nus)
    assert answer.measured["pressure"].value.shape == answer.verdict().shape == (2, 3)
    compiled = jax.jit(jg.validity)(alphas, nus)
    mapped = jax.vmap(
        lambda nu: jax.vmap(lambda alpha: jg.validity(alpha, nu))(jnp.asarray(alphas))
    )(jnp.asarray(nus[:, 0]))
    for by_jax in (compiled, mapped):
        for a, b in zip(jax.tree.leaves(answer), jax.tree.leaves(by_jax), strict=True):
            # a variance is the difference of two numbers of order 500, and those of factors are of
            # order 1e-8
            np.testing.assert_allclose(np.broadcast_to(a, (2, 3)), b, rtol=VARIANCE_ROUNDING)


@pytest.mark.parametrize("name", ["local_granular_temperature", "force_ratio"])
def test_gradients_are_those_of_finite_differences(name: str) -> None:
    def of(x):
        return jg.validity(x[0], x[1]).measured[name].value

    at, step = jnp.array([0.45, 0.71]), 1e-4
    exact = jax.grad(of)(at)
    by_steps = [(of(at + step * axis) - of(at - step * axis)) / (2 * step) for axis in np.eye(2)]
    # truncation of step² over the range of the map squared
    np.testing.assert_allclose(exact, by_steps, rtol=1e-5)


def test_outside_the_range_is_refused_or_nan_where_jax_traces_it() -> None:
    with pytest.raises(
        jg.InputError, match=r"packing_fraction must be between 0.1 and 0.83, the range"
    ):
        jg.validity(0.5, [0.5, 0.84])
    end = jg.validity(np.float32(0.98), 0.5).measured["pressure"].value  # which is 0.98000001907
    assert end == jg.validity(0.98, 0.5).measured["pressure"].value
    for wrong in ("a", None, np.nan, []):
        with pytest.raises(jg.InputError, match="restitution must be between"):
            jg.validity(wrong, 0.5)
    values = jax.jit(jg.validity)(jnp.array([0.04, 0.5]), 0.5).measured["pressure"].value
    assert list(np.isnan(values)) == [True, False]
    slopes = jax.grad(lambda x: jnp.nansum(jg.validity(x, 0.5).measured["pressure"].value))(
        jnp.array([0.04, 0.5])
    )
    assert list(np.isnan(slopes)) == [True, False]  # no slope of 0 where nothing is known


def test_single_precision_is_refused_where_jax_traces() -> None:
    with jax.enable_x64(False), pytest.raises(jg.InputError, match="double precision"):
        jax.jit(jg.validity)(0.5, 0.5)


def made(
    error: float, ci95: float, ratio: float = 1.0, of_temperature: float = -0.1, **factors: float
) -> Validity:
    errors = {
        "pressure": Estimate(error, ci95),
        "local_granular_temperature": Estimate(of_temperature, 0.03),
    }
    all_factors = {name: Estimate(factors.get(name, 1.0), np.nan) for name in ASSUMPTIONS}
    ratios = {"force_ratio": Estimate(ratio, 0.001)}
    return Validity(0.5, 0.5, ratios, {}, errors, {}, {}, all_factors)


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        (
            made(-0.05, 0.02, chaos=0.8, pairs=1.1),
            (
                "pressure by 5.0 ± 2.0 % and the local temperature by 10.0 ± 3.0 %. The",
                "are independent: alone it makes Enskog's contact pressure 25 % too high",
                "all together make it 14 % too high at the",  # 1/(0.8 × 1.1)
                "binary (force ratio at most 1.001, dt",
            ),
        ),
        (
            made(0.2, 0.02, pairs=0.7),
            (
                "overestimates the pressure by 20.0 ± 2.0 % and underestimates the local",
                "as in equilibrium: alone it makes Enskog's contact pressure 43 % too high",
            ),
        ),
        (
            made(0.01, 0.02, of_temperature=0.02, anisotropy=1.1, pairs=1.05),
            (
                "agrees with the pressure (error 1.0 ± 2.0 %) and the local temperature (error 2.0",
                "comes from assuming that velocities are isotropic",
            ),
        ),
        (
            made(0.01, 0.02, of_temperature=0.1),
            (
                "and overestimates the local temperature by",
                "Each of its assumptions holds within 2 %; all together make Enskog's",
                "pressure right at",
            ),
        ),
        (
            made(-0.9, 0.02, 4.0, binary=8.0, pairs=5.0),
            ("that collisions are binary: alone", "explain 25 % of the mean contact force"),
        ),
    ],
)
def test_a_verdict_says_error_cause_and_share_of_binary_collisions(
    answer: Validity, said: tuple[str, ...]
) -> None:
    assert all(words in answer.verdict() for words in said)


def test_the_command_prints_the_numbers_of_python_without_loading_jax(tmp_path: Path) -> None:
    command = "import sys; from jaxgran.cli.app import app; "
    command += (
        "app('where --restitution 0.7 --packing-fraction 0.6 --json'.split(), "
        "standalone_mode=False); "
    )
    command += "assert 'jax' not in sys.modules and 'scipy' not in sys.modules"
    done = subprocess.run(
        [sys.executable, "-c", command], capture_output=True, text=True, cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr
    printed, answer = json.loads(done.stdout), jg.validity(0.7, 0.6)
    assert printed["verdict"]["value"] == answer.verdict()
    for name in MEASURED:
        value, ci95 = answer.measured[name]
        assert printed[name]["value"] == pytest.approx(value)
        assert printed[name]["ci95"] == pytest.approx(ci95, rel=VARIANCE_ROUNDING)


def test_the_command_says_the_verdict_and_every_average(tmp_path: Path) -> None:
    outcome = jaxgran(tmp_path, "where", "--restitution", "0.5", "--packing-fraction", "0.75")
    assert outcome.status == 0
    assert jg.validity(0.5, 0.75).verdict() in " ".join(outcome.out.split())
    assert all(name.replace("_", " ") in outcome.out for name in (*MEASURED, "force_ratio"))


PLANE = ("--restitution", "0.2,0.5", "--packing-fraction", "0.5:0.7:3")


def test_the_command_answers_for_every_pair_of_two_lists(tmp_path: Path) -> None:
    flows = jg.validity(*np.meshgrid([0.2, 0.5], [0.5, 0.6, 0.7]))
    table = jaxgran(tmp_path, "where", *PLANE, "--factors").out
    for estimate in (flows.measured["pressure"], flows.factors["chaos"]):
        for value, ci95 in zip(estimate.value.flat, estimate.ci95.flat, strict=True):
            assert in_brackets(value, ci95) in table
    printed = json.loads(jaxgran(tmp_path, "where", *PLANE, "--json").out)
    assert printed["packing_fraction"]["value"] == [0.5, 0.6, 0.7]
    np.testing.assert_array_equal(printed["error/pressure"]["value"], flows.error["pressure"].value)
    assert printed["verdict"]["value"] == flows.verdict().tolist()
    chaos = printed["factor/chaos"]
    np.testing.assert_array_equal(chaos["ci95"], flows.factors["chaos"].ci95)


def test_the_command_writes_the_law_of_python_and_replaces_no_file(tmp_path: Path) -> None:
    jg.constitutive_law().to_csv(tmp_path / "python.csv", [0.2, 0.5])
    words = ("where", "--restitution", "0.2,0.5", "--law", "shell.csv")
    outcome = jaxgran(tmp_path, *words)
    assert outcome == (0, "", "wrote shell.csv\n")
    assert (tmp_path / "shell.csv").read_bytes() == (tmp_path / "python.csv").read_bytes()
    assert "name another file, or pass --overwrite" in jaxgran(tmp_path, *words).err
    assert jaxgran(tmp_path, *words, "--overwrite").status == 0


def test_intervals_hold_on_fresh_flows_as_often_as_they_say(result: dict) -> None:
    """The committed coverage is that of this table, with 95 % within its binomial error."""
    fresh = json.loads((RESULTS / "reference_runs.json").read_text(encoding="utf-8"))["rows"]
    coverage = reference.coverage(list(reference.judged(shipped_table(), fresh)))
    for name, committed in result["coverage"].items():
        assert committed == pytest.approx(coverage[name], abs=2e-3)
        for kind in ("covered", "covered_narrow"):
            within = round(coverage[name][kind] * len(fresh))
            as_few = sum(comb(40, k) * 0.95**k * 0.05 ** (40 - k) for k in range(within + 1))
            assert len(fresh) == 40
            assert as_few > 0.025
