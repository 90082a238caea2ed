"""Pictures of a flow: its grains, coloured by speed or pressure, and the forces between them.

The window is a square of the side of the periodic cell, so that each grain is there once; what is
cut at an edge continues at the opposite one, shifted by the shear at top and bottom. Bars join the
centres of grains that push each other, as wide as the force is large, within limits. A bar is black
if most of its force acts within clusters of three or more grains. It is red, and much lighter in a
grey print, if the two grains collide without touching others.
"""

from collections.abc import Iterable
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection, PolyCollection
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from jaxgran.analysis.contacts import ForceNetwork, force_network
from jaxgran.analysis.series import series
from jaxgran.dynamics.snapshot import Snapshot
from jaxgran.model.cell import minimum_image
from jaxgran.model.checks import InputError, require_untraced, short_repr
from jaxgran.plotting.encoding import (
    BINARY_COLOUR,
    CLUSTER_COLOUR,
    GRAIN_EDGE,
    GRAIN_RAMPS,
    deepest,
    widest,
)
from jaxgran.plotting.style import ONE_COLUMN, empty_figure, scientific, styled

Colour = Literal["speed", "pressure"]

COLOUR_LABELS: dict[str, str] = {
    "speed": r"peculiar speed $|c|$  ($\sigma\dot\gamma$)",
    "pressure": r"contact pressure of a grain  ($m\dot\gamma^2$)",
}
COLOURS = {
    name: LinearSegmentedColormap.from_list(name, ramp) for name, ramp in GRAIN_RAMPS.items()
}
WIDEST_BAR, THINNEST_BAR = 0.45, 0.05  # in σ, bars of the largest and of the smallest force
_LATTICE = np.array([(a, b) for a in (-1, 0, 1) for b in (-1, 0, 1)])  # a cell and its neighbours


class Scale(NamedTuple):
    """The values of the deepest colour and the widest bar of a picture; larger values look the
    same.

    ``colour`` is a speed in σγ̇ or a pressure in mγ̇², ``force`` a force in mσγ̇².
    """

    colour: float
    force: float


class Artists(NamedTuple):
    """What differs from picture to picture of a flow, in the order in which it is drawn."""

    grains: EllipseCollection
    clusters: PolyCollection
    binaries: PolyCollection


@styled
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
    if colour not in get_args(Colour):
        raise InputError(f"colour must be speed or pressure, not {short_repr(colour)}.")
    network = network_of(seen)
    scale = common_scale([network], colour)
    figure = empty_figure(1.5 * ONE_COLUMN, 1.4 * ONE_COLUMN)
    axes = figure.add_subplot(title=title_of(seen, strain))
    add_colour_bar(axes, draw_flow(axes, network, colour, scale), colour)
    figure.legend(handles=force_key(scale), loc="outside lower left", ncols=3, handlelength=1.2)
    return figure


def network_of(seen: Snapshot) -> ForceNetwork:
    """The grains and forces of a snapshot, or of a series of snapshots; checks that they can be
    drawn.
    """
    if not isinstance(seen, Snapshot) or np.ndim(seen.state.side) > 1:
        raise InputError(
            "seen must be a Snapshot of one flow or a series of them, not "
            f"{short_repr(type(seen).__name__)}."
        )
    require_untraced("flow_figure", "draw what the transformed function returns", seen)
    if not (np.isfinite(seen.state.positions).all() and np.isfinite(seen.state.velocities).all()):
        raise InputError("seen must be a flow of finite positions and velocities.")
    if not (np.asarray(seen.shear_rate) > 0).all():
        raise InputError(
            "seen must be of a sheared flow: its shear rate is the unit of the picture."
        )
    return force_network(seen)


def pressures(network: ForceNetwork) -> Float[np.ndarray, " grains"]:
    """Σ F r/2πr² over the contacts of each grain, in mγ̇²."""
    forces, radii = np.repeat(network.force, 2), network.radii
    return np.bincount(network.pairs.ravel(), forces, len(radii)) / (2 * np.pi * radii)


def common_scale(networks: Iterable[ForceNetwork], colour: Colour) -> Scale:
    """One scale for several pictures, so that they can be compared."""
    networks = list(networks)
    values = np.concatenate([_values(network, colour) for network in networks])
    return Scale(deepest(values), widest(np.concatenate([network.force for network in networks])))


def _values(network: ForceNetwork, colour: Colour) -> Float[np.ndarray, " grains"]:
    return network.speed if colour == "speed" else pressures(network)


# ----------------------------------------------------------------------------------------------
# drawing


