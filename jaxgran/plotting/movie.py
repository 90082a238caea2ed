"""Movies of a flow: pictures of its frames, one after the other, as GIF or MP4.

Frames are kept as a flow is driven (``recorder``), and drawn when it has ended: only then is it known how fast the
fastest grains are and how large the largest force is, for which colours and widths stand throughout.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np
from matplotlib.animation import FFMpegWriter
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from PIL import Image

from jaxgran.dynamics.snapshots import Snapshot
from jaxgran.io.atomic import replaced, require_place
from jaxgran.model.checks import InputError, shown
from jaxgran.plotting.drawing import empty_figure
from jaxgran.plotting.flow import BINARY_COLOUR, COLOURS, Colour, Scene, common_scale, draw_picture, scene_of

MOST_DRAWN = 500  # of a movie: they are held in memory while it is written
_WIDTH, _HEIGHT, _DPI = 5.6, 4.4, 90
_PLACE = (0.01, 0.07, 0.82, 0.83)  # of the axes in the figure
_WIDEST = 0.755  # sides from the middle of the cell to the edge of the picture, at any tilt
_PER_SECOND = 20
_SHADES = (24, 24, 8, 8)  # of the palette of a GIF, in each of its ramps: few, as a file grows with them
_Follow = Callable[[Sequence], Iterable]  # passes items on, and may tell how many are done


class Frames:
    """The frames of a movie, kept as they are recorded; a recording that begins anew begins here too."""

    def __init__(self):
        self._begin()

    def _begin(self) -> None:
        self.scenes: list[Scene] = []
        self.strains: list[float] = []
        self._seen, self._of_every = 0, 1

    def keep(self, seen: Snapshot, step: int) -> None:
        """Keep a frame: what a ``Recorder`` hands on. Where they become too many, every other one is dropped."""
        if step == 0:
            self._begin()
        if len(self.scenes) == MOST_DRAWN:
            self.scenes, self.strains, self._of_every = self.scenes[::2], self.strains[::2], 2 * self._of_every
        if self._seen % self._of_every == 0:
            self.scenes.append(scene_of(seen))
            self.strains.append(step * (np.asarray(seen.timestep) * np.asarray(seen.shear_rate)).item())
        self._seen += 1


def check_movie(path: Path) -> None:
    """Raise an InputError in one sentence where a movie could not be written to ``path``."""
    if path.suffix not in (".gif", ".mp4"):
        raise InputError(f"movie must be a file name that ends in .gif or .mp4, not {shown(str(path))}.")
    if path.suffix == ".mp4" and not FFMpegWriter.isAvailable():
        raise InputError("movie must be a .gif here, as there is no ffmpeg to write .mp4: use .gif, or install ffmpeg.")
    require_place(path, "movie", path.suffix)


def write_movie(path: Path, frames: Frames, colour: Colour = "speed", follow: _Follow = iter) -> None:
    """Write a movie, whole or not at all.

    Args:
      path: GIF or MP4 file. One that is there is replaced.
      frames: one or more frames of one flow.
      colour: "speed" or "pressure" of the grains.
      follow: passes the frames on as they are drawn, and may show how many are done.
    """
    figure = empty_figure(_WIDTH, _HEIGHT)
    figure.set_layout_engine("none")  # so that nothing moves but the flow
    figure.set_dpi(_DPI)
    drawn = _drawn(figure, frames, colour, follow)
    with replaced(path) as temporary:
        if path.suffix == ".gif":
            palette = _palette(colour)
            nearest = _nearest(palette)
            first, *others = [_picture(figure, palette, nearest) for _ in drawn]
            first.save(temporary, save_all=True, append_images=others, duration=1000 // _PER_SECOND, loop=0)
        else:
            writer = FFMpegWriter(_PER_SECOND)
            with writer.saving(figure, str(temporary), _DPI):
                for _ in drawn:
                    writer.grab_frame()


def _drawn(figure: Figure, frames: Frames, colour: Colour, follow: _Follow) -> Iterator[None]:
    """Draw one frame after the other in the same figure."""
    scale = common_scale(frames.scenes, colour)
    for scene, strain in follow(list(zip(frames.scenes, frames.strains, strict=True))):
        figure.clear()
        axes = figure.add_axes(_PLACE)
        draw_picture(axes, scene, colour, scale, strain)
        axes.set_xlim(-_WIDEST * scene.side, _WIDEST * scene.side)
        yield


def _picture(figure: Figure, palette: np.ndarray, nearest: np.ndarray) -> Image.Image:
    """A figure as it is drawn, in the colours of a palette."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    red, green, blue = np.moveaxis(np.asarray(canvas.buffer_rgba())[..., :3] >> 2, -1, 0)
    picture = Image.fromarray(nearest[red, green, blue])
    picture.putpalette(palette.tobytes())
    return picture


def _palette(colour: Colour) -> np.ndarray:
    """The colours (shades, 3) of grains, lines and text: the same in all frames, so that none is lost that is rare."""
    ramps = (
        LinearSegmentedColormap.from_list("grey", ["white", "black"]),
        COLOURS[colour],
        *(LinearSegmentedColormap.from_list("line", [BINARY_COLOUR, end]) for end in ("white", COLOURS[colour](1.0))),
    )
    shades = np.concatenate([ramp(np.linspace(0, 1, n))[:, :3] for ramp, n in zip(ramps, _SHADES, strict=True)])
    return np.round(255 * shades).astype(np.uint8)


def _nearest(palette: np.ndarray) -> np.ndarray:
    """For each of 64 steps of red, green and blue, (64, 64, 64), the colour of the palette that is nearest."""
    red, green, blue = ((np.linspace(0, 255, 64)[:, None] - shade) ** 2 for shade in palette.T.astype(float))
    return np.argmin(red[:, None, None] + green[:, None] + blue, axis=-1).astype(np.uint8)
