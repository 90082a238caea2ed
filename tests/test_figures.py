"""The figures show the map: contours where the excess has its level, error bars, marks, and whole
files.
"""

from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from drawn import contour_lines
from made_up_maps import RATE, excess_of, ratio_dataset
from matplotlib import _pylab_helpers, rc_context, rcParams
from matplotlib.colors import same_color
from matplotlib.container import ErrorbarContainer
from matplotlib.contour import QuadContourSet
from matplotlib.figure import Figure
from matplotlib.image import imread

from jaxgran.page.map_data import map_data
from jaxgran.plotting.map_figures import save_figures
from jaxgran.plotting.plane import EXCESS_LEVELS, STANDARD_ERROR
from jaxgran.plotting.ratio import ratio_contours, ratio_curves


def lines_of_contours(figure: Figure) -> dict[float, np.ndarray]:
    """Return the vertices (1 − α, ν) of every contour, by its excess."""
    return dict(zip(EXCESS_LEVELS, contour_lines(figure.axes[0], "black").values(), strict=True))


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
    """Return the map with a ratio of the stresses whose excess is twice that of the force ratio in
    component xy.
    """
    factors = xr.DataArray([[1.0, 2.0], [2.0, 1.0]], dims=("axis_a", "axis_b"))
    ratio, error = 1.0 + (data.force_ratio - 1.0) * factors, data.force_ratio_stderr * factors
    return data.assign(stress_ratio=ratio, stress_ratio_stderr=error)


def test_a_users_style_for_tex_is_not_that_of_the_figures(tmp_path: Path) -> None:
    with rc_context({"text.usetex": True, "savefig.bbox": "tight"}):
        save_figures(ratio_dataset(3, 3), tmp_path / "tex")
    save_figures(ratio_dataset(3, 3), tmp_path / "map")
    for name in ("curves", "contours"):
        same = (tmp_path / f"{x}_{name}.png" for x in ("tex", "map"))
        assert len({path.read_bytes() for path in same}) == 1


def test_contours_lie_on_the_isolines() -> None:
    alphas, nus = 5, 6
    lines = lines_of_contours(ratio_contours(ratio_dataset(alphas, nus)))
    assert set(lines) == set(EXCESS_LEVELS)
    cell = 0.8 / (alphas - 1) + 2.0 * 0.5 / (nus - 1)  # change of 1 − α + 2ν across one cell
    for level, vertices in lines.items():
        assert len(vertices) > 1
        error = np.log(excess_of(1.0 - vertices[:, 0], vertices[:, 1]) / level) / RATE
        assert np.abs(error).max() < 0.1 * cell**2  # linear interpolation is of second order


def test_a_value_without_a_known_error_is_measured() -> None:
    data = ratio_dataset(5, 6)
    data.force_ratio_stderr.values[0, 0] = np.nan
    (legend,) = ratio_contours(data).legends
    labels = [text.get_text() for text in legend.get_texts()]
    assert "measured" in labels and "no value" not in labels


def test_band_spans_one_standard_error() -> None:
    relative_error = 0.2
    figure = ratio_contours(ratio_dataset(10, 12, relative_error))
    bands = bands_of_contours(figure)
    assert len(bands) == len(EXCESS_LEVELS)
    for level, vertices in zip(EXCESS_LEVELS, bands, strict=True):
        ratio = excess_of(1.0 - vertices[:, 0], vertices[:, 1]) / level
        assert ratio.min() == pytest.approx(1.0 / (1.0 + relative_error), rel=0.05)
        assert ratio.max() == pytest.approx(1.0 / (1.0 - relative_error), rel=0.05)


def test_error_bars_have_the_length_of_the_standard_error() -> None:
    data = ratio_dataset()
    bars = error_bars(ratio_curves(data))
    assert len(bars) == data.sizes["restitution"]
    for alpha, ends in zip(data.restitution, bars, strict=True):
        curve = data.sel(restitution=alpha)
        expected = curve.force_ratio.values[:, None] + curve.force_ratio_stderr.values[:, None] * [
            -1.0,
            1.0,
        ]
        np.testing.assert_allclose(ends, expected, rtol=1e-12)


def test_curves_of_the_shear_stress_ratio_have_a_panel_on_the_scale_of_the_force_ratio() -> None:
    data = with_stress_ratio(ratio_dataset())
    figure = ratio_curves(data.transpose(..., "restitution", "packing_fraction"))
    assert figure.axes[0].get_ylim() == figure.axes[1].get_ylim()
    for k, ends in enumerate(error_bars(figure, panel=1)):
        shear, error = (
            data.stress_ratio[:, k, 0, 1].values,
            data.stress_ratio_stderr[:, k, 0, 1].values,
        )
        np.testing.assert_allclose(ends, shear[:, None] + error[:, None] * [-1.0, 1.0], rtol=1e-12)


@pytest.mark.parametrize("name", ["restitution", "packing_fraction"])
def test_a_coordinate_of_one_value_is_drawn_as_an_axis_of_one_value(name: str) -> None:
    data = with_stress_ratio(ratio_dataset()).isel({name: [2]})
    drawn, expected = (ratio_curves(x)._repr_png_() for x in (data.squeeze(name), data))
    assert drawn == expected
    assert map_data(data.squeeze(name)) == map_data(data)


@pytest.mark.parametrize(
    ("format", "start"), [("png", b"\x89PNG"), ("pdf", b"%PDF"), ("svg", b"<?xml")]
)
def test_the_same_map_gives_the_same_bytes_in_every_format(
    format, start: bytes, tmp_path: Path
) -> None:
    files = [
        save_figures(ratio_dataset(1, 2), tmp_path / name, format, dpi=50)[0]
        for name in ("first", "second")
    ]
    assert [path.name for path in files] == [
        f"{name}_curves.{format}" for name in ("first", "second")
    ]
    first, second = (path.read_bytes() for path in files)
    assert first.startswith(start) and first == second


def test_a_picture_has_the_resolution_asked_for(tmp_path: Path) -> None:
    sizes = [
        imread(save_figures(ratio_dataset(1), tmp_path / "map", dpi=dpi)[0]).shape[:2]
        for dpi in (100, 50)
    ]
    np.testing.assert_allclose(sizes[0], 2 * np.array(sizes[1]), atol=1)


def test_failed_write_keeps_the_old_file(tmp_path: Path, monkeypatch) -> None:
    (tmp_path / "map_curves.png").write_text("old")

    def broken(self: Figure, name: Path, **_: object) -> None:
        Path(name).write_text("half")
        raise OSError("disc full")

    monkeypatch.setattr(Figure, "savefig", broken)
    with pytest.raises(OSError, match="disc full"):
        save_figures(ratio_dataset(), tmp_path / "map")
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [
        ("map_curves.png", "old")
    ]


def test_global_plotting_state_is_untouched(tmp_path: Path) -> None:
    before = dict(rcParams)
    save_figures(ratio_dataset(), tmp_path / "map")
    assert dict(rcParams) == before
    assert not _pylab_helpers.Gcf.get_all_fig_managers()


def test_a_notebook_shows_a_figure_though_no_plotting_state_exists() -> None:
    figure = ratio_contours(ratio_dataset())
    assert figure._repr_png_().startswith(b"\x89PNG")
