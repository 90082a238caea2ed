"""Pictures of a flow: grains in their sheared cell, coloured by speed or pressure, and the forces
between them.

Lines join the centres of grains that push each other. Their width is proportional to the force,
within limits. A line is black if most of its force acts within clusters of three or more grains. It
is red, and much lighter in a grey print, if the two grains collide without touching others.
"""

from collections.abc import Iterable, Sequence
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection, LineCollection
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon
from matplotlib.text import Annotation, Text

from jaxgran.analysis.instant import Instant, instant_of
from jaxgran.analysis.series import series
from jaxgran.dynamics.snapshots import Snapshot
from jaxgran.model.cell import minimum_image
from jaxgran.model.checks import InputError, require_untraced, short_repr
from jaxgran.plotting.encoding import (
    BINARY_COLOUR,
    CLUSTER_COLOUR,
    GRAIN_EDGE,
    GRAIN_RAMPS,
    THINNEST_LINE,
    WIDEST_LINE,
    deepest,
    widest,
)
from jaxgran.plotting.style import (
    LABEL_SIZE,
    SMALL_SIZE,
    TICK_SIZE,
    empty_figure,
    scientific,
)

Colour = Literal["speed", "pressure"]

COLOUR_LABELS: dict[str, str] = {
    "speed": r"peculiar speed $|c|$  ($\sigma\dot\gamma$)",
    "pressure": r"contact pressure of a grain  ($m\dot\gamma^2$)",
}
COLOURS = {
    name: LinearSegmentedColormap.from_list(name, ramp) for name, ramp in GRAIN_RAMPS.items()
}
_CLUSTER: dict[str, Any] = {"color": CLUSTER_COLOUR, "capstyle": "round"}
_BINARY: dict[str, Any] = {"color": BINARY_COLOUR, "capstyle": "round"}
_LEGEND: dict[str, Any] = {
    "fontsize": SMALL_SIZE,
    "frameon": False,
    "ncols": 3,
    "handlelength": 1.8,
    "columnspacing": 1.4,
}
_LATTICE = [(a, b) for a in (-1, 0, 1) for b in (-1, 0, 1)]  # the cell and its eight neighbours
_LINE_MARGIN = 0.05  # in sides of the cell, at least half of the width of a line


class Scene(NamedTuple):
    """What a picture shows of a flow, in units of σ, m and 1/γ̇."""

    instant: Instant
    pressure: Float[np.ndarray, " grains"]  # Σ F r/2πr² over the contacts of each grain
    restitution: float
    packing_fraction: float
    timestep: float
    times: int  # number of snapshots in the window
    window: float  # strain of the window; whole numbers between snapshots are not counted

    @property
    def speed(self) -> Float[np.ndarray, " grains"]:
        """|c|, without the shear."""
        return self.instant.speed


class Scale(NamedTuple):
    """The values of the deepest colour and the widest line of a picture; larger values look the
    same.

    ``colour`` is a speed in σγ̇ or a pressure in mγ̇², ``force`` a force in mσγ̇².
    """

    colour: float
    force: float


def flow_figure(seen: Snapshot, colour: Colour = "speed", strain: float | None = None) -> Figure:
    """A picture of a flow: its grains and the forces between them.

    Args:
      seen: one snapshot, with the forces of one time step; or a series with a (times,) axis. The
        forces of a series are averaged, and the grains of its middle snapshot are drawn. Few grains
        collide in a short time step. A series with a snapshot of each of a hundred steps
        (``snapshot_series``) shows all collisions of that time.
      colour: "speed", |c| without the shear, or "pressure", of the contacts of each grain over its
        own area.
      strain: strain since the start for the title, or None to leave it out.

    Raises:
      ValueError: ``seen`` is not such a snapshot or not finite, or the colour is unknown.
    """
    scene = scene_of(seen)
    require_colour(colour)
    figure = empty_figure(5.4, 5.4)
    draw_picture(figure.subplots(), scene, colour, common_scale([scene], colour), strain)
    return figure


def require_colour(colour: Any) -> None:
    """Raise an InputError unless the colour is "speed" or "pressure"."""
    if colour not in get_args(Colour):
        raise InputError(f"colour must be speed or pressure, not {short_repr(colour)}.")


