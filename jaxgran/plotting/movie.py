"""Movies of one or more flows beside each other, as GIF or MP4.

Frames are stored while a flow runs (``Recorder``) and drawn after its end. Only then are the
largest speed and the largest force known, which set the scale of colours and widths in all frames.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

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
from jaxgran.plotting.flow import (
    BINARY_COLOUR,
    SPEED_COLOURS,
    common_scale,
    draw_flow,
    force_key,
    network_of,
    title_of,
)
from jaxgran.plotting.style import empty_figure, styled

MOST_DRAWN = 500  # frames of a movie, which are held in memory while it is written
_WIDTH, _WIDEST = 7.6, 4.6  # inches, of several flows together and of a single one
_MARGIN = 0.1  # inches, around a flow
_HEAD, _FOOT = 0.4, 0.3  # inches, of the titles above and the legend below
_DPI = 96  # pixels per inch
_FRAMES_PER_SECOND = 12
_SHADES = 10  # of each colour in a GIF; more make a larger file
_Follow = Callable[[Sequence], Iterable]  # passes items on, and may report how many are done


class Frames:
    """The frames of a movie, kept as they are recorded; a recording that starts again at step 0
    empties them.

    Args:
      title: title of all frames; the parameters and the strain of each, if it is left out.
    """

    def __init__(self, title: str | None = None):
        self.title = title
        self.frames: list[tuple[ForceNetwork, str]] = []  # flows and titles
        self._recorded, self._stride = 0, 1  # frames recorded, in all and for each that is kept

    def __len__(self) -> int:
        return len(self.frames)

    def keep(self, seen: Snapshot, step: int) -> None:
        """Keep a frame, called by a ``Recorder``. If there are too many frames, every second one is
        dropped.
        """
        if step == 0:
            self.frames, self._recorded, self._stride = [], 0, 1
        if len(self.frames) == MOST_DRAWN:
            self.frames, self._stride = self.frames[::2], 2 * self._stride
        if self._recorded % self._stride == 0:
            per_step = (np.asarray(seen.timestep) * np.asarray(seen.shear_rate)).flat[0].item()
            title = title_of(seen, step * per_step) if self.title is None else self.title
            self.frames.append((network_of(seen), title))
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
    drawings = _drawings(figure, flows, follow)
    with atomic_write(path) as temporary:
        if path.suffix == ".mp4":
            writer = FFMpegWriter(_FRAMES_PER_SECOND)
            with writer.saving(figure, str(temporary), _DPI):
                for _ in drawings:
                    writer.grab_frame()
            return
        palette, no_dither = _palette(), Image.Dither.NONE
        first, *others = (
            Image.fromarray(pixels[..., :3]).quantize(palette=palette, dither=no_dither)
            for pixels in drawings
        )
        duration = 1000 // _FRAMES_PER_SECOND
        first.save(temporary, save_all=True, append_images=others, duration=duration, loop=0)


def _drawings(figure: Figure, flows: Sequence[Frames], follow: _Follow) -> Iterator[np.ndarray]:
    """The pixels of each frame, (height, width, 4)."""
    canvas, (width, height) = FigureCanvasAgg(figure), figure.get_size_inches()
    panel, scales, grid = width / len(flows), [], []
    for k, flow in enumerate(flows):
        left, low = (k * panel + _MARGIN) / width, (_FOOT + _MARGIN) / height
        size = (panel - 2 * _MARGIN) / width, (panel - 2 * _MARGIN) / height
        grid.append(figure.add_axes((left, low, *size)))
        scales.append(common_scale(network for network, _ in flow.frames))
    figure.legend(handles=force_key(scales[0])[:2], loc="lower center", ncols=2)
    for moment in follow(list(zip(*(flow.frames for flow in flows), strict=True))):
        for axes, (network, title), scale in zip(grid, moment, scales, strict=True):
            draw_flow(axes, network, scale)
            axes.set_title(title)
        canvas.draw()
        yield np.array(canvas.buffer_rgba())


def _palette() -> Image.Image:
    """The colours of grains, text and bars, fixed for all frames so that rare colours are kept."""
    inks = [LinearSegmentedColormap.from_list(x, [x, "white"]) for x in ("black", BINARY_COLOUR)]
    shades = [
        ramp(np.linspace(0, 1, _SHADES), bytes=True)[:, :3] for ramp in (SPEED_COLOURS, *inks)
    ]
    palette = Image.new("P", (1, 1))
    palette.putpalette(np.concatenate(shades).tobytes())
    return palette
