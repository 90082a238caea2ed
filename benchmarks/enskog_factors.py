"""Which assumption of kinetic theory fails, against the time step and the number of grains: what
survives the limits?

Five flows, midpoint rule. Contact stresses and dissipation rate over Enskog's are split into five
factors, see ``jaxgran.sampling.enskog_factors``. Against dt at N = 256, from 1e-2 to 1e-5: each
seed reaches its steady state at dt = 1e-3; from there the coarser step is sampled, then the finer
ones in turn, each after a strain of 0.5. Against N at dt = 1e-3, from 100 to 1600. A seed is
sampled over a strain of 2√N, as the correlation strain of a flow grows with the side of its cell.

    python -m benchmarks enskog_factors           # about 3 minutes on two cores
    python -m benchmarks enskog_factors --quick   # two flows of 64 and 144 grains, half a minute
"""

import multiprocessing
import time
from concurrent.futures import ProcessPoolExecutor
from itertools import product
from math import sqrt
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

import jaxgran as jg
from benchmarks.output import Output
from jaxgran.environment import usable_cores
from jaxgran.plotting.style import SMALL_SIZE, TWO_COLUMNS, curve_styles, styled
from jaxgran.sampling.enskog_factors import LENGTHS, RATES, measured_over_enskog
from jaxgran.sampling.sample import estimates
from jaxgran.theory.assumptions import ASSUMPTIONS

START = 1e-3  # time step of the steady state, and of all numbers of grains
RELAXATION = 0.5
TITLES = {
    "local_temperature": "local\ntemperature",
    "anisotropy": "anisotropy\nof the temperature",
    "chaos": "chaos: squared\nspeed of approach",
    "pairs": "pair correlation\nat contact",
    "binary": "binary\nassumption",
}

advance = jax.jit(jg.advance)


class Plan(NamedTuple):
    """Restitution and packing fraction of the flows, seeds, numbers of grains, and time steps at
    one of them.
    """

    flows: tuple[tuple[float, float], ...]
    seeds: int
    sizes: tuple[int, ...]
    size_of_timesteps: int
    timesteps: tuple[float, ...]


FULL = Plan(
    ((0.95, 0.3), (0.8, 0.6), (0.5, 0.6), (0.2, 0.6), (0.2, 0.75)),
    4,
    (100, 256, 400, 800, 1600),
    256,
    (1e-2, 3e-3, 1e-3, 3e-4, 1e-4, 3e-5, 1e-5),
)
QUICK = Plan(((0.8, 0.6), (0.2, 0.6)), 2, (64, 144), 64, (1e-3, 1e-4))


def run(output: Output) -> None:
    """Run the plan on all cores, print a line for each flow, N and dt, and write JSON and PNG."""
    plan = QUICK if output.quick else FULL
    tasks = sorted(product(plan.sizes, plan.flows, range(plan.seeds)), key=lambda task: -task[0])
    start = time.perf_counter()
    with ProcessPoolExecutor(usable_cores(), multiprocessing.get_context("spawn")) as pool:
        done = dict(zip(tasks, pool.map(samples, [plan] * len(tasks), tasks), strict=True))
    print(
        "   α    ν     N      dt  status          force ratio    T local   factors of the "
        "pressure: " + ", ".join(ASSUMPTIONS)
    )
    rows = []
    for flow, grains in product(plan.flows, plan.sizes):
        for timestep in timesteps(plan, grains):
            seeds = [done[grains, flow, seed][timestep] for seed in range(plan.seeds)]
            rows.append(row(jg.ShearFlow(grains, *flow, timestep), seeds))
            print(line(rows[-1]), flush=True)
    head = {"plan": plan._asdict(), "wall_seconds": time.perf_counter() - start}
    output.write_rows("enskog_factors", head, "rows", rows)
    output.write_picture(draw(plan, rows), "enskog_factors")


def timesteps(plan: Plan, grains: int) -> tuple[float, ...]:
    """Time steps at a number of grains, the longest first."""
    return (
        tuple(sorted(plan.timesteps, reverse=True))
        if grains == plan.size_of_timesteps
        else (START,)
    )


def samples(plan: Plan, task: tuple[int, tuple[float, float], int]) -> dict[float, jg.Sample]:
    """One seed of one flow and number of grains: a sample of every time step."""
    grains, (alpha, nu), seed = task
    strain = max(sqrt(grains), 2 / (nu * (1 - alpha**2)))
    steady = state = jg.prepare(
        jg.ShearFlow(grains, alpha, nu, START), jax.random.key(seed), equilibrate=strain
    )
    sampled = {}
    for timestep in timesteps(plan, grains):
        flow = jg.ShearFlow(grains, alpha, nu, timestep)
        before = steady if timestep >= START else state
        relaxed, _ = advance(flow, before, jnp.int32(round(RELAXATION / timestep)))
        state, sample = jg.sample(flow, relaxed, 2 * sqrt(grains))
        sampled[timestep] = jax.tree.map(np.asarray, sample)
    return sampled