def scene_of(seen: Snapshot) -> Scene:
    """The scene of a snapshot, or of a series of snapshots."""
    if not isinstance(seen, Snapshot) or np.ndim(seen.state.side) > 1:
        raise InputError(
            "seen must be a Snapshot of one flow or a series of them, not "
            f"{short_repr(type(seen).__name__)}."
        )
    require_untraced("flow_figure", "draw what the transformed function returns", seen)
    frames = series(seen)
    state, times = frames.state, len(frames.state.side)
    middle = times // 2
    if not (
        np.isfinite(state.positions[middle]).all() and np.isfinite(state.velocities[middle]).all()
    ):
        raise InputError("seen must be a flow of finite positions and velocities.")
    rate = frames.shear_rate[middle].item()
    if not rate > 0:
        raise InputError(
            "seen must be of a sheared flow: its shear rate is the unit of the picture."
        )
    step, instant = frames.timestep[middle].item() * rate, instant_of(seen)
    radii = instant.radii
    return Scene(
        instant=instant,
        pressure=np.bincount(instant.pairs.ravel(), np.repeat(instant.force, 2), len(radii))
        / (2 * np.pi * radii),
        restitution=frames.restitution[middle].item(),
        packing_fraction=float(np.sum(np.pi * radii**2) / instant.side**2),
        timestep=step,
        times=times,
        window=times * (step if times == 1 else float(np.mean(np.diff(state.tilt) % 1))),
    )


def common_scale(scenes: Iterable[Scene], colour: Colour) -> Scale:
    """One scale for several pictures, so that they can be compared."""
    scenes = list(scenes)
    values = np.concatenate([getattr(scene, colour) for scene in scenes])
    forces = np.concatenate([scene.instant.force for scene in scenes])
    return Scale(deepest(values), widest(forces))


class Artists(NamedTuple):
    """What differs from frame to frame in a picture, in the order in which it is drawn."""

    grains: EllipseCollection
    clusters: LineCollection
    binaries: LineCollection
    cell: Polygon
    scale_bar: Line2D
    scale_label: Annotation
    title: Text


def draw_picture(
    axes: Axes, scene: Scene, colour: Colour, scale: Scale, strain: float | None = None
) -> Artists:
    """Draw a scene with its title, colour bar and legend."""
    artists = draw_scene(axes, scene, colour, scale)
    artists.title.set_text(title_of(scene, strain))
    bar_axes = axes.inset_axes((1.02, 0.25, 0.022, 0.7))
    bar = axes.figure.colorbar(artists.grains, cax=bar_axes, extend="max")
    bar.set_label(COLOUR_LABELS[colour], fontsize=TICK_SIZE)
    bar.ax.tick_params(labelsize=SMALL_SIZE)
    axes.legend(handles=force_key(scale), loc="upper left", bbox_to_anchor=(0.0, 0.0), **_LEGEND)
    return artists


def draw_scene(axes: Axes, scene: Scene, colour: Colour, scale: Scale) -> Artists:
    """Draw grains, forces, the cell and a scale bar.

    Parts that reach over an edge of the cell are cut and drawn at the opposite edge.
    """
    side = scene.instant.side
    length = max((n for n in (1, 2, 5, 10, 20, 50, 100) if n <= 0.3 * side), default=1)
    half_width = 0.505 * side * (1 + abs(scene.instant.tilt))
    low, high = -0.6 * side, 0.505 * side
    axes.set(xlim=(-half_width, half_width), ylim=(low, high), aspect="equal")
    axes.set_axis_off()
    (scale_bar,) = axes.plot(
        [0, length], [0, 0], color="black", linewidth=1.6, solid_capstyle="butt"
    )
    artists = Artists(
        grains=EllipseCollection(
            (),
            (),
            (),
            units="xy",
            offsets=np.zeros((0, 2)),
            offset_transform=axes.transData,
            cmap=COLOURS[colour],
            norm=Normalize(0, scale.colour),
            edgecolor=GRAIN_EDGE,
            linewidth=0.4,
            zorder=1,
        ),
        clusters=LineCollection([], zorder=2, **_CLUSTER),
        binaries=LineCollection([], zorder=3, **_BINARY),
        cell=Polygon(
            np.zeros((4, 2)),
            closed=True,
            facecolor="none",
            edgecolor="#404040",
            linewidth=0.9,
            zorder=4,
        ),
        scale_bar=scale_bar,
        scale_label=axes.annotate(
            rf"{length} $\sigma$",
            (0, 0),
            (4, 0),
            textcoords="offset points",
            va="center",
            fontsize=TICK_SIZE,
        ),
        title=axes.set_title("", fontsize=LABEL_SIZE),
    )
    axes.add_patch(artists.cell)
    for artist in (artists.grains, artists.clusters, artists.binaries):
        axes.add_collection(artist, autolim=False)
    show_scene(artists, scene, colour, scale)
    return artists


