"""Pictures of a flow: its grains, coloured by their speed, and the forces between them.

The window is a square of the side of the periodic cell, so that each grain is there once; what is
cut at an edge continues at the opposite one, shifted by the shear at top and bottom. Bars join the
centres of grains that push each other, as wide as the force is large, within limits. A bar is black
if most of its force acts within clusters of three or more grains. It is red, and much lighter in a
grey print, if the two grains collide without touching others.
"""

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
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
from jaxgran.plotting.style import ONE_COLUMN, empty_figure, scientific, styled

SPEED_COLOURS = LinearSegmentedColormap.from_list("speed", ["#ffffff", "#cfe4f0", "#8fbfd9"])
GRAIN_EDGE, CLUSTER_COLOUR, BINARY_COLOUR = "#8c8c8c", "#1a1a1a", "#e0552f"
_SPEED_SHARE, _FORCE_SHARE = 0.98, 0.95  # of grains and forces below those of the scale
WIDEST_BAR, THINNEST_BAR = 0.45, 0.05  # in σ, bars of the largest and of the smallest force
_LATTICE = np.array([(a, b) for a in (-1, 0, 1) for b in (-1, 0, 1)])  # a cell and its neighbours


class Scale(NamedTuple):
    """What has the deepest colour and the widest bar of a picture; larger values look the same."""

    speed: float  # in σγ̇
    force: float  # in mσγ̇²


@styled
def flow_figure(seen: Snapshot, strain: float | None = None) -> Figure:
    """A picture of a flow: its grains and the forces between them.

    Args:
      seen: one snapshot, with the forces of one time step; or a series with a (times,) axis. The
        forces of a series are averaged, and the grains of its middle snapshot are drawn. Few grains
        collide in a short time step. A series with a snapshot of each of a hundred steps
        (``snapshot_series``) shows all collisions of that time.
      strain: strain since the start for the title, or None to leave it out.

    Raises:
      ValueError: ``seen`` is not such a snapshot or not finite.
    """
    network = network_of(seen)
    scale = common_scale([network])
    figure = empty_figure(1.5 * ONE_COLUMN, 1.4 * ONE_COLUMN)
    axes = figure.add_subplot(title=title_of(seen, strain))
    add_colour_bar(axes, draw_flow(axes, network, scale))
    figure.legend(handles=force_key(scale), loc="outside lower left", ncols=3, handlelength=1.2)
    return figure


def network_of(seen: Snapshot) -> ForceNetwork:
    """The grains and forces of a snapshot or a series; InputError if they cannot be drawn."""
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


def common_scale(networks: Iterable[ForceNetwork]) -> Scale:
    """One scale for several pictures, so that they can be compared."""
    speeds, forces = zip(*((network.speed, network.force) for network in networks), strict=True)
    moving, pushing = np.concatenate(speeds), np.concatenate(forces)
    moving = moving[moving > 0]
    return Scale(
        float(np.quantile(moving, _SPEED_SHARE)) if moving.size else 1.0,
        float(np.quantile(pushing, _FORCE_SHARE)) if pushing.size else 1.0,
    )


def draw_flow(axes: Axes, network: ForceNetwork, scale: Scale) -> EllipseCollection:
    """Draw a flow in a square window, in place of what is drawn there: its grains, which are
    returned, and the forces in clusters and of binary collisions.
    """
    for artist in list(axes.collections):
        artist.remove()
    half = network.side / 2
    axes.set(xlim=(-half, half), ylim=(-half, half), aspect="equal", xticks=(), yticks=())
    which, places = grain_images(network)
    sizes = 2 * network.radii[which]
    grains = EllipseCollection(
        *(sizes, sizes, 0 * sizes),
        units="xy",
        offsets=places,
        offset_transform=axes.transData,
        array=network.speed[which],
        cmap=SPEED_COLOURS,
        norm=Normalize(0, scale.speed),
        edgecolor=GRAIN_EDGE,
        linewidth=0.4,
    )
    pairs, middles, along, widths = bar_images(network, scale.force)
    extension = (widths / np.linalg.norm(2 * along, axis=-1))[:, None]
    across = along[:, ::-1] * [-1, 1] * extension
    tip = along * (1 + extension)  # fills the corner to the next bar
    corners = [along + across, tip, along - across, -along - across, -tip, -along + across]
    bars, clustered = middles[:, None] + np.stack(corners, axis=1), network.clustered[pairs]
    axes.add_collection(grains, autolim=False)
    for chosen, ink in ((clustered, CLUSTER_COLOUR), (~clustered, BINARY_COLOUR)):
        drawn = PolyCollection(list(bars[chosen]), facecolor=ink, linewidth=0)
        axes.add_collection(drawn, autolim=False)
    return grains


def grain_images(network: ForceNetwork) -> tuple[np.ndarray, np.ndarray]:
    """The grains in the window, at both edges where cut: indices (images,), centres (images, 2)."""
    return _images(network, network.positions, network.radii)


def bar_images(network: ForceNetwork, force: float) -> tuple[np.ndarray, ...]:
    """The bars in the window, if the widest has this force in mσγ̇²: indices of pairs (images,),
    middles and half branches (images, 2), and widths (images,), in σ.
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
    """Points and their images that reach into the window: indices and positions in σ."""
    shifts = network.side * (_LATTICE + network.tilt * _LATTICE[:, 1:] * [1, 0])
    places = points[:, None] + shifts
    which, image = np.nonzero((abs(places) <= network.side / 2 + reach[:, None, None]).all(axis=-1))
    return which, places[which, image]


def add_colour_bar(axes: Axes, grains: EllipseCollection) -> None:
    """Explain the colours of the grains at the right."""
    label = r"peculiar speed $|c|$  ($\sigma\dot\gamma$)"
    axes.figure.colorbar(grains, ax=axes, label=label, extend="max", shrink=0.8, pad=0.02)


def force_key(scale: Scale) -> list[Patch]:
    """The legend of the bars, with the force of the widest one."""
    largest = rf"$F\geq{scientific(float(f'{scale.force:.1e}'))}\,m\sigma\dot\gamma^2$"
    return [
        Patch(facecolor=CLUSTER_COLOUR, label="in clusters of 3 or more grains"),
        Patch(facecolor=BINARY_COLOUR, label="binary collisions"),
        Patch(facecolor="#c4c4c4", label=f"widest: {largest}"),
    ]


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
    moved = np.diff(state.positions[..., 1], axis=0)
    moved -= state.side[0] * np.rint(moved / state.side[0])
    fastest = np.abs(state.velocities[..., 1]).max() * frames.timestep[0]
    # the tilt alone does not tell whole units of strain
    every_step = abs(between / timestep - 1) < 1e-3 and np.abs(moved).max() <= 1.01 * fastest
    window = f"{times} time steps, a strain of {times * between:.3g}"
    mean = f"mean forces over {window if every_step else f'{times} snapshots'}"
    return f"{', '.join(parts)}\n{mean}"