def row(flow: jg.ShearFlow, seeds: list[jg.Sample]) -> dict:
    """The factors of one flow with their standard errors, and what else is known of it."""
    value, error = (
        measured | estimate
        for measured, estimate in zip(
            measured_over_enskog(flow, seeds), estimates(seeds), strict=True
        )
    )
    warm = value["local_granular_temperature"] / value["granular_temperature"]
    numbers = {"force_ratio": [value["force_ratio"], error["force_ratio"]]}
    numbers |= {
        name: [value[name], error[name]]
        for name in (*(f"{rate}_{factor}" for rate in RATES for factor in ASSUMPTIONS), *LENGTHS)
    }
    return {
        "alpha": flow.restitution,
        "nu": flow.packing_fraction,
        "grains": flow.grains,
        "timestep": flow.timestep,
        "status": jg.Status(max(int(seed.status) for seed in seeds)).name,
        "local_over_granular_temperature": float(f"{warm:.4g}"),
        **{name: [float(f"{x:.4g}") for x in pair] for name, pair in numbers.items()},
    }


def line(row: dict) -> str:
    """A row as it is printed."""
    factors = "".join(
        "{:8.3f} ± {:.3f}".format(*row[f"pressure_{factor}"]) for factor in ASSUMPTIONS
    )
    begin = "{alpha:4g} {nu:4g} {grains:5d} {timestep:7g}  {status:12s}".format(**row)
    warm = row["local_over_granular_temperature"]
    return begin + "{:8.3f} ± {:.3f}".format(*row["force_ratio"]) + f"{warm:8.2f} {factors}"


@styled
def draw(plan: Plan, rows: list[dict]) -> Figure:
    """The factors of the pressure: a row for each, against dt on the left and N on the right, a
    line for each flow.
    """
    figure = Figure(figsize=(TWO_COLUMNS, 8.2), layout="constrained")
    grid = figure.subplots(len(ASSUMPTIONS), 2, sharex="col", sharey="row")
    sides = (("timestep", "grains", plan.size_of_timesteps), ("grains", "timestep", START))
    for panels, factor in zip(grid, ASSUMPTIONS, strict=True):
        for axes, (x, fixed, at) in zip(panels, sides, strict=True):
            for flow, style in zip(plan.flows, curve_styles(len(plan.flows)), strict=True):
                some = [
                    row for row in rows if (row["alpha"], row["nu"]) == flow and row[fixed] == at
                ]
                places = [row[x] for row in some]
                value, error = np.array([row[f"pressure_{factor}"] for row in some]).T
                label = f"α = {flow[0]:g}, ν = {flow[1]:g}"
                axes.errorbar(
                    places, value, error, **style, markersize=4, linewidth=1, capsize=2, label=label
                )
                bad = np.array([row["status"] != "ok" for row in some])
                if bad.any():
                    axes.plot(
                        np.array(places)[bad],
                        value[bad],
                        "o",
                        markersize=9,
                        fillstyle="none",
                        color="0.3",
                    )
            axes.axhline(1, color="0.6", linewidth=0.8, zorder=0)
            axes.set(xscale="log", yscale="log")
            axes.yaxis.set_major_formatter("{x:g}")
            axes.yaxis.set_minor_formatter("{x:g}")
            axes.tick_params(axis="y", which="minor", labelsize=7)
        panels[0].set_ylabel(TITLES[factor])
    grid[-1, 0].set_xlabel(
        rf"time step $\dot\gamma\,\mathrm{{d}}t$, at $N$ = {plan.size_of_timesteps}"
    )
    grid[-1, 1].set_xlabel(rf"number of grains $N$, at $\dot\gamma\,\mathrm{{d}}t$ = {START:g}")
    handles, _ = grid[0, 0].get_legend_handles_labels()
    ring = Line2D([], [], marker="o", markersize=9, fillstyle="none", color="0.3", linestyle="none")
    figure.legend(
        [*handles, ring],
        [*(handle.get_label() for handle in handles), "status not ok"],
        title="contact pressure: measured over assumed",
        loc="outside upper center",
        ncols=3,
        fontsize=SMALL_SIZE,
        frameon=False,
    )
    return figure