def draw_flow(axes: Axes, network: ForceNetwork, colour: Colour, scale: Scale) -> Artists:
    """Draw grains and forces in a square window."""
    half = network.side / 2
    axes.set(xlim=(-half, half), ylim=(-half, half), aspect="equal", xticks=(), yticks=())
    artists = Artists(
        EllipseCollection(
            *((), (), ()),
            units="xy",
            offsets=np.zeros((0, 2)),
            offset_transform=axes.transData,
            cmap=COLOURS[colour],
            norm=Normalize(0, scale.colour),
            edgecolor=GRAIN_EDGE,
            linewidth=0.4,
        ),
        PolyCollection([], facecolor=CLUSTER_COLOUR, linewidth=0),
        PolyCollection([], facecolor=BINARY_COLOUR, linewidth=0),
    )
    for artist in artists:
        axes.add_collection(artist, autolim=False)
    show_flow(artists, network, colour, scale)
    return artists


def show_flow(artists: Artists, network: ForceNetwork, colour: Colour, scale: Scale) -> None:
    """Show another instant of a flow by artists that are there."""
    which, places = grain_images(network)
    sizes = 2 * network.radii[which]
    artists.grains.set(widths=sizes, heights=sizes, angles=0 * sizes, offsets=places)
    artists.grains.set_array(_values(network, colour)[which])
    pairs, middles, along, widths = bar_images(network, scale.force)
    extension = (widths / np.linalg.norm(2 * along, axis=-1))[:, None]
    across = along[:, ::-1] * [-1, 1] * extension
    tip = along * (1 + extension)  # fills the corner to the next bar
    corners = [along + across, tip, along - across, -along - across, -tip, -along + across]
    bars = middles[:, None] + np.stack(corners, axis=1)
    in_clusters = network.clustered[pairs]
    artists.clusters.set_verts(list(bars[in_clusters]))
    artists.binaries.set_verts(list(bars[~in_clusters]))


def grain_images(network: ForceNetwork) -> tuple[np.ndarray, np.ndarray]:
    """The grains in the window, with those cut at an edge at both: indices (images,) and centres
    (images, 2) in σ.
    """
    return _images(network, network.positions, network.radii)


def bar_images(network: ForceNetwork, force: float) -> tuple[np.ndarray, ...]:
    """The bars in the window: indices of pairs (images,), middles and half branches (images, 2),
    and widths (images,), in σ.

    Args:
      network: grains and forces.
      force: the force of the widest bar, in mσγ̇².
    """
    i, j = network.positions[network.pairs.T]
    branches = minimum_image(i - j, network.side, network.tilt)
    widths = np.clip(WIDEST_BAR * network.force / force, THINNEST_BAR, WIDEST_BAR)
    reach = np.linalg.norm(branches, axis=-1) / 2 + widths
    pairs, middles = _images(network, j + branches / 2, reach)
    return pairs, middles, branches[pairs] / 2, widths[pairs]


def _images(
    network: ForceNetwork, points: np.ndarray, reach: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Points and their images that reach into the window: indices (images,) and positions
    (images, 2) in σ.
    """
    shifts = network.side * (_LATTICE + network.tilt * _LATTICE[:, 1:] * [1, 0])
    places = points[:, None] + shifts
    which, image = np.nonzero((abs(places) <= network.side / 2 + reach[:, None, None]).all(axis=-1))
    return which, places[which, image]


def add_colour_bar(axes: Axes, artists: Artists, colour: Colour) -> None:
    """Explain the colours of the grains at the right."""
    label = COLOUR_LABELS[colour]
    axes.figure.colorbar(artists.grains, ax=axes, label=label, extend="max", shrink=0.8, pad=0.02)


def force_key(scale: Scale) -> list[Patch]:
    """The legend of the bars, with the force of the widest one."""
    largest = rf"$F\geq{scientific(float(f'{scale.force:.1e}'))}\,m\sigma\dot\gamma^2$"
    keys = (
        (CLUSTER_COLOUR, "in clusters of 3 or more grains"),
        (BINARY_COLOUR, "binary collisions"),
        ("#c4c4c4", f"widest: {largest}"),
    )
    return [Patch(facecolor=colour, label=label) for colour, label in keys]


def title_of(seen: Snapshot, strain: float | None = None) -> str:
    """The parameters of a flow, and the time over which its forces are averaged."""
    frames: Any = series(seen)
    times, state = len(frames.state.side), frames.state
    area, rate = np.pi * np.sum(state.grains.radii[0] ** 2), frames.shear_rate[0]
    timestep = float(frames.timestep[0] * rate)
    parts = [
        rf"$\alpha={frames.restitution[0]:g}$",
        rf"$\nu={area / state.side[0] ** 2:.4g}$",
        rf"$N={state.positions.shape[1]}$",
        rf"$\mathrm{{d}}t={scientific(timestep)}/\dot\gamma$",
    ]
    if strain is not None:
        parts.append(f"strain {strain:.3f}")
    if times == 1:
        return f"{', '.join(parts)}\nforces of one time step"
    between = float(np.mean(np.diff(state.tilt) % 1))
    every_step = abs(between / timestep - 1) < 1e-3
    window = f"{times} time steps, a strain of {times * between:.3g}"
    mean = f"mean forces over {window if every_step else f'{times} snapshots'}"
    return f"{', '.join(parts)}\n{mean}"
