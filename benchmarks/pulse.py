"""What a loose contact solve does to physics: a packing that is pushed at one side.

Touching rigid discs at rest stand in a strip of a triangular lattice, periodic across, between a free side and a fixed
wall. From the first step on, each disc of the free side is pushed by a force F. Rigid discs pass it on at once: the
wall feels the whole force in the first step, and nothing moves. A solve that is stopped early has carried it over some
discs only. The others learn of it in later steps, so a front moves through the packing at a speed that has nothing to
do with the grains: its unit is diameters a step. Unger, Brendel, Wolf and Kertész (Phys. Rev. E 65, 061305, 2002)
found this for Gauss–Seidel sweeps of a fixed number that start from the forces of the step before. Here each solve
starts from zero, and ends at a tolerance.

The limit of a small force is taken: normals stay, no gap opens, and all is linear in F, so F does not matter.
Every pair that touches is a contact of every step. Restitution is zero.

    python -m benchmarks pulse           # two minutes
    python -m benchmarks pulse --quick   # a shorter strip and fewer tolerances, half a minute
"""

from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import jaxgran as jg
from benchmarks.gauss_seidel import gauss_seidel
from benchmarks.output import Output
from jaxgran.contact.delassus import grain_impulses
from jaxgran.contact.network import Contacts
from jaxgran.contact.solver import Solution, solve
from jaxgran.model.status import Status
from jaxgran.plotting.drawing import TWO_COLUMNS, scientific, styled

ROWS, LENGTH = 4, 100  # discs across, and along
STEPS = 100
DEFAULT = 1e-4  # tolerance of the program
TOLERANCES = (0.3, 1e-1, 3e-2, 1e-2, 3e-3, 1e-3, 3e-4, 1e-4, 1e-5, 1e-6)
DRAWN = (0.3, 1e-1, 1e-2, 1e-3, 1e-4)  # tolerances of the first panel
SWEEPS = "Gauss–Seidel"
MOST_ITERATIONS = 1_000_000
METHODS = {
    "barzilai-borwein": jg.BarzilaiBorwein(max_steps=MOST_ITERATIONS),
    "nesterov": jg.Nesterov(max_steps=MOST_ITERATIONS),
    "jacobi": jg.Jacobi(max_steps=MOST_ITERATIONS, relaxation=1.0),
}
SMALLEST = {"barzilai-borwein": 1e-6, "nesterov": 1e-6, "jacobi": 1e-3, SWEEPS: 1e-4}  # below, minutes to run
STYLES = {
    "barzilai-borwein": ("black", "o", "-"),
    "nesterov": ("tab:blue", "s", "--"),
    "jacobi": ("tab:red", "D", "-."),
    SWEEPS: ("tab:green", "^", ":"),
}


class Strip(NamedTuple):
    """Pairs that touch in a strip of discs, and the normals and places of the discs."""

    i: np.ndarray
    j: np.ndarray
    normals: np.ndarray
    inverse_masses: np.ndarray
    columns: np.ndarray  # of a disc, from 0 at the free side; half numbers in every other row


def strip(length: int, rows: int = ROWS) -> Strip:
    """A triangular lattice of discs of diameter and mass one; its last column is fixed."""
    discs = [(x, y) for y in range(rows) for x in range(length)]
    number = {disc: k for k, disc in enumerate(discs)}
    columns = np.array([x + (y % 2) / 2 for x, y in discs])
    fixed = columns >= length - 1
    pairs = []
    for x, y in discs:
        beside, up = ((x + 1, y), (1.0, 0.0)), (y + 1) % rows
        above = [((x + y % 2 - left, up), (0.5 - left, np.sqrt(0.75))) for left in (0, 1)]
        for other, normal in (beside, *above):
            if other in number and not (fixed[number[other]] and fixed[number[x, y]]):
                pairs.append((number[other], number[x, y], normal))
    i, j, normals = (np.array(values) for values in zip(*pairs, strict=True))
    return Strip(i, j, normals, np.where(fixed, 0.0, 1.0), columns)


def network(made: Strip, velocities: np.ndarray) -> Contacts:
    """All pairs of a strip as contacts, at these velocities of the discs."""
    inverse = made.inverse_masses
    return Contacts(
        i=jnp.asarray(made.i),
        j=jnp.asarray(made.j),
        normals=jnp.asarray(made.normals),
        distances=jnp.ones(len(made.i)),
        approach=jnp.asarray(np.sum(made.normals * (velocities[made.i] - velocities[made.j]), axis=-1)),
        inverse_mass_i=jnp.asarray(inverse[made.i]),
        inverse_mass_j=jnp.asarray(inverse[made.j]),
        used=jnp.ones(len(made.i), bool),
    )


@partial(jax.jit, static_argnames="discs")
def _solved(contacts: Contacts, discs: int, solver: jg.ProjectedMethod, tolerance: float) -> Solution:
    """The solution to a tolerance that may be above the range of flows, as a traced number is not checked."""
    return solve(contacts, discs, 0.0, replace(solver, tolerance=tolerance), jnp.bool_(True))


class Pushed(NamedTuple):
    """What a push does to a strip.

    ==========  ==========  ==================================================================================
    field       shape       meaning
    ==========  ==========  ==================================================================================
    front       (steps,)    columns, from the free side, that pass on at least half of the force
    wall        (steps,)    force on the wall over that of the push
    moved       (steps,)    speed of the free side after the step, over that of a free disc pushed for one step
    iterations  (steps,)    products with W, or sweeps
    ==========  ==========  ==================================================================================
    """

    front: np.ndarray
    wall: np.ndarray
    moved: np.ndarray
    iterations: np.ndarray


