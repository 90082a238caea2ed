"""Errors of the theory, factors and shares of clusters are drawn at their places."""

from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from drawn import caption, contour_lines, write_without_drawing
from made_up_maps import (
    STDERR,
    assumption_of,
    closure_of,
    factor_of,
    ratio_dataset,
    temperature_factor_of,
    theory_dataset,
    with_grains,
    with_timesteps,
)

from jaxgran.plotting.factors import FACTORS, enskog_factors
from jaxgran.plotting.map_figures import save_figures
from jaxgran.plotting.ratio import ratio_contours, ratio_curves
from jaxgran.plotting.theory import ERROR_LEVELS, cluster_shares, error_parts, theory_errors

RATIOS = ratio_dataset(2, 2)


@pytest.mark.parametrize("quantity", ["pressure", "shear_stress"])
def test_errors_are_those_of_all_assumptions_and_of_the_binary_one(quantity: str) -> None:
    data = theory_dataset()
    parts = error_parts(data, quantity)
    x, nu = 1.0 - data.restitution.values[None, :], data.packing_fraction.values[:, None]
    binary, stderr = parts["binary"]
    np.testing.assert_allclose(binary, assumption_of(x, nu), atol=1e-14)
    np.testing.assert_allclose(parts["total"][0], binary + closure_of(x, nu), atol=1e-14)
    np.testing.assert_allclose(parts["total"][1], STDERR)
    changed = data.assign({"stresses/binary_stress": data["stresses/binary_stress"] * (1 - 1e-4)})
    slope = (error_parts(changed, quantity)["binary"][0] - binary) / 1e-4
    np.testing.assert_allclose(stderr, np.abs(slope) * STDERR, rtol=1e-3)


def test_errors_lie_on_their_isolines() -> None:
    grid = np.reshape(theory_errors(theory_dataset()).axes, (2, 2))
    laws = (lambda x, nu: assumption_of(x, nu) + closure_of(x, nu)), assumption_of
    for row in grid:
        for axes, law in zip(row, laws, strict=True):
            lines = contour_lines(axes, "black")
            corners = law(*np.meshgrid([0.1, 0.9], [0.3, 0.8]))
            reached = {
                level for level in ERROR_LEVELS.values() if corners.min() < level < corners.max()
            }
            assert set(lines) <= reached and len(lines) >= 3  # a short one lies under its label
            for level, vertices in lines.items():
                np.testing.assert_allclose(law(*vertices.T), level, atol=1e-9)


def test_factors_and_their_product_are_curves() -> None:
    data, alphas = theory_dataset(), (0.9, 0.5, 0.1)
    figure = enskog_factors(data)
    nu = data.packing_fraction.values
    for axes, alpha in zip(figure.axes, alphas, strict=True):
        assert axes.get_title() == rf"$\alpha={alpha:g}$"
        x = 1 - alpha + 0 * nu
        logs = [temperature_factor_of(x, nu), *(factor_of(k, x, nu) for k in range(len(FACTORS)))]
        for bars, log in zip(axes.containers, logs, strict=True):
            np.testing.assert_allclose(bars.lines[0].get_xydata(), np.stack([nu, np.exp(log)], -1))
        (product,) = (line for line in axes.lines if line.get_linewidth() == 2.2)
        np.testing.assert_allclose(product.get_ydata(), np.exp(np.sum(logs, axis=0)))


def test_shares_stand_at_their_excess_with_errors_in_both_directions() -> None:
    data = theory_dataset()
    axes = cluster_shares(data).axes[0]
    bars = axes.containers
    assert len(bars) == data.sizes["restitution"] and axes.get_xscale() == "log"
    drawn = np.array([c.lines[0].get_xydata() for c in bars])
    np.testing.assert_allclose(drawn[..., 0], (data.force_ratio - 1.0).T)
    np.testing.assert_allclose(drawn[..., 1], data["stresses/cluster_pressure_share"].T)
    across, along = (np.array([c.lines[2][k].get_segments() for c in bars]) for k in (0, 1))
    np.testing.assert_allclose(np.ptp(across[..., 0], axis=-1), 2.0 * data.force_ratio_stderr.T)
    np.testing.assert_allclose(np.ptp(along[..., 1], axis=-1), 0.06)


@pytest.mark.parametrize(
    "draw", [ratio_curves, ratio_contours, theory_errors, enskog_factors, cluster_shares]
)
def test_map_without_any_value_is_drawn(draw) -> None:
    data = theory_dataset()
    empty = data.assign({name: np.nan * data[name] for name in data if name != "status"})
    figure = draw(empty)
    figure.canvas.draw()
    assert "no measured values" in [text.get_text() for text in figure.axes[0].texts]


def test_captions_count_the_points_that_they_speak_of() -> None:
    data = theory_dataset(5, 6)
    shown = (data.restitution == 0.9) & (data.packing_fraction == 0.3)  # in all figures
    few = data.where(shown).assign(status=data.status)
    theory, factors, clusters = (
        caption(draw(few)) for draw in (theory_errors, enskog_factors, cluster_shares)
    )
    assert "of 1 measured point, " in theory and "of 1 measured point, " in factors
    assert "29 of 30 points without a value" in theory and clusters.count("29") == 1
    assert "of 18 measured points" in caption(enskog_factors(data))


@pytest.mark.parametrize(
    ("data", "names"),
    [
        (theory_dataset(3, 3), "curves contours theory factors clusters"),
        (theory_dataset(1, 3), "curves factors clusters"),
        (theory_dataset(3, 3).drop_vars("theory/pressure"), "curves contours clusters"),
        (with_timesteps(with_grains(RATIOS, 64, 256), 1e-3, 1e-4), "curves contours timestep size"),
    ],
    ids=["all", "line", "no theory", "several N and dt"],
)
def test_figures_are_written_where_the_map_has_their_data(
    data: xr.Dataset, names: str, tmp_path: Path, monkeypatch
) -> None:
    write_without_drawing(monkeypatch)
    written = save_figures(data, tmp_path / "map")
    assert [path.name for path in written] == [f"map_{name}.png" for name in names.split()]
    assert sorted(tmp_path.iterdir()) == sorted(written)
