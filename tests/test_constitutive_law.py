"""The constitutive law: scaling, balance of energy, derivatives, range, file and example."""

import re
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgran as jg
from jaxgran.reference.law import ConstitutiveLaw
from jaxgran.reference.table import LENGTH, MEASURED, read_columns

LAW = jg.constitutive_law()
PAGE = Path(__file__).parents[1] / "docs" / "how-to" / "constitutive-law.md"


def a_plane(rows: int = 15) -> tuple[np.ndarray, np.ndarray]:
    """Restitutions and packing fractions over the whole range."""
    return np.linspace(*LAW.restitution_range, rows)[:, None], np.linspace(
        *LAW.packing_fraction_range, rows
    )


@pytest.mark.parametrize("rate", [1e-3, 3.0, 1e3])
def test_bagnolds_scaling_is_exact(rate: float) -> None:
    slow, fast = LAW(*a_plane())._asdict(), LAW(*a_plane(), rate)._asdict()
    for name in MEASURED:
        power = 3 if name == "dissipation_rate" else 2
        expected = np.multiply(slow[name], rate**power)
        np.testing.assert_allclose(fast[name], expected, rtol=1e-14)
    np.testing.assert_array_equal(fast[LENGTH], slow[LENGTH])


def test_power_of_the_shear_is_dissipated_within_the_errors() -> None:
    rate = 2.0
    flow = LAW(*a_plane(), rate)
    loss, stress = flow.dissipation_rate, flow.shear_stress
    apart = np.abs(loss.value - stress.value * rate)
    assert np.all(apart < np.hypot(loss.ci95, stress.ci95 * rate))
    assert np.all(apart < 0.05 * loss.value)


slope = jax.jit(jax.grad(lambda x: LAW(x[0], x[1]).pressure.value))
hessian = jax.jit(jax.jacfwd(slope))


@pytest.mark.parametrize("at", [(0.5, 0.6), (0.9, 0.7), (0.47, 0.61)])
def test_second_derivatives_are_those_of_finite_differences(at: tuple[float, float]) -> None:
    """At a point of the reference map, and between its points."""
    change, e = np.eye(2), 1e-3
    differences = [(slope(at + e * x) - slope(at - e * x)) / (2 * e) for x in change]
    np.testing.assert_allclose(hessian(jnp.array(at)), differences, rtol=2e-3, atol=0.1)


def test_long_waves_raise_the_granular_temperature() -> None:
    flow = LAW(*a_plane())
    highest = flow.granular_temperature.value + flow.granular_temperature.ci95
    assert np.all(flow.local_granular_temperature.value < highest)


def test_correlations_vanish_towards_elastic_grains_and_grow_with_dissipation() -> None:
    nus = a_plane()[1]
    nus = nus[nus < 0.7]
    lengths = [LAW(alpha, nus)._asdict()[LENGTH].value for alpha in (0.98, 0.8, 0.5, 0.2)]
    np.testing.assert_allclose(lengths[0], 1, atol=0.02)
    assert np.all(np.diff(lengths, axis=0) > 0)


def test_length_follows_from_correlated_velocities_where_collisions_are_binary() -> None:
    """An approach slower by a factor f has f² of the pressure and f³ of the loss: L′ = 1/f."""
    alphas, nus = (x.ravel() for x in np.broadcast_arrays(*a_plane()))
    answer = jg.validity(alphas, nus)
    binary = answer.measured["force_ratio"].value < 1.01
    length = LAW(alphas, nus)._asdict()[LENGTH].value
    product = (length * np.sqrt(answer.factors["chaos"].value))[binary]
    assert binary.sum() > 100
    assert np.all((product > 0.97) & (product < 1.05))


@pytest.mark.parametrize(
    ("name", "part"),
    [(x, "value") for x in ("pressure", "shear_stress", "dissipation_rate", LENGTH)]
    + [("pressure", "ci95")],
)
def test_gradients_are_those_of_finite_differences(name: str, part: str) -> None:
    def of(x: Any) -> Any:
        return getattr(getattr(LAW(x[0], x[1], x[2]), name), part)

    def difference(axis: np.ndarray) -> Any:
        return of(at + axis) - of(at - axis)

    at, step = jnp.array([0.45, 0.71, 1.3]), 1e-3  # of fourth-order differences
    by_steps = [
        (8 * difference(step * axis) - difference(2 * step * axis)) / (12 * step)
        for axis in np.eye(3)
    ]
    # an interval is the root of a difference of numbers of order 500, whose rounding a difference
    # over steps magnifies
    rtol = 1e-4 if part == "ci95" else 1e-5
    np.testing.assert_allclose(jax.grad(of)(at), by_steps, rtol=rtol, atol=1e-8)


def test_arrays_broadcast_with_the_shear_rate() -> None:
    alphas, nus, rates = np.array([[0.3], [0.6]]), np.array([0.2, 0.5, 0.7]), [1.0, 2.0, 3.0]
    flow, compiled = LAW(alphas, nus, rates), jax.jit(LAW)(alphas, nus, np.array(rates))
    averages, half_widths = np.stack(flow, axis=1)
    same, same_half_widths = np.stack(compiled, axis=1)
    assert averages.shape[1:] == (2, 3)
    np.testing.assert_allclose(averages, same, rtol=1e-7)
    # small differences
    np.testing.assert_allclose(half_widths / averages, same_half_widths / averages, atol=1e-6)
    assert flow.pressure.value[1, 2] == pytest.approx(LAW(0.6, 0.7, 3.0).pressure.value)


