"""What all figures share: size, fonts, point markers, legends, captions and files.

A figure is one or two columns of a journal wide, and its text has at least 7 points at that width.
``STYLE`` says how all look, and ``styled`` gives it to a function that draws. No plotting state
remains changed, and no display is needed.
"""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Callable, Sequence
from functools import wraps
from io import BytesIO
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import numpy as np
import xarray as xr
from matplotlib import colormaps, rc_context
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.text import Text
from matplotlib.ticker import (
    LogFormatterSciNotation,
    LogLocator,
    MaxNLocator,
    NullFormatter,
    StrMethodFormatter,
)

from jaxgran.files import atomic_write
from jaxgran.maps.schema import FINEST
from jaxgran.model.checks import InputError, short_repr

# bytes of a stem; file systems accept 255, and the names of figures are longer than their stem
LONGEST_NAME = 200
ONE_COLUMN, TWO_COLUMNS = 8.5 / 2.54, 17 / 2.54  # inches, width of a figure
FILE_DPI = 200  # dots per inch of a picture, unless another number is given
LABEL_SIZE = 8.0  # points, font of the labels of axes
TICK_SIZE = 7.5  # points, font of the numbers at the ticks
SMALL_SIZE = 7.0  # points, font of legends and captions
STYLE: dict[Any, Any] = {
    "font.size": LABEL_SIZE,
    "axes.labelsize": LABEL_SIZE,
    "axes.titlesize": LABEL_SIZE,
    "axes.linewidth": 0.6,
    "figure.titlesize": LABEL_SIZE,
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
}
PANEL_TITLE: dict[str, Any] = {
    "fontsize": LABEL_SIZE,
    "y": 1.0,
}  # a fixed height: Matplotlib would search for one
ALPHA_TITLE = "restitution α"
ALPHA_LABEL = r"$1-\alpha$"
NU_LABEL = r"packing fraction $\nu$"
RATIO_LABEL = r"force ratio $\langle F\rangle/\langle F_{\mathrm{bc}}\rangle$"

P = ParamSpec("P")
R = TypeVar("R")
_CAPTION = "caption"  # id of the text under the axes
_USUAL_LINES = 3  # of a caption; a figure with more is higher
_LINE_HEIGHT = 0.13  # inches
_MANY_DECADES = (
    200  # largest over smallest value at and above which only powers of ten have numbers
)
_NARROW = 4  # largest over smallest value at and below which numbers have equal steps
_LEAST_PLAIN = 1e-3  # smallest number that is written without a power of ten
_SAVED: dict[str, dict[str, Any]] = {
    "png": {"pil_kwargs": {"compress_level": 3}},  # 3 % larger than the default, 25 % faster
    "pdf": {"metadata": {"CreationDate": None}},
    "svg": {"metadata": {"Date": None}},
}
_MARKERS = "os^DvP<X>ph*"
_LINE_STYLES = ("-", (0, (5, 1.5)), (0, (4, 1.2, 1, 1.2)), (0, (2, 1)), (0, (1, 1)))
_RING: dict[str, Any] = {
    "linestyle": "none",
    "marker": "o",
    "markersize": 8.5,
    "markerfacecolor": "none",
    "markeredgecolor": "#b2182b",
    "markeredgewidth": 1.2,
}


# ----------------------------------------------------------------------------------------------
# data


def ordered(data: xr.Dataset, *names: str) -> xr.Dataset:
    """Return force ratio, status and the named variables, with errors, as (..., packing_fraction,
    restitution).

    Numbers of grains and time steps, if there are several, come first. The values of all axes
    increase. Variables that the map does not have are left out.
    """
    values = ("force_ratio", *names)
    kept = [
        name for name in (*values, *(f"{name}_stderr" for name in values), "status") if name in data
    ]
    dims = [name for name in (*FINEST, "packing_fraction", "restitution") if name in data.dims]
    return (
        data[kept]
        .sortby(dims)
        .transpose(*dims, ...)
        .assign_attrs({"seeds": data.sizes.get("seed")} | data.attrs)
    )


def is_plane(data: xr.Dataset) -> bool:
    """Return whether a map has at least two restitutions and two packing fractions."""
    return min(data.sizes["restitution"], data.sizes["packing_fraction"]) >= 2


def require_plane(data: xr.Dataset) -> None:
    """Raise a ValueError if a map is not a plane."""
    if not is_plane(data):
        raise InputError(
            "contours need at least two restitutions and two packing fractions, "
            f"and this map has {data.sizes['restitution']} and {data.sizes['packing_fraction']}."
        )


def suspect(data: xr.Dataset) -> np.ndarray:
    """Return whether a point has a value and a status that is not `ok`."""
    return np.isfinite(data.force_ratio.values) & (_status_names(data) != "ok")


def _status_names(data: xr.Dataset) -> np.ndarray:
    """Return the name of the status of every point, in the shape of the map."""
    if "status" not in data:
        return np.full(data.force_ratio.shape, "ok", dtype=object)
    attrs = data.status.attrs
    values = np.atleast_1d(attrs["flag_values"]).tolist()
    names = dict(zip(values, attrs["flag_meanings"].split(), strict=True))
    codes = data.status.values
    return np.array([names.get(code, f"status {code}") for code in codes.flat], object).reshape(
        codes.shape
    )


