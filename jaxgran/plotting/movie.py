"""Movies of a flow: its frames as GIF or MP4.

Frames are stored while a flow runs (``recorder``) and drawn after its end. Only then are the
largest speed and the largest force known, which set the scale of colours and widths in all frames.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.animation import FFMpegWriter
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from PIL import Image

from jaxgran.dynamics.snapshots import Snapshot
from jaxgran.files import atomic_write
from jaxgran.io.atomic import require_place
from jaxgran.model.checks import InputError, short_repr
from jaxgran.plotting.encoding import BINARY_COLOUR
from jaxgran.plotting.flow import (
    COLOURS,
    common_scale,
    draw_picture,
    scene_of,
    show_scene,
    title_of,
)
from jaxgran.plotting.style import empty_figure

MOST_DRAWN = 500  # frames of a movie, which are held in memory while it is written
_WIDTH = 5.6  # inches
_HEIGHT = 4.4  # inches
_DPI = 90  # pixels per inch
_AXES_PLACE = (0.01, 0.07, 0.82, 0.83)  # left, bottom, width and height of the axes in the figure
_HALF_WIDTH = 0.755  # of the picture in sides of the cell, enough at any tilt
_FRAMES_PER_SECOND = 20
_SHADES = (
    24,
    24,
    8,
    8,
)  # colours of each ramp in the palette of a GIF; more colours make a larger file
_Follow = Callable[[Sequence], Iterable]  # passes items on, and may report how many are done


class Frames:
    """The frames of a movie, kept as they are recorded; a recording that starts again at step 0
    empties them.
    """

    def __init__(self):
        self._begin()

    def _begin(self) -> None:
        self.scenes: list[Any] = []
        self.strains: list[float] = []
        self._recorded = 0  # frames
        self._stride = 1  # recorded frames per frame kept

    def keep(self, seen: Snapshot, step: int) -> None:
        """Keep a frame, called by a ``Recorder``. If there are too many frames, every second one is
        dropped.
        """
        if step == 0:
            self._begin()
        if len(self.scenes) == MOST_DRAWN:
            self.scenes, self.strains, self._stride = (
                self.scenes[::2],
                self.strains[::2],
                2 * self._stride,
            )
        if self._recorded % self._stride == 0:
            self.scenes.append(scene_of(seen))
            self.strains.append(
                step * (np.asarray(seen.timestep) * np.asarray(seen.shear_rate)).flat[0].item()
            )
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


def write_movie(path: Path, frames: Frames, follow: _Follow = iter) -> None:
    """Write a movie, whole or not at all; the grains have the colour of their speed.

    Args:
      path: GIF or MP4 file. An existing file is replaced.
      frames: one or more frames of one flow.
      follow: passes the frames on as they are drawn, and may report how many are done.
    """
    figure = empty_figure(_WIDTH, _HEIGHT)
    figure.set_layout_engine("none")  # a fixed layout, so that only the flow moves
    figure.set_dpi(_DPI)
    with atomic_write(path) as temporary:
        if path.suffix == ".gif":
            palette = _palette()
            nearest = _nearest(palette)
            first, *others = [
                _picture(pixels, palette, nearest) for pixels in _drawings(figure, frames, follow)
            ]
            first.save(
                temporary,
                save_all=True,
                append_images=others,
                duration=1000 // _FRAMES_PER_SECOND,
                loop=0,
            )
        else:
            writer = FFMpegWriter(_FRAMES_PER_SECOND)
            with writer.saving(figure, str(temporary), _DPI):
                for _ in _drawings(figure, frames, follow):
                    writer.grab_frame()


def _drawings(figure: Figure, frames: Frames, follow: _Follow) -> Iterator[np.ndarray]:
    """The pixels of each frame, (height, width, 4); what moves is drawn over what does not."""
    scale = common_scale(frames.scenes, "speed")
    first, canvas = frames.scenes[0], FigureCanvasAgg(figure)
    axes = figure.add_axes(_AXES_PLACE)
    artists = draw_picture(axes, first, "speed", scale, frames.strains[0])
    axes.set_xlim(-_HALF_WIDTH * first.instant.side, _HALF_WIDTH * first.instant.side)
    for artist in artists:
        artist.set_animated(True)
    canvas.draw()
    at_rest = canvas.copy_from_bbox(figure.bbox)
    for scene, strain in follow(list(zip(frames.scenes, frames.strains, strict=True))):
        show_scene(artists, scene, "speed", scale)
        artists.title.set_text(title_of(scene, strain))
        canvas.restore_region(at_rest)
        for artist in artists:
            axes.draw_artist(artist)
        yield np.asarray(canvas.buffer_rgba())


def _picture(pixels: np.ndarray, palette: np.ndarray, nearest: np.ndarray) -> Image.Image:
    """A frame as an image, in the colours of a palette."""
    red, green, blue = np.moveaxis(pixels[..., :3] >> 2, -1, 0)
    picture = Image.fromarray(nearest[red, green, blue])
    picture.putpalette(palette.tobytes())
    return picture


def _palette() -> np.ndarray:
    """The colours (shades, 3) of grains, lines and text, fixed for all frames so that rare colours
    are kept.
    """
    ramps = (
        LinearSegmentedColormap.from_list("grey", ["white", "black"]),
        COLOURS["speed"],
        *(
            LinearSegmentedColormap.from_list("line", [BINARY_COLOUR, end])
            for end in ("white", COLOURS["speed"](1.0))
        ),
    )
    shades = np.concatenate(
        [ramp(np.linspace(0, 1, n))[:, :3] for ramp, n in zip(ramps, _SHADES, strict=True)]
    )
    return np.round(255 * shades).astype(np.uint8)


def _nearest(palette: np.ndarray) -> np.ndarray:
    """The index of the nearest colour of the palette, for 64 levels each of red, green and blue,
    (64, 64, 64).
    """
    red, green, blue = (
        (np.linspace(0, 255, 64)[:, None] - shade) ** 2 for shade in palette.T.astype(float)
    )
    return np.argmin(red[:, None, None] + green[:, None] + blue, axis=-1).astype(np.uint8)
