"""The figures show the map: contours where the excess has its level, error bars, whole files."""

from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from drawn import contour_lines
from made_up_maps import RATE, excess_of, ratio_dataset, theory_dataset, with_grains, with_timesteps
from matplotlib import _pylab_helpers, rc_context, rcParams
from matplotlib.colors import same_color
from matplotlib.container import ErrorbarContainer
from matplotlib.contour import QuadContourSet
from matplotlib.figure import Figure
from matplotlib.image import imread

from jaxgran.page.map_data import map_data
from jaxgran.plotting.map_figures import FIGURES, save_figures
from jaxgran.plotting.plane import EXCESS_LEVELS, STANDARD_ERROR
from jaxgran.plotting.ratio import ratio_contours, ratio_curves


def bands_of_contours(figure: Figure) -> list[np.ndarray]:
    """Return the vertices of the bands of the standard error."""
    sets = [
        artist
        for artist in figure.axes[0].collections
        if isinstance(artist, QuadContourSet)
        and artist.filled
        and same_color(artist.get_facecolor()[0], STANDARD_ERROR["color"])
    ]
    return [np.asarray(artist.get_paths()[0].vertices) for artist in sets]


def error_bars(figure: Figure, panel: int = 0) -> list[np.ndarray]:
    """Return the lower and upper ends of the error bars, an array (points, 2) for each curve."""
    containers = [c for c in figure.axes[panel].containers if isinstance(c, ErrorbarContainer)]
    return [np.array([s[:, 1] for s in c.lines[2][0].get_segments() if len(s)]) for c in containers]


def with_stress_ratio(data: xr.Dataset) -> xr.Dataset:
    """Return the map with a ratio of stresses of twice the excess in component xy."""
    factors = xr.DataArray([[1.0, 2.0], [2.0, 1.0]], dims=("axis_a", "axis_b"))
    ratio, error = 1.0 + (data.force_ratio - 1.0) * factors, data.force_ratio_stderr * factors
    return data.assign(stress_ratio=ratio, stress_ratio_stderr=error)


def test_contours_lie_on_the_isolines() -> None:
    alphas, nus = 5, 6
    figure = ratio_contours(ratio_dataset(alphas, nus))
    lines = contour_lines(figure.axes[0], "black").values()
    cell = 0.8 / (alphas - 1) + 2.0 * 0.5 / (nus - 1)  # change of 1 − α + 2ν across one cell
    for level, vertices in zip(EXCESS_LEVELS, lines, strict=True):
        assert len(vertices) > 1
        error = np.log(excess_of(1.0 - vertices[:, 0], vertices[:, 1]) / level) / RATE
        assert np.abs(error).max() < 0.1 * cell**2  # linear interpolation is of second order


def test_band_spans_one_standard_error() -> None:
    relative_error = 0.2
    figure = ratio_contours(ratio_dataset(10, 12, relative_error))
    bands = bands_of_contours(figure)
    assert len(bands) == len(EXCESS_LEVELS)
    for level, vertices in zip(EXCESS_LEVELS, bands, strict=True):
        ratio = excess_of(1.0 - vertices[:, 0], vertices[:, 1]) / level
        assert ratio.min() == pytest.approx(1.0 / (1.0 + relative_error), rel=0.05)
        assert ratio.max() == pytest.approx(1.0 / (1.0 - relative_error), rel=0.05)


def test_error_bars_are_standard_errors_and_the_shear_stress_ratio_has_a_panel() -> None:
    data = with_stress_ratio(ratio_dataset())
    figure = ratio_curves(data.transpose(..., "restitution", "packing_fraction"))
    shear = data.isel(axis_a=0, axis_b=1)
    for panel, name in enumerate(("force_ratio", "stress_ratio")):
        value, error = shear[name].values.T, shear[f"{name}_stderr"].values.T
        expected = np.stack([value - error, value + error], axis=-1)
        np.testing.assert_allclose(error_bars(figure, panel), expected, rtol=1e-12)


@pytest.mark.parametrize("name", ["restitution", "packing_fraction"])
def test_a_coordinate_of_one_value_is_drawn_as_an_axis_of_one_value(name: str) -> None:
    data = with_stress_ratio(ratio_dataset()).isel({name: [2]})
    drawn, expected = (ratio_curves(x)._repr_png_() for x in (data.squeeze(name), data))
    assert drawn == expected
    assert map_data(data.squeeze(name)) == map_data(data)


@pytest.mark.parametrize(
    ("format", "start"), [("png", b"\x89PNG"), ("pdf", b"%PDF"), ("svg", b"<?xml")]
)
def test_the_same_map_gives_the_same_bytes_in_every_format(format, start, tmp_path: Path) -> None:
    first, second = (
        save_figures(ratio_dataset(1, 2), tmp_path / name, format, dpi=50)[0]
        for name in ("first", "second")
    )
    assert first.name == f"first_curves.{format}"
    assert first.read_bytes().startswith(start) and first.read_bytes() == second.read_bytes()


@pytest.mark.parametrize("name", FIGURES)
def test_nothing_leaves_the_canvas(name: str) -> None:
    data = with_timesteps(with_grains(theory_dataset(), 64, 256, 1024), 1e-3, 1e-4)
    figure = FIGURES[name].draw(data)
    figure.draw_without_rendering()  # which lays it out
    drawn = figure.get_tightbbox()
    assert np.all(drawn.min >= 0) and np.all(drawn.max <= figure.get_size_inches())


def test_a_picture_has_the_resolution_asked_for(tmp_path: Path) -> None:
    sizes = [
        imread(save_figures(ratio_dataset(1), tmp_path / "map", dpi=dpi)[0]).shape[:2]
        for dpi in (100, 50)
    ]
    np.testing.assert_allclose(sizes[0], 2 * np.array(sizes[1]), atol=1)


def test_figures_take_no_style_of_the_user_and_change_none(tmp_path: Path) -> None:
    save_figures(ratio_dataset(3, 3), tmp_path / "map")
    with rc_context({"text.usetex": True, "savefig.bbox": "tight"}):
        before = dict(rcParams)
        save_figures(ratio_dataset(3, 3), tmp_path / "tex")
        assert dict(rcParams) == before and not _pylab_helpers.Gcf.get_all_fig_managers()
    for name in ("curves", "contours"):
        same = (tmp_path / f"{x}_{name}.png" for x in ("tex", "map"))
        assert len({path.read_bytes() for path in same}) == 1