# ----------------------------------------------------------------------------------------------
# curves


def curve_styles(count: int) -> list[dict[str, Any]]:
    """Return a colour, marker and line style for each curve; the colours also differ in a grey
    print.
    """
    ramp = colormaps["viridis"](np.linspace(0.0, 0.82, count))
    return [
        {
            "color": tuple(ramp[k]),
            "marker": _MARKERS[k % len(_MARKERS)],
            "linestyle": _LINE_STYLES[k % len(_LINE_STYLES)],
        }
        for k in range(count)
    ]


def draw_points(
    axes: Axes, x: np.ndarray, y: np.ndarray, bad: np.ndarray, style: dict[str, Any], **errors: Any
) -> None:
    """Draw a curve with its error bars, without caps; a point whose status is not `ok` is an open
    symbol in a ring.
    """
    axes.errorbar(x, y, **style, **errors, markersize=4, linewidth=1.1, elinewidth=0.8)
    axes.plot(
        x[bad],
        y[bad],
        linestyle="none",
        marker=style["marker"],
        markersize=4,
        markerfacecolor="white",
        markeredgecolor=style["color"],
        zorder=4,
    )
    mark_bad(axes, x[bad], y[bad])


def mark_bad(axes: Axes, x: np.ndarray, y: np.ndarray, clip_on: bool = True) -> None:
    """Put a ring around points whose status is not `ok`; unless it is clipped, it may reach over
    the frame.
    """
    if len(x):
        axes.plot(x, y, **_RING, zorder=5, clip_on=clip_on)


def curve_key(style: dict[str, Any], label: str) -> Line2D:
    """Return the legend entry of a curve."""
    return Line2D([], [], **style, markersize=4, linewidth=1.1, label=label)


def ring_key() -> Line2D:
    """Return the legend entry of the ring around points whose status is not `ok`."""
    return Line2D([], [], **_RING, label="status not ok")


def add_curve_legend(
    figure: Figure, data: xr.Dataset, handles: Sequence[Line2D], title: str
) -> None:
    """Name the curves beside the axes, and explain the ring above them."""
    figure.legend(
        handles=handles,
        title=title,
        loc="outside right upper",
        ncols=1 + (len(handles) - 1) // 16,
        fontsize=SMALL_SIZE + 0.5,
        title_fontsize=TICK_SIZE,
        frameon=False,
        handlelength=3.2,
    )
    add_ring_legend(figure, data)


def add_ring_legend(figure: Figure, data: xr.Dataset, place: Any = "outside upper left") -> None:
    """Explain the ring in a legend above the axes, if any status is not `ok`."""
    if suspect(data).any():
        figure.legend(handles=[ring_key()], loc=place, fontsize=SMALL_SIZE, frameon=False)


# ----------------------------------------------------------------------------------------------
# forces


def image_segments(starts: np.ndarray, branches: np.ndarray, shifts: np.ndarray) -> np.ndarray:
    """Return the ends (images · pairs, 2, 2) of lines from ``starts`` along ``branches``, at each
    of the ``shifts``.
    """
    segments = np.stack([starts, starts + branches], axis=1)
    return (segments[None] + shifts[:, None, None]).reshape(-1, 2, 2)


# ------------------------------------------------------------------------------------- frame and
# text


