"""Picture of two flows of one packing fraction: grains that bounce, and grains that hardly do.

Both flows are sheared to their steady state and on to the same tilt of the cell. Of the next steps
every one is a snapshot, and a line shows the mean force between two grains over that short time: at
α = 0.9 pairs collide one after the other, at α = 0.1 chains of grains push at once.

A movie shows two smaller flows of these restitutions beside each other.

    python -m benchmarks flow_picture            # about 2 minutes
    python -m benchmarks flow_picture --quick    # about a minute: 100 grains, a longer time step
"""

from typing import NamedTuple

import jax
from matplotlib.figure import Figure
from matplotlib.patches import Patch

import jaxgran as jg
from benchmarks.output import Output
from jaxgran.analysis.contacts import ForceNetwork, cluster_share, clusters
from jaxgran.dynamics.snapshot import Snapshot
from jaxgran.plotting.flow import add_colour_bar, common_scale, draw_flow, force_key, network_of
from jaxgran.plotting.movie import Frames, write_movie
from jaxgran.plotting.style import TWO_COLUMNS, empty_figure, styled

RESTITUTIONS, PACKING_FRACTION = (0.9, 0.1), 0.8
TILT = 0.15  # of the cell at the first snapshot
MOVIE_GRAINS, MOVIE_FRAMES = 100, 40
FRAME_STRAIN = 0.004  # between frames, each of which has the mean forces since the one before
TITLES = (
    r"nearly elastic grains collide in pairs ($\alpha=0.9$)",
    r"dissipative ones push in chains ($\alpha=0.1$)",
)


class Choice(NamedTuple):
    grains: int
    timestep: float
    steps: int  # over which forces are averaged
    equilibrate: float | None  # strain, or None until the flow is steady


FULL, QUICK = Choice(324, 1e-4, 20, None), Choice(100, 5e-4, 8, 0.5)


def run(output: Output) -> None:
    """Shear both flows, print what the picture shows, and write JSON and PNG."""
    choice = QUICK if output.quick else FULL
    flows = [window(alpha, choice, choice.steps) for alpha in RESTITUTIONS]
    rows = [summary(alpha, seen) for alpha, seen in zip(RESTITUTIONS, flows, strict=True)]
    for row in rows:
        print(", ".join(f"{name} {value:.4g}" for name, value in row.items()))
    output.write_json("flow", {"nu": PACKING_FRACTION, **choice._asdict(), "flows": rows})
    output.write_picture(draw([network_of(seen) for seen in flows]), "flow")
    movies = [movie(*named, choice) for named in zip(RESTITUTIONS, TITLES, strict=True)]
    write_movie(output.path("flow", ".gif"), *movies)


def window(restitution: float, choice: Choice, steps: int) -> Snapshot:
    """A snapshot for each of some successive time steps of a steady flow."""
    flow = jg.ShearFlow(choice.grains, restitution, PACKING_FRACTION, choice.timestep)
    state = jg.prepare(flow, jax.random.key(0), equilibrate=choice.equilibrate)
    step = choice.timestep
    state, _ = jg.sample(flow, state, strain=(TILT - float(state.tilt)) % 1 + 100 * step)
    return jg.snapshot_series(flow, state, steps * step, steps)[1]


def movie(restitution: float, title: str, choice: Choice) -> Frames:
    """The frames of a small flow."""
    steps = round(FRAME_STRAIN / choice.timestep)
    seen = window(restitution, choice._replace(grains=MOVIE_GRAINS), steps * MOVIE_FRAMES)
    frames = Frames(title)
    for first in range(0, steps * MOVIE_FRAMES, steps):
        frames.keep(seen[first : first + steps], first)
    return frames


def summary(restitution: float, snapshots: Snapshot) -> dict[str, float]:
    """What the picture shows, in numbers."""
    network, share = network_of(snapshots), cluster_share(snapshots)
    return {
        "alpha": restitution,
        "pairs": len(network.force),
        "pairs_mostly_in_clusters": int(network.clustered.sum()),
        "force_share_of_clusters": share.force.value.item(),
        "largest_cluster": float(clusters(snapshots).sizes.max()),
        "mean_speed": float(network.speed.mean()),
        "largest_force": float(network.force.max()),
    }


@styled
def draw(networks: list[ForceNetwork]) -> Figure:
    """The flows beside each other, each in its own scale."""
    figure = empty_figure(TWO_COLUMNS, 3.1)
    handles: list[Patch] = []
    panels = zip(figure.subplots(1, len(networks)), networks, RESTITUTIONS, "ab", strict=True)
    for axes, network, alpha, letter in panels:
        scale = common_scale([network])
        add_colour_bar(axes, draw_flow(axes, network, scale))
        *handles, widest = force_key(scale)
        axes.set_title(rf"({letter}) $\alpha={alpha:g}$; {widest.get_label()}")
    figure.legend(handles=handles, loc="outside lower center", ncols=2)
    return figure
