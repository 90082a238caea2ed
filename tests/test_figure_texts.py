"""Every figure of a map can be read: no text leaves the canvas, and none lies on another one."""

from io import BytesIO
from itertools import combinations

import numpy as np
import pytest
import xarray as xr
from made_up_maps import theory_dataset, with_grains, with_timesteps
from matplotlib.backend_bases import RendererBase
from matplotlib.figure import Figure
from matplotlib.path import Path
from matplotlib.text import Text
from matplotlib.transforms import Bbox

from jaxgran.plotting.map_figures import FIGURES
from jaxgran.plotting.selection import points

GAP = np.array(
    [1.0, -1.0]
)  # points between texts, beside and above each other: boxes are higher than their letters


def with_faults(data: xr.Dataset) -> xr.Dataset:
    """The map with a point of each bad status, the last of which have no value."""
    data = data.copy(deep=True)
    for k in range(1, 7):
        data.status[k % data.sizes["packing_fraction"], k % data.sizes["restitution"]] = k
    return data.assign(
        {name: data[name].where(data.status < 5) for name in data if name != "status"}
    )


def with_errors(data: xr.Dataset, share: float) -> xr.Dataset:
    """The map with standard errors that are this share of its excess and its averages."""
    stderrs = {
        name: share * abs(data[name.removesuffix("_stderr")])
        for name in map(str, data)
        if "_stderr" in name
    }
    return data.assign(stderrs | {"force_ratio_stderr": share * (data.force_ratio - 1.0)})


MAPS = {
    "quick": theory_dataset(5, 6),
    "paper": theory_dataset(10, 12),
    "one column": theory_dataset(1, 6),
    "twelve curves": with_faults(theory_dataset(12, 3)),
    "errors of 300 %": with_errors(theory_dataset(5, 6), 3.0),
}


def drawn_texts(figure: Figure, dpi: int) -> dict[Text, tuple[Bbox, Path]]:
    """The texts that are drawn, each with its extent and the rectangle around it, turned as it
    is, in pixels.
    """
    texts: dict[Text, tuple[Bbox, Path]] = {}

    def note(self: Text, renderer: RendererBase) -> None:
        if self.get_visible() and self.get_text().strip():
            texts[self] = self.get_window_extent(renderer), box_of(self)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Text, "draw", note)
        figure.savefig(BytesIO(), format="png", dpi=dpi)
    return texts


def box_of(text: Text) -> Path:
    """The corners of the rectangle around a text: that of the upright text, turned about its
    centre.
    """
    around, angle = text.get_window_extent(), np.radians(text.get_rotation())
    turned = text.get_transform_rotates_text()
    text.set(rotation=0, transform_rotates_text=False)
    size = np.array(text.get_window_extent().size)
    text.set(rotation=np.degrees(angle), transform_rotates_text=turned)
    middle = np.array([around.x0 + around.x1, around.y0 + around.y1]) / 2
    corners = (
        np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) / 2 * (size + GAP * text.figure.dpi / 72)
    )
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    return Path([*(middle + corners @ turn), middle], closed=True)


def unreadable(figure: Figure, dpi: int) -> list[str]:
    """The texts that leave the canvas, and the pairs that overlap."""
    texts, size = drawn_texts(figure, dpi), dpi * figure.get_size_inches()
    problems = [
        f"{text.get_text()!r} leaves the canvas"
        for text, (extent, _) in texts.items()
        if not ((extent.min >= 0) & (extent.max <= size)).all()
    ]
    return problems + [
        f"{one.get_text()!r} on {other.get_text()!r}"
        for one, other in combinations(texts, 2)
        if texts[one][1].intersects_path(texts[other][1], filled=True)
    ]


@pytest.mark.parametrize("name", FIGURES)
@pytest.mark.parametrize("kind", MAPS)
def test_every_text_is_inside_the_canvas_and_on_no_other_text(kind: str, name: str) -> None:
    data = MAPS[kind]
    if name in ("timestep", "size"):
        data = with_timesteps(with_grains(data, 64, 256, 1024, 4096), 1e-3, 3e-4, 1e-4)
    if not FIGURES[name].is_possible(points(data)):
        pytest.skip("this map has no such figure")
    figure = FIGURES[name].draw(data)
    assert len(figure.axes) <= 6
    assert unreadable(figure, dpi=100) == []  # it is laid out for another resolution


@pytest.mark.parametrize("name", FIGURES)
def test_the_line_of_value_one_has_a_number_at_its_axis(name: str) -> None:
    data = with_timesteps(with_grains(theory_dataset(5, 6), 64, 256), 1e-3, 3e-4)
    for axes in FIGURES[name].draw(data).axes:
        if any(np.array_equal(line.get_ydata(), [1, 1]) for line in axes.lines):
            low, high = axes.get_ylim()
            assert low < 1 < high and np.isclose(axes.get_yticks(), 1).any()


@pytest.mark.parametrize("name", ["contours", "theory"])
def test_no_label_of_a_contour_lies_on_a_ring_or_the_frame(name: str) -> None:
    data = with_faults(theory_dataset(5, 6))
    x, y = np.meshgrid(1 - data.restitution, data.packing_fraction)
    rings = np.stack([x, y], -1)[((data.status > 0) & (data.status < 5)).values]
    figure = FIGURES[name].draw(data)
    figure.draw_without_rendering()
    labels = 0
    for axes in figure.axes:
        frame = axes.get_window_extent()
        for text in axes.texts:
            box = box_of(text)
            assert frame.containsx(box.vertices[:, 0].min()), text.get_text()
            assert (box.vertices >= frame.min).all() and (box.vertices <= frame.max).all()
            assert not box.contains_points(axes.transData.transform(rings)).any(), text.get_text()
            labels += 1
    assert labels
