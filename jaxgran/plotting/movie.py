"""Movies of one or more flows beside each other, as GIF or MP4.

Frames are stored while a flow runs (``Recorder``) and drawn after its end. Only then are the
largest speed and the largest force known, which set the scale of colours and widths in all frames.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.animation import FFMpegWriter
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from PIL import Image

from jaxgran.analysis.contacts import ForceNetwork
from jaxgran.dynamics.snapshot import Snapshot
from jaxgran.files import atomic_write
from jaxgran.io.paths import require_place
from jaxgran.model.checks import InputError, short_repr
from jaxgran.plotting.encoding import BINARY_COLOUR
from jaxgran.plotting.flow import (
    COLOURS,
    common_scale,
    draw_flow,
    force_key,
    network_of,
    show_flow,
    title_of,
)
from jaxgran.plotting.style import empty_figure, styled

MOST_DRAWN = 500  # frames of a movie, which are held in memory while it is written
_WIDTH, _WIDEST = 7.6, 4.6  # inches, of several flows together and of a single one
_MARGIN = 0.1  # inches, around a flow
_HEAD, _FOOT = 0.4, 0.3  # inches, of the titles above and the legend below
_DPI = 96  # pixels per inch
_FRAMES_PER_SECOND = 12
_SHADES = 8, 12, 4, 4  # colours of each ramp in the palette of a GIF; more make a larger file
_Follow = Callable[[Sequence], Iterable]  # passes items on, and may report how many are done


class Frame(NamedTuple):
    """A flow at one time."""

    network: ForceNetwork
    title: str
    strain: float  # since the first frame


class Frames:
    """The frames of a movie, kept as they are recorded; a recording that starts again at step 0
    empties them.

    Args:
      title: title of all frames; the parameters and the strain of each, if it is left out.
    """

    def __init__(self, title: str | None = None):
        self.title = title
        self._begin()

    def _begin(self) -> None:
        self.frames: list[Frame] = []
        self._recorded = 0  # frames
        self._stride = 1  # recorded frames per frame kept

    def __len__(self) -> int:
        return len(self.frames)

    def keep(self, seen: Snapshot, step: int) -> None:
        """Keep a frame, called by a ``Recorder``. If there are too many frames, every second one is
        dropped.
        """
        if step == 0:
            self._begin()
        if len(self.frames) == MOST_DRAWN:
            self.frames, self._stride = self.frames[::2], 2 * self._stride
        if self._recorded % self._stride == 0:
            per_step = (np.asarray(seen.timestep) * np.asarray(seen.shear_rate)).flat[0].item()
            strain = step * per_step
            title = title_of(seen, strain) if self.title is None else self.title
            self.frames.append(Frame(network_of(seen), title, strain))
        self._recorded += 1


def check_movie(path: Path) -> None:
    """Raise an InputError in one sentence if a movie cannot be written to ``path``."""
    if path.suffix not in (".gif", ".mp4"):
        raise InputError(
            f"movie must be a file name that ends in .gif or .mp4, not {short_repr(str(path))}."
        )
    if path.suffix == ".mp4" and not FFMpegWriter.isAvailable():
        raise InputError(
            "movie must be a .gif here, as there is no ffmpeg to write .mp4: use .gif, or install "
            "ffmpeg."
        )
    require_place(path, "movie", path.suffix)


@styled
def write_movie(path: Path, *flows: Frames, follow: _Follow = iter) -> None:
    """Write a movie, whole or not at all; the grains have the colour of their speed.

    Args:
      path: GIF or MP4 file. An existing file is replaced.
      flows: one or more frames of each flow, as many of one as of the other. Each has its own scale
        of colours and widths.
      follow: passes the frames on as they are drawn, and may report how many are done.
    """
    panel = min(_WIDEST, _WIDTH / len(flows))
    figure = empty_figure(len(flows) * panel, panel + _HEAD + _FOOT)
    figure.set_layout_engine("none")  # a fixed layout, so that only the flow moves
    figure.set_dpi(_DPI)
    with atomic_write(path) as temporary:
        if path.suffix == ".gif":
            palette = _palette()
            first, *others = [
                Image.fromarray(pixels[..., :3]).quantize(palette=palette, dither=Image.Dither.NONE)
                for pixels in _drawings(figure, flows, follow)
            ]
            duration = 1000 // _FRAMES_PER_SECOND
            first.save(temporary, save_all=True, append_images=others, duration=duration, loop=0)
        else:
            writer = FFMpegWriter(_FRAMES_PER_SECOND)
            with writer.saving(figure, str(temporary), _DPI):
                for _ in _drawings(figure, flows, follow):
                    writer.grab_frame()


def _drawings(figure: Figure, flows: Sequence[Frames], follow: _Follow) -> Iterator[np.ndarray]:
    """The pixels of each frame, (height, width, 4)."""
    canvas, (width, height) = FigureCanvasAgg(figure), figure.get_size_inches()
    panel, panels = width / len(flows), []
    for k, frames in enumerate(flows):
        left = (k * panel + _MARGIN) / width
        size = (panel - 2 * _MARGIN) / width, (panel - 2 * _MARGIN) / height
        axes = figure.add_axes((left, (_FOOT + _MARGIN) / height, *size))
        scale = common_scale([frame.network for frame in frames.frames], "speed")
        panels.append((axes, draw_flow(axes, frames.frames[0].network, "speed", scale), scale))
    figure.legend(handles=force_key(panels[0][2])[:2], loc="lower center", ncols=2)
    for moment in follow(list(zip(*(frames.frames for frames in flows), strict=True))):
        for (axes, artists, scale), frame in zip(panels, moment, strict=True):
            show_flow(artists, frame.network, "speed", scale)
            axes.set_title(frame.title)
        canvas.draw()
        yield np.asarray(canvas.buffer_rgba())


def _palette() -> Image.Image:
    """The colours of grains, bars and text, fixed for all frames so that rare colours are kept."""
    ramps = (
        LinearSegmentedColormap.from_list("grey", ["white", "black"]),
        COLOURS["speed"],
        *(
            LinearSegmentedColormap.from_list("bar", [BINARY_COLOUR, end])
            for end in ("white", COLOURS["speed"](1.0))
        ),
    )
    shades = np.concatenate(
        [ramp(np.linspace(0, 1, n))[:, :3] for ramp, n in zip(ramps, _SHADES, strict=True)]
    )
    palette = Image.new("P", (1, 1))
    palette.putpalette(np.round(255 * shades).astype(np.uint8).tobytes())
    return palette
