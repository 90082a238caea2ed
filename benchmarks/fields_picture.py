"""Picture of the coarse-grained fields of a dense flow at one instant.

A flow of 1000 grains is prepared and its next step solved. Density, velocity fluctuation, contact pressure with the
contacts that push, and dissipation are drawn on a grid of 128 × 128 points, with a Gaussian of width 0.6 σ,
on one core.

    python -m benchmarks fields_picture            # about 1½ minutes
    python -m benchmarks fields_picture --quick    # half a minute: 256 grains, 48 × 48 points
"""

import time

import jax
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap, Normalize, PowerNorm
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

import jaxgran as jg
from benchmarks.output import Output
from jaxgran.analysis.coarse_graining import gaussian
from jaxgran.analysis.fields import Fields, fields_at, grid
from jaxgran.analysis.force_chains import loaded_contacts
from jaxgran.dynamics.snapshots import Snapshot, snapshot
from jaxgran.plotting.drawing import TWO_COLUMNS, force_lines, styled

RESTITUTION, PACKING_FRACTION, TIMESTEP = 0.2, 0.78, 1e-3
WIDTH = 0.6
REPEATS = 5  # timed evaluations
_WIDEST_LINE = 2.5  # points


def run(output: Output) -> None:
    """Prepare the flow, time the fields, and write JSON and PNG."""
    grains, count, equilibrate = (256, 48, 0.1) if output.quick else (1000, 128, 1.0)
    flow = jg.ShearFlow(grains, RESTITUTION, PACKING_FRACTION, TIMESTEP)
    state = jg.prepare(flow, jax.random.key(0), equilibrate=equilibrate)
    seen = jax.jit(snapshot)(flow, state)
    points, seconds = grid(state.side, count), []
    for _ in range(REPEATS + 1):
        start = time.process_time()
        fields = jax.block_until_ready(fields_at(seen, points, gaussian(WIDTH)))
        seconds.append(time.process_time() - start)
    result = {"grains": grains, "alpha": RESTITUTION, "nu": PACKING_FRACTION, "dt": TIMESTEP, "points": count**2}
    result |= {"gaussian_width": WIDTH, "processor_seconds": float(np.median(seconds[1:]))}
    output.write_json("fields", result)
    output.write_picture(draw(seen, fields, count), "fields")


@styled
def draw(seen: Snapshot, fields: Fields, count: int) -> Figure:
    """Four fields in the cell; the lines join the centres of grains that push, as wide as the force is large."""
    agitation = np.sqrt(np.trace(fields.kinetic_stress, axis1=1, axis2=2) / fields.density)
    pressure = np.trace(fields.contact_stress, axis1=1, axis2=2) / 2
    pale = LinearSegmentedColormap.from_list("pale", ["#ffffff", "#fdd49e", "#ef8a4c"])  # black lines stay visible
    panels = [
        ("density", r"$\rho$  ($m/\sigma^2$)", fields.density, "cividis", Normalize()),
        (
            "velocity fluctuation",
            r"$(\mathrm{tr}\,\Sigma_k/\rho)^{1/2}$  ($\sigma\dot\gamma$)",
            agitation,
            "cividis",
            Normalize(0),
        ),
        (
            "contact pressure, and contacts that push",
            r"$\mathrm{tr}\,\Sigma_s/2$  ($m\dot\gamma^2$)",
            pressure,
            pale,
            PowerNorm(0.5, 0),
        ),
        ("dissipation", r"$\zeta$  ($m\dot\gamma^3$)", fields.dissipation, "cividis", PowerNorm(0.5, 0, clip=True)),
    ]
    figure = Figure(figsize=(TWO_COLUMNS, 5.9), layout="constrained")
    side = float(seen.state.side)
    for axes, (title, unit, values, colours, norm) in zip(figure.subplots(2, 2).ravel(), panels, strict=True):
        image = axes.imshow(
            np.asarray(values).reshape(count, count), origin="lower", extent=(0, side, 0, side), cmap=colours, norm=norm
        )
        figure.colorbar(image, ax=axes, label=unit, shrink=0.9, ticks=MaxNLocator(5))
        axes.set(title=title, xlabel=r"$x/\sigma$", ylabel=r"$y/\sigma$")
        if values is pressure:
            draw_forces(axes, seen)
    return figure


def draw_forces(axes: Axes, seen: Snapshot) -> None:
    """Branches of the loaded contacts and their images, in widths proportional to the forces."""
    load, side, tilt = loaded_contacts(seen), float(seen.state.side), float(seen.state.tilt)
    starts, branches = np.asarray(seen.state.positions)[load.j], load.normals * load.distances[:, None]
    shifts = side * np.array([(a + tilt * b, b) for a in (-1, 0, 1) for b in (-1, 0, 1)])
    widths = _WIDEST_LINE * load.force / load.force.max()
    axes.add_collection(force_lines(starts, branches, shifts, widths, color="black"), autolim=False)
