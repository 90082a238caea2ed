"""The figure of the number of grains shows every average over its value at the largest N; other
figures show that N.
"""

from pathlib import Path

import numpy as np
import pytest
from drawn import write_without_drawing
from made_up_maps import ratio_dataset, with_grains, with_timesteps
from matplotlib.figure import Figure

from jaxgran.maps.schema import finest, parts
from jaxgran.plotting.map_figures import save_figures
from jaxgran.plotting.size import averages_against_grains

SIZES = (256, 1000, 4000)
NAMES = ("pressure", "shear_stress", "granular_temperature", "force_ratio")


def curves_of(figure: Figure) -> list:
    return [container for axes in figure.axes for container in axes.containers]


@pytest.mark.parametrize(("alphas", "nus"), [(2, 2), (4, 3)])
def test_every_average_is_drawn_over_its_value_at_the_largest_number_of_grains(
    alphas: int, nus: int
) -> None:
    data = with_grains(ratio_dataset(alphas, nus), *SIZES)
    figure = averages_against_grains(data.isel(grains=[1, 2, 0]))
    rows = nus if alphas * nus > 8 else 1
    assert len(figure.axes) == rows * len(NAMES)
    assert all(axes.get_xscale() == "log" for axes in figure.axes)
    points = [
        (nu, alpha) for nu in data.packing_fraction.values for alpha in data.restitution.values
    ]
    of_a_row = len(points) // rows
    expected = [
        (name, *point)
        for row in range(rows)
        for name in NAMES
        for point in points[row * of_a_row : (row + 1) * of_a_row]
    ]
    for container, (name, nu, alpha) in zip(curves_of(figure), expected, strict=True):
        point = data.sel(packing_fraction=nu, restitution=alpha)
        reference = point[name].values[-1]
        np.testing.assert_allclose(
            container.lines[0].get_xydata(), np.stack([SIZES, point[name] / reference], -1)
        )
        ends = np.array([segment[:, 1] for segment in container.lines[2][0].get_segments()])
        relative = point[f"{name}_stderr"].values / point[name].values
        of_both = np.sqrt(relative**2 + relative[-1] ** 2) * point[name].values / reference
        np.testing.assert_allclose(
            np.diff(ends)[:, 0], 2 * np.where(np.arange(len(SIZES)) < 2, of_both, 0.0)
        )


def test_parts_are_the_maps_at_every_number_of_grains_and_time_step() -> None:
    data = ratio_dataset(2, 2)
    several = with_timesteps(with_grains(data, *SIZES), 1e-3, 1e-4)
    found = [(part.attrs["grains"], part.attrs["timestep"]) for part in parts(several)]
    assert found == [(n, dt) for n in SIZES for dt in (1e-3, 1e-4)]
    assert all(set(part.sizes) == {"packing_fraction", "restitution"} for part in parts(several))
    assert parts(data)[0].identical(data)
    assert finest(several).identical(parts(several)[-1])
    assert set(finest(several, "grains").sizes) == {"timestep", "packing_fraction", "restitution"}


def test_several_numbers_of_grains_have_a_file_of_their_own(tmp_path: Path, monkeypatch) -> None:
    write_without_drawing(monkeypatch)
    written = save_figures(
        with_timesteps(with_grains(ratio_dataset(2, 2), 64, 256), 1e-3, 1e-4), tmp_path / "map"
    )
    assert [path.name for path in written] == [
        f"map_{name}.png" for name in ("curves", "contours", "timestep", "size")
    ]
    one = save_figures(with_grains(ratio_dataset(1, 2), 256), tmp_path / "one")
    assert [path.name for path in one] == ["one_curves.png"]
