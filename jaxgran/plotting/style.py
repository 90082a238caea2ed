"""The style of all figures: sizes, fonts, curves, legends, captions and files.

A figure is one or two columns of a journal wide, and its text has at least 7 points at that width.
No plotting state remains changed, and no display is needed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import wraps
from io import BytesIO
from itertools import cycle
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import numpy as np
from matplotlib import colormaps, rc_context
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import (
    LogFormatterSciNotation,
    LogLocator,
    MaxNLocator,
    NullFormatter,
    StrMethodFormatter,
)

from jaxgran.files import atomic_write

ONE_COLUMN, TWO_COLUMNS = 8.5 / 2.54, 17 / 2.54  # inches, width of a figure
FILE_DPI = 200  # dots per inch of a picture, unless another number is given
LABEL_SIZE = 8.0  # points, font of titles and of the labels of axes
TICK_SIZE = 7.5  # points, font of the numbers at the ticks
SMALL_SIZE = 7.0  # points, font of legends and captions
STYLE: dict[Any, Any] = {
    "text.usetex": False,  # texts are written for the letters of Matplotlib
    "text.parse_math": True,
    "savefig.bbox": None,  # the widths of figures are given
    "font.size": LABEL_SIZE,
    "axes.labelsize": LABEL_SIZE,
    "axes.titlesize": LABEL_SIZE,
    "axes.titley": 1.0,  # a fixed height: Matplotlib would search for one
    "axes.linewidth": 0.6,
    "figure.titlesize": LABEL_SIZE,
    "figure.labelsize": LABEL_SIZE,
    "xtick.labelsize": TICK_SIZE,
    "ytick.labelsize": TICK_SIZE,
    "xtick.direction": "in",
    "ytick.direction": "in",
    "xtick.top": True,
    "ytick.right": True,
    "legend.fontsize": SMALL_SIZE,
    "legend.title_fontsize": SMALL_SIZE,
    "legend.frameon": False,
    "legend.handlelength": 2.4,
    "lines.linewidth": 1.0,
    "lines.markersize": 4.0,
    "errorbar.capsize": 0.0,
    "hatch.linewidth": 0.6,
    "svg.hashsalt": "jaxgran",
    "pdf.fonttype": 42,
}
ALPHA_TITLE = r"restitution $\alpha$"
ALPHA_LABEL = r"$1-\alpha$"
NU_LABEL = r"packing fraction $\nu$"
RATIO_LABEL = r"force ratio $\langle F\rangle/\langle F_{\mathrm{bc}}\rangle$"
INTERVAL_COLOUR = "#f6d5a4"  # of what lies within an error
RING: dict[str, Any] = {
    "linestyle": "none",
    "marker": "o",
    "markersize": 8.5,
    "markerfacecolor": "none",
    "markeredgecolor": "#b2182b",
    "markeredgewidth": 1.2,
    "label": "status not ok",
}

P = ParamSpec("P")
R = TypeVar("R")
_CAPTION = "caption"  # id of the text under the axes
_ROUND_STEPS = (1, 2, 5, 10)  # their multiples include 1
_SAVED: dict[str, dict[str, Any]] = {
    "png": {"pil_kwargs": {"compress_level": 3}},  # 3 % larger than the default, 25 % faster
    "pdf": {"metadata": {"CreationDate": None}},
    "svg": {"metadata": {"Date": None}},
}
_MARKERS = "os^DvP<X>ph*"
_LINE_STYLES = ("-", (0, (5, 1.5)), (0, (4, 1.2, 1, 1.2)), (0, (2, 1)), (0, (1, 1)))


class StyledFigure(Figure):
    """A figure that is drawn in ``STYLE`` wherever it is shown, also as the last line of a cell."""

    def draw(self, renderer: Any) -> None:
        with rc_context(STYLE):  # ticks are made, and read their style, when they are drawn
            super().draw(renderer)

    def _repr_png_(self) -> bytes:
        memory = BytesIO()
        self.savefig(memory, format="png", dpi=110)
        return memory.getvalue()


def styled(draw: Callable[P, R]) -> Callable[P, R]:
    """Return a function that draws in the style of all figures."""

    @wraps(draw)
    def drawn(*args: P.args, **kwargs: P.kwargs) -> R:
        with rc_context(STYLE):
            return draw(*args, **kwargs)

    return drawn


def empty_figure(width: float, height: float) -> Figure:
    """Return a figure of the given size in inches that needs no display."""
    figure = StyledFigure(figsize=(width, height), dpi=FILE_DPI, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def add_caption(figure: Figure, sentences: Iterable[str]) -> None:
    """Write sentences under the axes, in lines as wide as the figure, and make room for them."""
    text = ". ".join(sentence for sentence in sentences if sentence)
    style = {"wrap": True, "ha": "left", "fontsize": SMALL_SIZE, "gid": _CAPTION}
    caption = figure.supxlabel(f"{text}.", x=0.01, **style)
    height = caption.get_window_extent().height / figure.dpi
    figure.set_figheight(figure.get_figheight() + height)


@styled
def write(figure: Figure, path: Path, dpi: int = FILE_DPI, caption: bool = True) -> Path:
    """Write a figure in the format of its ending; a file that is there is replaced at the end.

    The same figure gives the same file: no date and no random name is in it.
    """
    kind = path.suffix.removeprefix(".")
    for text in figure.findobj(lambda artist: artist.get_gid() == _CAPTION):
        text.set_visible(caption)
    with atomic_write(path) as temporary:
        figure.savefig(temporary, format=kind, dpi=dpi, **_SAVED.get(kind, {}))
    return path


def curve_styles(count: int) -> list[dict[str, Any]]:
    """Return a colour, marker and line style for each curve; they differ also in a grey print."""
    ramp = colormaps["viridis"](np.linspace(0.0, 0.82, count))
    looks = zip(ramp, cycle(_MARKERS), cycle(_LINE_STYLES), strict=False)
    return [
        {"color": tuple(colour), "marker": marker, "linestyle": line}
        for colour, marker, line in looks
    ]


def draw_points(
    axes: Axes, x: np.ndarray, y: np.ndarray, bad: np.ndarray, style: dict[str, Any], **errors: Any
) -> None:
    """Draw a curve with its error bars; a point whose status is not `ok` is open, in a ring."""
    axes.errorbar(x, y, **style, **errors, elinewidth=0.8)
    if bad.any():
        opened = style | {"linestyle": "none", "markerfacecolor": "white", "zorder": 4}
        axes.plot(x[bad], y[bad], **opened)
        axes.plot(x[bad], y[bad], **RING, zorder=5)


def draw_curves(
    axes: Axes, x: np.ndarray, y: np.ndarray, bad: np.ndarray, **errors: np.ndarray
) -> None:
    """Draw curves (curves, points) with their error bars in the order of ``curve_styles``."""
    x = np.broadcast_to(x, y.shape)
    for k, style in enumerate(curve_styles(len(y))):
        bars = {name: error[k] for name, error in errors.items()}
        draw_points(axes, x[k], y[k], bad[k], style, **bars)


def add_curve_legend(figure: Figure, labels: Sequence[str], title: str, bad: Any) -> None:
    """Name the curves, in the order of ``curve_styles``, and the ring if there is any."""
    styles = zip(labels, curve_styles(len(labels)), strict=True)
    handles = [Line2D([], [], **style, label=label) for label, style in styles]
    handles += [Line2D([], [], **RING)] * bool(bad)
    columns = 1 + (len(handles) - 1) // 16
    place = {"loc": "outside right upper", "ncols": columns, "handlelength": 3.2}
    figure.legend(handles=handles, title=title, **place)


def label_log_axis(axis: Axis) -> None:
    """Number a logarithmic axis: equal steps, or 1, 2 and 5 of a decade, or powers of ten."""
    low, high = axis.get_view_interval()
    if high <= 4 * low:
        axis.set_major_locator(MaxNLocator(4, steps=_ROUND_STEPS))
    else:
        axis.set_major_locator(LogLocator(subs=(1, 2, 5) if high < 200 * low else (1,), numticks=9))
    every = LogFormatterSciNotation(minor_thresholds=(np.inf, np.inf))
    axis.set_major_formatter(every if low < 1e-3 else StrMethodFormatter("{x:g}"))
    axis.set_minor_formatter(NullFormatter())


def draw_reference(axes: Axes) -> None:
    """Draw the line of value 1; it has a number at the axis."""
    axes.axhline(1.0, color="0.6", linewidth=0.8, zorder=0)
    axes.yaxis.set_major_locator(MaxNLocator(7, steps=_ROUND_STEPS))


def scientific(value: float) -> str:
    """Return a number as mathematical text, for example 3 × 10⁻⁴."""
    mantissa, exponent = f"{value:.2e}".split("e")
    power = rf"10^{{{int(exponent)}}}"
    return power if float(mantissa) == 1.0 else rf"{float(mantissa):g}\times{{}}{power}"


def padded(values: np.ndarray) -> tuple[float, float]:
    """Return the limits of an axis, with room for the symbols at its ends."""
    margin = 0.025 * np.ptp(values) or 0.01
    return float(values.min() - margin), float(values.max() + margin)