def show_scene(artists: Artists, scene: Scene, colour: Colour, scale: Scale) -> None:
    """Show another scene of a cell of the same side by artists that are there."""
    instant = scene.instant
    corners = instant.side * np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
    corners[:, 0] += instant.tilt * corners[:, 1]
    artists.cell.set_xy(corners)
    which, places = _images(instant)
    diameters = 2 * instant.radii[which]
    artists.grains.set(
        widths=diameters, heights=diameters, angles=np.zeros(which.size), offsets=places
    )
    artists.grains.set_array(getattr(scene, colour)[which])
    segments, pairs = _segments(instant)
    widths = np.clip(WIDEST_LINE * instant.force / scale.force, THINNEST_LINE, WIDEST_LINE)
    in_clusters = instant.clustered[pairs]
    for lines, chosen in ((artists.clusters, in_clusters), (artists.binaries, ~in_clusters)):
        lines.set_segments(list(segments[chosen]))
        lines.set(linewidths=widths[pairs[chosen]])
    for artist in (artists.grains, artists.clusters, artists.binaries):
        artist.set_clip_path(artists.cell)
    start, length = -0.5 * instant.side * (1 + instant.tilt), np.ptp(artists.scale_bar.get_xdata())
    low = -0.57 * instant.side
    artists.scale_bar.set_data([start, start + length], [low, low])
    artists.scale_label.xy = (start + length, low)


def _segments(instant: Instant) -> tuple[np.ndarray, np.ndarray]:
    """Lines and images of lines that reach into the cell: their ends (images, 2, 2) in σ, and
    indices of the pairs.
    """
    i, j = instant.positions[instant.pairs.T]
    branches = minimum_image(i - j, instant.side, instant.tilt)
    shifts = instant.side * np.array([(a + instant.tilt * b, b) for a, b in _LATTICE])
    segments = np.stack([j, j + branches], axis=1)
    ends = (segments[None] + shifts[:, None, None]).reshape(-1, 2, 2)
    along, up = ends[..., 0] - instant.tilt * ends[..., 1], ends[..., 1]
    reach = (0.5 + _LINE_MARGIN) * instant.side
    inside = np.all(
        [(x.min(axis=-1) < reach) & (x.max(axis=-1) > -reach) for x in (along, up)], axis=0
    )
    return ends[inside], np.tile(np.arange(len(instant.force)), len(shifts))[inside]


def _images(instant: Instant) -> tuple[np.ndarray, np.ndarray]:
    """Grains and images that reach into the cell: indices of the grains (images,) and positions
    (images, 2) in σ.
    """
    side, tilt, radii = instant.side, instant.tilt, instant.radii[:, None]
    places = instant.positions[:, None] + side * np.array([(a + tilt * b, b) for a, b in _LATTICE])
    y = places[..., 1]
    x = places[..., 0] - tilt * y
    inside = (abs(x) <= side / 2 + radii * np.hypot(1, tilt)) & (abs(y) <= side / 2 + radii)
    which, image = np.nonzero(inside)
    return which, places[which, image]


def force_key(scale: Scale) -> Sequence[Line2D]:
    """The legend of the lines, with the force of the widest line."""
    largest = rf"$F\geq{scientific(float(f'{scale.force:.1e}'))}\,m\sigma\dot\gamma^2$"
    keys = (
        (_CLUSTER["color"], 2.5, "in clusters of 3 or more grains"),
        (_BINARY["color"], 2.5, "binary collisions"),
        ("#c4c4c4", WIDEST_LINE, f"widest: {largest}"),
    )
    return [
        Line2D([], [], color=colour, linewidth=width, label=label) for colour, width, label in keys
    ]


def title_of(scene: Scene, strain: float | None = None) -> str:
    """The title: parameters of the flow, and the time over which the forces are averaged."""
    parts = [
        rf"$\alpha={scene.restitution:g}$",
        rf"$\nu={scene.packing_fraction:.4g}$",
        rf"$N={len(scene.pressure)}$",
        rf"$\mathrm{{d}}t={scientific(scene.timestep)}/\dot\gamma$",
    ]
    if strain is not None:
        parts.append(f"strain {strain:.3f}")
    every_step = abs(scene.window / (scene.times * scene.timestep) - 1) < 1e-3
    window = (
        f"{scene.times} time steps, a strain of {scene.window:.3g}"
        if every_step
        else f"{scene.times} snapshots"
    )
    forces = "forces of one time step" if scene.times == 1 else f"mean forces over {window}"
    return f"{', '.join(parts)}\n{forces}"
