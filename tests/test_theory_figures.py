"""Errors of the theory, shares of the clusters and laws of dense flow are drawn as numbers at their
places.
"""

from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from drawn import contour_lines, write_without_drawing
from made_up_maps import (
    STDERR,
    assumption_of,
    closure_of,
    factor_of,
    theory_dataset,
)
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxgran.plotting.enskog_factors import LENGTH_PANEL, PANELS, enskog_factors
from jaxgran.plotting.map_figures import save_figures
from jaxgran.plotting.ratio import ratio_contours, ratio_curves
from jaxgran.plotting.theory import ERROR_LEVELS, cluster_shares, error_parts, theory_errors


def panel(figure: Figure, name: str) -> Axes:
    """Return the axes of the shares of pressure "p" or shear stress "s", or those of the map
    "m".
    """
    return {axes.get_label(): axes for axes in figure.axes}[name]


# ----------------------------------------------------------------------------------------------
# theory


@pytest.mark.parametrize("quantity", ["pressure", "shear_stress"])
def test_error_is_that_of_the_assumption_plus_that_of_the_closure(quantity: str) -> None:
    data = theory_dataset()
    parts = {name: value for name, (value, _) in error_parts(data, quantity).items()}
    x, nu = 1.0 - data.restitution.values[None, :], data.packing_fraction.values[:, None]
    np.testing.assert_allclose(parts["total"], parts["assumption"] + parts["closure"], atol=1e-14)
    np.testing.assert_allclose(parts["assumption"], assumption_of(x, nu), atol=1e-14)
    np.testing.assert_allclose(parts["closure"], closure_of(x, nu), atol=1e-14)


def test_standard_error_of_the_assumption_is_that_of_the_stress_ratio() -> None:
    data = theory_dataset()
    data["stress_ratio"][..., 0, 1] = -2.0  # the other component, and its sign, do not matter
    value, error = error_parts(data, "pressure")["assumption"]
    changed = data.assign({"stresses/binary_stress": data["stresses/binary_stress"] / (1.0 + 1e-4)})
    slope = (error_parts(changed, "pressure")["assumption"][0] - value) / 1e-4
    np.testing.assert_allclose(error, np.abs(slope) * STDERR, rtol=1e-3)
    _, shear_error = error_parts(data, "shear_stress")["assumption"]
    np.testing.assert_allclose(shear_error, error / 2.0)


def test_errors_lie_on_their_isolines() -> None:
    grid = np.reshape(theory_errors(theory_dataset()).axes, (2, 3))
    laws = (lambda x, nu: assumption_of(x, nu) + closure_of(x, nu)), assumption_of, closure_of
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


# ----------------------------------------------------------------------------------------------
# factors


def test_factors_lie_on_their_isolines() -> None:
    figure = enskog_factors(theory_dataset())
    assert [axes.get_title() for axes in figure.axes] == [*PANELS.values(), LENGTH_PANEL]
    for k, axes in enumerate(figure.axes):
        corners = factor_of(k, *np.meshgrid([0.1, 0.9], [0.3, 0.8]))
        lines = contour_lines(axes, "black")
        reached = {
            level for level in ERROR_LEVELS.values() if corners.min() < level < corners.max()
        }
        assert set(lines) <= reached and len(lines) >= min(
            1, len(reached)
        )  # a short one lies under its label
        for level, vertices in lines.items():
            np.testing.assert_allclose(factor_of(k, *vertices.T), level, atol=1e-9)


# --------------------------------------------------------------------------------------------
# clusters


def test_shares_stand_at_their_excess_with_errors_in_both_directions() -> None:
    data = theory_dataset()
    data["stresses/cluster_shear_share"] = 0.9 * data["stresses/cluster_shear_share"]
    figure = cluster_shares(data)
    for axes, name in (
        (panel(figure, "p"), "stresses/cluster_pressure_share"),
        (panel(figure, "s"), "stresses/cluster_shear_share"),
    ):
        bars = axes.containers
        assert len(bars) == data.sizes["restitution"] and axes.get_xscale() == "log"
        drawn = np.array([c.lines[0].get_xydata() for c in bars])
        np.testing.assert_allclose(drawn[..., 0], (data.force_ratio - 1.0).T)
        np.testing.assert_allclose(drawn[..., 1], data[name].T)
        across, along = (np.array([c.lines[2][k].get_segments() for c in bars]) for k in (0, 1))
        np.testing.assert_allclose(np.ptp(across[..., 0], axis=-1), 2.0 * data.force_ratio_stderr.T)
        np.testing.assert_allclose(np.ptp(along[..., 1], axis=-1), 0.06)
        left, right = axes.get_xlim()
        assert left < drawn[..., 0].min() and drawn[..., 0].max() < right


# ---------------------------------------------------------------------------------------------
# together


@pytest.mark.parametrize(
    "draw", [ratio_curves, ratio_contours, theory_errors, enskog_factors, cluster_shares]
)
def test_map_without_any_value_is_drawn(draw) -> None:
    data = theory_dataset()
    empty = data.assign({name: np.nan * data[name] for name in data if name != "status"})
    figure = draw(empty)
    figure.canvas.draw()
    assert "no measured values" in [text.get_text() for text in figure.axes[0].texts]


@pytest.mark.parametrize(
    ("data", "names"),
    [
        (theory_dataset(3, 3), ["curves", "contours", "theory", "factors", "clusters"]),
        (theory_dataset(1, 3), ["curves", "clusters"]),
        (
            theory_dataset(3, 3).drop_vars("theory/pressure"),
            ["curves", "contours", "factors", "clusters"],
        ),
        (
            theory_dataset(3, 3).drop_vars(
                "theory/enskog_factor_pressure_local_temperature"
            ),  # made before
            ["curves", "contours", "theory", "clusters"],
        ),
    ],
    ids=["all", "line", "no theory", "no factors"],
)
def test_figures_are_written_where_the_map_has_their_data(
    data: xr.Dataset, names: list[str], tmp_path: Path, monkeypatch
) -> None:
    write_without_drawing(monkeypatch)
    written = save_figures(data, tmp_path / "map")
    assert [path.name for path in written] == [f"map_{name}.png" for name in names]
    assert sorted(tmp_path.iterdir()) == sorted(written)