class ShownFigure(Figure):
    """A figure that a notebook shows if it is the last line of a cell, without any global plotting
    state.
    """

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
    figure = ShownFigure(figsize=(width, height), dpi=FILE_DPI, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def label_log_axis(axis: Axis, most: int = 9) -> None:
    """Put numbers at 1, 2 and 5 of each decade of a logarithmic axis, at powers of ten, or at equal
    steps.

    Powers of ten are those of several decades, and where 1, 2 and 5 are more than `most` numbers;
    equal steps are those of a small part of a decade.
    """
    low, high = axis.get_view_interval()
    every = LogFormatterSciNotation(minor_thresholds=(np.inf, np.inf))
    numbers = np.outer(
        10.0 ** np.arange(np.floor(np.log10(low)), np.ceil(np.log10(high))), (1, 2, 5)
    )
    fit = ((low <= numbers) & (numbers <= high)).sum() <= most
    in_a_decade = (1, 2, 5) if fit and high < _MANY_DECADES * low else (1,)
    axis.set_major_locator(
        LogLocator(subs=in_a_decade, numticks=9) if high > _NARROW * low else MaxNLocator(4)
    )
    axis.set_major_formatter(every if low < _LEAST_PLAIN else StrMethodFormatter("{x:g}"))
    axis.set_minor_formatter(NullFormatter())


def scientific(value: float) -> str:
    """Return a number as mathematical text, for example 3 × 10⁻⁴."""
    mantissa, exponent = f"{value:.2e}".split("e")
    power = rf"10^{{{int(exponent)}}}"
    return power if float(mantissa) == 1.0 else rf"{float(mantissa):g}\times {power}"


def status_note(data: xr.Dataset) -> str:
    """Return a line that counts the points of each status that is not `ok`; empty if there are
    none.
    """
    counts = Counter(name for name in _status_names(data).flat if name != "ok")
    words = ", ".join(f"{name.replace('_', ' ')} ({count})" for name, count in counts.most_common())
    return f"Status not ok: {words}" if counts else ""


def missing_note(measured: np.ndarray, how_drawn: str = "") -> str:
    """Return a line that counts the points without a value; empty if there are none."""
    missing = int((~measured).sum())
    return f"{missing} of {measured.size} points without a value{how_drawn}" if missing else ""


def padded(values: np.ndarray) -> tuple[float, float]:
    """Return the limits of an axis, with room for the symbols at its ends."""
    margin = 0.025 * np.ptp(values) or 0.01
    return float(values.min() - margin), float(values.max() + margin)


def finish(figure: Figure, data: xr.Dataset, measured: np.ndarray, notes: Sequence[str]) -> None:
    """Set the tick style and write the caption under the axes; write "no measured values" where
    there are none.
    """
    for axes in figure.axes:
        axes.tick_params(which="both", direction="in", top=True, right=True, labelsize=TICK_SIZE)
        if not measured.any():
            box = {"facecolor": "white", "edgecolor": "none"}
            where = {"transform": axes.transAxes, "ha": "center"}
            axes.text(0.5, 0.6, "no measured values", fontsize=LABEL_SIZE, bbox=box, **where)
    caption = figure.supxlabel("", fontsize=SMALL_SIZE, gid=_CAPTION)
    described, width = (*notes, _run_description(data.attrs)), 0.97 * figure.bbox.width
    lines = [line for note in described if note for line in _wrapped(caption, note, width)]
    caption.set_text("\n".join(lines))
    figure.set_figheight(figure.get_figheight() + _LINE_HEIGHT * max(0, len(lines) - _USUAL_LINES))


def _wrapped(text: Text, words: str, most: float) -> list[str]:
    """Return words in lines of at most so many pixels as the text would draw them; formulas stay
    whole.
    """
    lines: list[str] = []
    for word in re.findall(r"(?:\$[^$]*\$|\S)+", words):
        text.set_text(f"{lines[-1]} {word}" if lines else word)
        if lines and text.get_window_extent().width <= most:
            lines[-1] = text.get_text()
        else:
            lines.append(word)
    return lines


def _run_description(attrs: dict) -> str:
    """Return in one line the parameters on which a force ratio depends; what has several values is
    shown by an axis.
    """
    parts = []
    if "grains_by_point" in attrs:
        parts.append(
            f"$N={np.min(attrs['grains_by_point'])}$ to ${np.max(attrs['grains_by_point'])}$"
        )
    elif np.ndim(attrs.get("grains", ())) == 0:
        parts.append(f"$N={attrs['grains']}$")
    if attrs.get("seeds") is not None:
        parts.append("1 seed" if attrs["seeds"] == 1 else f"{attrs['seeds']} seeds")
    if np.ndim(attrs.get("timestep", ())) == 0:
        parts.append(rf"$\mathrm{{d}}t={scientific(float(attrs['timestep']))}/\dot{{\gamma}}$")
    if "activation" in attrs:
        parts.append(f"{attrs['activation']} activation")
    if "strain" in attrs:
        parts.append(f"strain {float(attrs['strain']):g} per seed")
    return ", ".join(parts)


def writable_stem(stem: Path | str) -> Path:
    """Return folder and beginning of the names of figures; raise an InputError if no file can be
    written there.
    """
    if not isinstance(stem, (str, os.PathLike)):
        raise InputError(
            f"stem must be folder and beginning of the file names, not {short_repr(stem)}."
        )
    stem = Path(stem)
    if len(os.fsencode(stem.name)) > LONGEST_NAME:
        raise InputError(
            f"the names of figures must begin with at most {LONGEST_NAME} bytes, not "
            f"{short_repr(stem.name)}."
        )
    if not os.path.isdir(stem.parent) or not os.access(stem.parent, os.W_OK):
        raise InputError(
            "figures must be written to a folder that can be written to, not "
            f"{short_repr(str(stem.parent))}."
        )
    return stem


def write(figure: Figure, path: Path, dpi: int = FILE_DPI, caption: bool = True) -> Path:
    """Write a figure in the format of its ending; a file that is there is replaced at the end.

    The same figure gives the same file: no date and no random name is in it.
    """
    kind = path.suffix.removeprefix(".")
    for text in figure.findobj(lambda artist: artist.get_gid() == _CAPTION):
        text.set_visible(caption)
    with (
        atomic_write(path) as temporary,
        rc_context({"svg.hashsalt": "jaxgran", "pdf.fonttype": 42}),
    ):
        figure.savefig(temporary, format=kind, dpi=dpi, **_SAVED.get(kind, {}))
    return path