def test_the_range_ends_where_it_says() -> None:
    (low, high), (loose, dense) = LAW.restitution_range, LAW.packing_fraction_range
    assert np.all(np.isfinite(LAW([low, high], [loose, dense]).pressure))
    for alpha, nu in ((low - 1e-6, loose), (high + 1e-6, dense), (low, dense + 1e-6)):
        with pytest.raises(jg.InputError, match="the range of the reference map"):
            LAW(alpha, nu)
        assert np.all(np.isnan(jax.jit(LAW)(alpha, nu)))
        for derivative in (jax.grad, jax.jacfwd):
            assert np.isnan(derivative(lambda *x: LAW(*x).pressure.value, (0, 1))(alpha, nu)).all()
    for rate in (0.0, -1.0, np.inf, "1"):
        with pytest.raises(jg.InputError, match="shear_rate must be a positive number"):
            LAW(0.5, 0.5, rate)
    with jax.enable_x64(False), pytest.raises(jg.InputError, match="double precision"):
        jax.jit(lambda rate: LAW(0.5, 0.5, rate))(1.0)


def test_the_file_is_the_law_at_its_points_and_says_what_it_is(tmp_path: Path) -> None:
    LAW.to_csv(tmp_path / "law.csv")
    head, columns = read_columns(tmp_path / "law.csv")
    flows = columns["restitution"], columns["packing_fraction"]
    for name, (value, ci95) in LAW(*flows)._asdict().items():
        np.testing.assert_allclose(columns[name], value, rtol=1e-5)
        np.testing.assert_allclose(columns[f"{name}_ci95"], ci95, rtol=1e-5)
    ranges = LAW.restitution_range, LAW.packing_fraction_range
    assert [(x.min(), x.max()) for x in flows] == [*ranges]
    assert head["version"] == jg.__version__
    units = {f"unit of {x}" for x in (*MEASURED, LENGTH)}
    assert {"maps", "grains", "timestep", "ci95", "units"} | units <= {*head}
    with pytest.raises(jg.InputError, match=r"law\.csv' already exists"):
        LAW.to_csv(tmp_path / "law.csv", [0.5, 0.6], [0.7])
    LAW.to_csv(tmp_path / "law.csv", [0.5, 0.6], [0.7], overwrite=True)
    assert read_columns(tmp_path / "law.csv")[1]["restitution"].tolist() == [0.5, 0.6]
    text = (tmp_path / "law.csv").read_text(encoding="utf-8")
    (tmp_path / "law.csv").write_text(
        text.replace("format_version: 1", "format_version: 7"), encoding="utf-8"
    )
    with pytest.raises(jg.InputError, match="reads format_version 1"):
        read_columns(tmp_path / "law.csv")


def test_the_layer_of_the_page_is_in_mechanical_balance(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        for block in re.findall(
            r"^```python\n(.*?)^```$", PAGE.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL
        ):
            exec(block, names)
        stress, gravity, pressures = 0.3, 0.05, jnp.linspace(1.0, 1.2, 200)
        depth, velocity, nu, temperature = names["layer"](0.6, pressures, stress, gravity)
        weight = np.gradient(pressures, depth)
        flow = LAW(0.6, np.asarray(nu), np.abs(np.gradient(velocity, depth)))
    np.testing.assert_allclose(weight, gravity * 4 / np.pi * nu, rtol=1e-3)
    inner = slice(1, -1)  # one-sided differences are of first order
    np.testing.assert_allclose(flow.pressure.value[inner], pressures[inner], rtol=1e-3)
    np.testing.assert_allclose(flow.shear_stress.value[inner], stress, rtol=1e-3)
    np.testing.assert_allclose(
        flow.granular_temperature.value[inner], temperature[inner], rtol=1e-3
    )
    dense = names["at_pressure"](20.0, 0.6, 1.5)
    assert LAW(0.6, float(dense), 1.5).pressure.value == pytest.approx(20.0)
    slope = jax.grad(lambda nu: LAW(0.6, nu, 1.5).pressure.value)(dense)
    assert jax.grad(names["at_pressure"])(20.0, 0.6, 1.5) == pytest.approx(float(1 / slope))


def test_the_law_is_a_value_that_jit_and_vmap_take() -> None:
    assert jax.tree.leaves(LAW) == []
    traced = []

    @jax.jit
    def pressures(law: ConstitutiveLaw, nus: Any, rate: Any) -> Any:
        traced.append(law)
        return jax.vmap(law, (None, 0, None))(0.6, nus, rate).pressure.value

    nus = jnp.array([0.3, 0.7])
    for law in (LAW, jg.constitutive_law()):
        np.testing.assert_allclose(
            pressures(law, nus, 2.0), LAW(0.6, nus, 2.0).pressure.value, rtol=1e-9
        )
    assert len(traced) == 1  # equal laws are one to the cache