def pushed(made: Strip, method: str, tolerance: float, steps: int) -> Pushed:
    """Push the free side of a strip for some steps."""
    discs, pushed_ones = len(made.columns), made.columns < 1
    edges = np.arange(1, int(made.columns.max()) + 1) - 0.25  # cuts between columns, the last at the wall
    ends = np.sort(np.stack([made.columns[made.i], made.columns[made.j]]), axis=0)
    crossing = (ends[0] < edges[:, None]) & (ends[1] > edges[:, None])
    velocities, rows = np.zeros((discs, 2)), []
    for _ in range(steps):
        velocities[pushed_ones, 0] += 1.0
        contacts = network(made, velocities)
        if method == SWEEPS:
            solution = gauss_seidel(contacts, discs, tolerance, MOST_ITERATIONS, 0.0)
        else:
            solution = _solved(contacts, discs, METHODS[method], tolerance)
        status = Status(int(solution.status))
        if status != Status.ok:
            raise RuntimeError(f"{method} has failed at a tolerance of {tolerance:g}: {status.name}.")
        impulses = np.asarray(solution.impulses)
        momenta = np.asarray(grain_impulses(contacts, jnp.asarray(impulses), discs))
        velocities = velocities + momenta * made.inverse_masses[:, None]
        passed = crossing @ (impulses * np.abs(made.normals[:, 0])) / pushed_ones.sum()
        front = len(passed) if np.all(passed >= 0.5) else int(np.argmax(passed < 0.5))
        rows.append((front, passed[-1], np.mean(velocities[pushed_ones, 0]), int(solution.iterations)))
    return Pushed(*(np.array(values) for values in zip(*rows, strict=True)))


def summary(seen: Pushed, columns: int) -> dict[str, float | bool]:
    """Speed of the front, residual force at the wall and creep of the free side, the latter two of the last steps.

    ``speed`` is in columns a step, over the steps until the front is at the wall, or over all; ``at_once`` tells that
    it was there in the first step, so that the speed is a lower bound. ``residual_force`` is the root mean square of
    the force on the wall over that of the push, less one. ``creep`` is the speed of the free side, over that of a free
    disc pushed for one step.
    """
    steps = int(np.argmax(seen.front)) + 1
    late = slice(2 * len(seen.wall) // 3, None)
    return {
        "speed": float(seen.front.max() / steps),
        "at_once": bool(seen.front[0] == columns),
        "residual_force": float(np.sqrt(np.mean((seen.wall[late] - 1) ** 2))),
        "creep": float(np.mean(np.abs(seen.moved[late]))),
        "iterations": float(np.mean(seen.iterations)),
    }


def run(output: Output) -> None:
    """Push the strip by every method at every tolerance, print what is seen, and write JSON and PNG."""
    length, steps = (40, 40) if output.quick else (LENGTH, STEPS)
    tolerances = DRAWN if output.quick else TOLERANCES
    made, rows = strip(length), []
    print("method            tolerance   columns a step   residual force   creep     products or sweeps a step")
    for method, smallest in SMALLEST.items():
        for tolerance in tolerances:
            if tolerance >= smallest:
                seen = pushed(made, method, tolerance, steps)
                row = {
                    "method": method,
                    "tolerance": tolerance,
                    **summary(seen, length - 1),
                    "wall": seen.wall.round(5).tolist(),
                }
                print(
                    f"{method:17} {tolerance:<9g}   {'>= ' if row['at_once'] else '   '}{row['speed']:<11.3g}   "
                    f"{row['residual_force']:<14.2g}   {row['creep']:<7.2g}   {row['iterations']:.0f}",
                    flush=True,
                )
                rows.append(row)
    head = {"discs_along": length, "discs_across": ROWS, "steps": steps, "precision": "float64"}
    output.write_rows("pulse", {"run": head}, "rows", rows)
    output.write_picture(draw(rows, length), "pulse")


@styled
def draw(rows: list[dict[str, Any]], length: int) -> Figure:
    """The force on the wall in time, and the speed of the front against the tolerance, by method."""
    figure = Figure(figsize=(TWO_COLUMNS, 2.6), layout="constrained")
    wall, speed = figure.subplots(1, 2)
    swept = [row for row in rows if row["method"] == SWEEPS and row["tolerance"] in DRAWN]
    for row, line, shade in zip(swept, (":", "-.", "--", (0, (6, 1)), "-"), (0.65, 0.5, 0.35, 0.2, 0.0), strict=True):
        times, label = np.arange(1, len(row["wall"]) + 1), f"${scientific(row['tolerance'])}$"
        wall.plot(times, row["wall"], linestyle=line, color=str(shade), label=label)
    wall.set(xscale="log", xlabel="time step", ylabel="force on the wall / force of the push", ylim=(-0.1, 1.1))
    wall.legend(title="tolerance", loc="center", bbox_to_anchor=(0.52, 0.5))
    wall.set_title(f"(a) {SWEEPS}", loc="left")
    for method, (colour, marker, line) in STYLES.items():
        known = [row for row in rows if row["method"] == method]
        style = {"color": colour, "marker": marker, "linestyle": line, "label": method}
        speed.plot([row["tolerance"] for row in known], [row["speed"] for row in known], **style)
    speed.axhline(length - 1, color="0.6", linewidth=0.8, zorder=0)
    speed.axvline(DEFAULT, color="0.6", linewidth=0.8, linestyle=":")
    speed.set(ylabel="speed of the front ($\\sigma$ a step)", ylim=(0.3, 2 * length))
    speed.set(xscale="log", yscale="log", xlabel="tolerance of the contact solve", xlim=(0.5, 5e-7))
    speed.set_title("(b)", loc="left")
    speed.legend(loc="lower right")
    return figure
