"""Picture of two flows of one packing fraction: grains that bounce, and grains that hardly do.

Both flows are sheared to their steady state and on to the same tilt of the cell. Of the next steps
every one is a snapshot, and a line shows the mean force between two grains over that short time: at
α = 0.9 pairs collide one after the other, at α = 0.1 chains of grains push at once.

A movie shows a third flow, by the command that the README gives.

    python -m benchmarks flow_picture            # about 2 minutes
    python -m benchmarks flow_picture --quick    # about a minute: 100 grains, a longer time step
"""

import subprocess
import sys
from typing import NamedTuple

import jax
import numpy as np
from matplotlib.figure import Figure

import jaxgran as jg
from benchmarks.output import Output
from jaxgran.analysis.force_chains import cluster_share, clusters
from jaxgran.dynamics.snapshots import Snapshot
from jaxgran.plotting.flow import (
    COLOUR_LABELS,
    Colour,
    Scene,
    common_scale,
    draw_scene,
    force_key,
    scene_of,
)
from jaxgran.plotting.style import TWO_COLUMNS, styled

RESTITUTIONS, PACKING_FRACTION = (0.9, 0.1), 0.8
THINNER = 0.6  # lines of the figure, over those of a flow that fills a page
TILT = 0.15  # of the cell at the first snapshot
MOVIE = (
    "run --restitution 0.3 --packing-fraction 0.78 --grains 100 --strain 0.5 --frame-strain "
    "0.02 --movie"
)


class Choice(NamedTuple):
    grains: int
    timestep: float
    steps: int  # over which forces are averaged
    equilibrate: float | None  # strain, or None until the flow is steady


FULL, QUICK = Choice(324, 1e-4, 20, None), Choice(100, 5e-4, 8, 0.5)


def run(output: Output, colour: Colour = "speed") -> None:
    """Shear both flows, print what the picture shows, and write JSON and PNG."""
    choice = QUICK if output.quick else FULL
    flows = [window(restitution, choice) for restitution in RESTITUTIONS]

    rows = [
        summary(restitution, snapshots)
        for restitution, snapshots in zip(RESTITUTIONS, flows, strict=True)
    ]
    for row in rows:
        print(", ".join(f"{name} {value:.4g}" for name, value in row.items()))
    output.write_json("flow", {"nu": PACKING_FRACTION, **choice._asdict(), "flows": rows})
    output.write_picture(draw([scene_of(snapshots) for snapshots in flows], colour), "flow")
    movie = str(output.path("flow", ".gif"))
    subprocess.run(
        [sys.executable, "-m", "jaxgran", *MOVIE.split(), movie, "--overwrite"], check=True
    )


def window(restitution: float, choice: Choice) -> Snapshot:
    """A snapshot for each of some successive time steps of a steady flow."""
    flow = jg.ShearFlow(choice.grains, restitution, PACKING_FRACTION, choice.timestep)
    state = jg.prepare(flow, jax.random.key(0), equilibrate=choice.equilibrate)
    step = choice.timestep
    state, _ = jg.sample(flow, state, strain=(TILT - float(state.tilt)) % 1 + 100 * step)
    return jg.snapshot_series(flow, state, choice.steps * step, choice.steps)[1]


def summary(restitution: float, snapshots: Snapshot) -> dict[str, float]:
    """What the picture shows, in numbers."""
    scene, share = scene_of(snapshots), cluster_share(snapshots)
    return {
        "alpha": restitution,
        "pairs": len(scene.instant.force),
        "pairs_mostly_in_clusters": int(scene.instant.clustered.sum()),
        "force_share_of_clusters": share.force.value.item(),
        "largest_cluster": float(clusters(snapshots).sizes.max()),
        "mean_speed": float(scene.speed.mean()),
        "largest_force": float(scene.instant.force.max()),
    }


@styled
def draw(scenes: list[Scene], colour: Colour) -> Figure:
    """The flows beside each other, each in its own scale."""
    figure = Figure(figsize=(TWO_COLUMNS, 3.15), layout="constrained")
    handles = []
    for axes, scene, letter in zip(figure.subplots(1, len(scenes)), scenes, "ab", strict=True):
        scale = common_scale([scene], colour)
        artists = draw_scene(axes, scene, colour, scale)
        for lines in (artists.clusters, artists.binaries):
            lines.set_linewidth(THINNER * np.array(lines.get_linewidth()))
        *handles, widest = force_key(scale)
        artists.title.set_text(rf"({letter}) $\alpha={scene.restitution:g}$; {widest.get_label()}")
        figure.colorbar(
            artists.grains,
            ax=axes,
            label=COLOUR_LABELS[colour],
            extend="max",
            shrink=0.75,
            pad=0.01,
        )
    figure.legend(handles=handles, loc="outside lower center", ncols=2)
    return figure
