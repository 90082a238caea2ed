"""Speed against accuracy of whole runs: errors of averages against the time that a unit of strain takes.

Three flows are brought to their steady states once. From there each is sampled with every combination of time step,
tolerance and activation rule, several seeds each, and compared with a reference: the finest time step and tolerance,
run longest. A force ratio belongs to its time step and rule, so its reference is the tightest tolerance at the same
time step and rule: its error is that of the solver alone. The figure shows the pressure; the JSON holds all four.

    python -m benchmarks speed_vs_accuracy           # 20 minutes on two cores
    python -m benchmarks speed_vs_accuracy --quick   # one flow of 64 grains, a minute
"""

import math
import multiprocessing
import time
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from itertools import product
from typing import NamedTuple

import jax
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

import jaxgran as jg
from benchmarks.output import Output
from jaxgran.environment import usable_cores
from jaxgran.plotting.drawing import scientific
from jaxgran.sampling.batch import stack
from jaxgran.sampling.sample import estimates
from jaxgran.sampling.steady_state import prepare_batch

OBSERVABLES = ("pressure", "shear_stress", "granular_temperature", "force_ratio")
DEFAULT = (1e-3, 1e-4, "midpoint")  # of the command line
RELAXATION = 1.0  # strain after a change of the time step


class Config(NamedTuple):
    timestep: float
    tolerance: float
    activation: str


class Plan(NamedTuple):
    """What is run: flows as (restitution, packing fraction), strains of each seed, and the grid of configurations."""

    flows: tuple[tuple[float, float], ...]
    grains: int
    seeds: int
    strain: float
    reference: Config
    reference_strain: float
    configs: tuple[Config, ...]


FULL = Plan(
    flows=((0.9, 0.7), (0.5, 0.8), (0.2, 0.7)),
    grains=256,
    seeds=4,
    strain=100.0,
    reference=Config(1e-4, 1e-6, "midpoint"),
    reference_strain=200.0,
    configs=(
        *(Config(*c, "midpoint") for c in product((1e-2, 3e-3, 1e-3, 3e-4, 1e-4), (1e-1, 1e-2, 1e-3, 1e-4, 1e-6))),
        *(Config(*c, "touching") for c in product((1e-2, 3e-3, 1e-3, 3e-4, 1e-4), (1e-2, 1e-4, 1e-6))),
    ),
)
QUICK = Plan(
    flows=((0.5, 0.7),),
    grains=64,
    seeds=3,
    strain=4.0,
    reference=Config(3e-4, 1e-6, "midpoint"),
    reference_strain=12.0,
    configs=tuple(Config(*c) for c in product((1e-2, 1e-3), (1e-1, 1e-4, 1e-6), ("midpoint", "touching"))),
)


def run(output: Output) -> None:
    """Run the plan on all cores, print a table, and write ``speed_vs_accuracy`` as JSON and PNG."""
    plan = QUICK if output.quick else FULL
    tasks = list(product(plan.flows, range(plan.seeds)))
    start = time.perf_counter()
    if output.quick:  # compilation takes longer than the runs: once, here
        samples = {task: samples_of_seed(plan, task) for task in tasks}
    else:
        with ProcessPoolExecutor(usable_cores(), multiprocessing.get_context("spawn")) as pool:
            samples = dict(zip(tasks, pool.map(samples_of_seed, [plan] * len(tasks), tasks), strict=True))
    flows = [summary(plan, flow, [samples[flow, seed] for seed in range(plan.seeds)]) for flow in plan.flows]
    for flow in flows:
        report(flow)
    result = {
        "plan": {name: value for name, value in plan._asdict().items() if name != "configs"},
        "wall_seconds": time.perf_counter() - start,
        "flows": flows,
    }
    output.write_json("speed_vs_accuracy", result)
    output.write_picture(draw(flows), "speed_vs_accuracy", dpi=200)


def samples_of_seed(plan: Plan, task: tuple[tuple[float, float], int]) -> dict[Config, tuple[jg.Sample, float, int]]:
    """Samples of one seed of one flow for every configuration, with seconds per unit strain and the status."""
    (alpha, nu), seed = task
    flow = jg.ShearFlow(plan.grains, alpha, nu, 1e-3)
    batch = prepare_batch(stack([flow]), jax.random.key(seed)[None])
    state = jax.tree.map(lambda x: x[0], batch.state)
    samples = {}
    for config in dict.fromkeys((plan.reference, *plan.configs)):
        strain = plan.reference_strain if config == plan.reference else plan.strain
        here = jg.ShearFlow(plan.grains, alpha, nu, config.timestep, activation=config.activation)
        solver = jg.BarzilaiBorwein(tolerance=config.tolerance)
        sampled = partial(jg.sample, here, solver=solver)
        relaxed, _ = jax.block_until_ready(sampled(state, RELAXATION))  # so it is compiled before it is timed
        begin = time.process_time()
        _, sample = jax.block_until_ready(sampled(relaxed, strain))
        seconds = (time.process_time() - begin) / strain
        samples[config] = jax.tree.map(np.asarray, sample), seconds, int(sample.status)
    return samples


def summary(plan: Plan, flow: tuple[float, float], seeds: list[dict]) -> dict:
    """Estimates of every configuration of a flow, and their errors relative to the references."""
    found = {config: estimates([seed[config][0] for seed in seeds]) for config in seeds[0]}
    rows = []
    for config in plan.configs:
        tightest = Config(config.timestep, min(c.tolerance for c in plan.configs), config.activation)
        errors = {}
        for name in OBSERVABLES:
            reference = tightest if name == "force_ratio" else plan.reference
            (value, error), (right, unsure) = ((x[0][name], x[1][name]) for x in (found[config], found[reference]))
            noise = 0.0 if config == reference else float(np.hypot(error, unsure) / abs(right))
            errors[name] = (float(value / right - 1), noise)
        rows.append(
            {
                **config._asdict(),
                "seconds_per_strain": float(np.median([seed[config][1] for seed in seeds])),
                "status": jg.Status(max(seed[config][2] for seed in seeds)).name,
                "errors": errors,
                "values": {name: [float(x[name]) for x in found[config]] for name in OBSERVABLES},
            }
        )
    for row in rows:
        row["on_front"] = {name: on_front(row, rows, name) for name in OBSERVABLES}
    values = {name: [float(x[name]) for x in found[plan.reference]] for name in OBSERVABLES}
    return {"restitution": flow[0], "packing_fraction": flow[1], "reference": values, "rows": rows}


def bound(row: dict, name: str) -> float:
    """Size of an error and one standard error of it: what the error of a configuration may be."""
    error, noise = row["errors"][name]
    return abs(error) + noise


def on_front(row: dict, rows: list[dict], name: str) -> bool:
    """Whether no other configuration costs less and is more accurate beyond the noise of both."""
    error, noise = row["errors"][name]

    def beats(other: dict) -> bool:
        its_error, its_noise = other["errors"][name]
        cheaper = other["seconds_per_strain"] < row["seconds_per_strain"]
        return cheaper and other["status"] == "ok" and abs(error) - abs(its_error) > np.hypot(noise, its_noise)

    return row["status"] == "ok" and not any(beats(other) for other in rows)


def staircase(rows: list[dict], name: str) -> list[dict]:
    """Configurations that are cheaper than all with a smaller error bound, the cheapest first, but the reference."""
    judged = [row for row in rows if row["status"] == "ok" and bound(row, name) > 0]
    steps = []
    for row in sorted(judged, key=lambda row: row["seconds_per_strain"]):
        if not steps or bound(row, name) < bound(steps[-1], name):
            steps.append(row)
    return steps


def report(flow: dict) -> None:
    """Print the table of a flow; a star marks what is on the front."""
    print(f"restitution {flow['restitution']:g}, packing fraction {flow['packing_fraction']:g}")
    print("      dt   tolerance  activation   s/strain   " + "".join(f"{name:>24s}" for name in OBSERVABLES))
    for row in sorted(flow["rows"], key=lambda row: row["seconds_per_strain"]):
        cells = (
            f"{100 * error:11.2f} ± {100 * noise:5.2f} %{'*' if row['on_front'][name] else ' '}"
            for name, (error, noise) in row["errors"].items()
        )
        head = (
            f"{row['timestep']:8.0e}{row['tolerance']:12.0e}  {row['activation']:11s}{row['seconds_per_strain']:10.4f} "
        )
        print(head + "  ".join(cells) + f"  {row['status']}", flush=True)


MARKERS = "osD^v"
FLOOR = 1e-3  # smallest error that is drawn
WIDTH = 6.7  # inches; 17 cm
FRONT = "#b35806"


def draw(flows: list[dict], name: str = "pressure") -> Figure:
    """Size of the error of one average against cost, a panel for each flow; the line is the front."""
    figure = Figure(figsize=(WIDTH, 3.6), layout="constrained")
    panels = figure.subplots(1, len(flows), sharey=True, squeeze=False)[0]
    timesteps, tolerances = (
        sorted({row[key] for f in flows for row in f["rows"]}) for key in ("timestep", "tolerance")
    )
    marker = dict(zip(timesteps, MARKERS, strict=False))
    grey = dict(zip(tolerances, np.linspace(0, 0.78, len(tolerances)).astype(str), strict=True))
    for flow, axes in zip(flows, panels, strict=True):
        for row in flow["rows"]:
            draw_point(axes, row, name, marker[row["timestep"]], grey[row["tolerance"]])
        front = staircase(flow["rows"], name)
        costs, bounds = [row["seconds_per_strain"] for row in front], [max(bound(row, name), FLOOR) for row in front]
        axes.step(costs, bounds, where="post", color=FRONT, zorder=1)
        axes.set(
            xscale="log", yscale="log", ylim=(FLOOR, 1), xlim=widened([r["seconds_per_strain"] for r in flow["rows"]])
        )
        axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.set_title(rf"$\alpha={flow['restitution']:g}$, $\nu={flow['packing_fraction']:g}$", fontsize=9)
        axes.tick_params(labelsize=8)
    panels[len(panels) // 2].set_xlabel("CPU time of a unit of strain (s)", fontsize=9)
    panels[0].set_ylabel(f"|relative error| of the {name.replace('_', ' ')}", fontsize=9)
    style = {"linestyle": "none", "markersize": 5, "color": "0.3"}
    handles = [
        *(
            Line2D([], [], marker=marker[dt], label=rf"$\Delta t={scientific(dt)}/\dot\gamma$", **style)
            for dt in timesteps
        ),
        *(
            Line2D([], [], marker="o", label=f"tolerance ${scientific(t)}$", **{**style, "color": grey[t]})
            for t in tolerances
        ),
        Line2D([], [], marker="o", label="touching rule", markerfacecolor="white", **style),
        Line2D([], [], marker="x", label="status not ok", **{**style, "color": "#b2182b"}),
        Line2D([], [], marker="*", label="default", **{**style, "markersize": 11, "color": FRONT}),
        Line2D([], [], color=FRONT, label="front"),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=5, fontsize=7, frameon=False)
    return figure


def widened(costs: list[float]) -> tuple[float, float]:
    """Limits of an axis of costs, so wide that its ticks have room where all cost the same."""
    middle, width = math.sqrt(min(costs) * max(costs)), max(1.3 * math.sqrt(max(costs) / min(costs)), 2.5)
    return middle / width, middle * width


def draw_point(axes: Axes, row: dict, name: str, marker: str, grey: str) -> None:
    """One configuration with its standard error: a cross where its status is not ok, a star for the default."""
    error, noise = row["errors"][name]
    if error == 0 and noise == 0:
        return  # the reference itself
    size, cost = max(abs(error), FLOOR), row["seconds_per_strain"]
    face = grey if row["activation"] == "midpoint" else "white"
    if row["status"] == "ok":
        axes.errorbar(cost, size, [[min(noise, size - FLOOR)], [noise]], color="0.75", elinewidth=0.8, zorder=2)
    if (row["timestep"], row["tolerance"], row["activation"]) == DEFAULT:
        axes.plot(cost, size, "*", color=FRONT, markersize=11, markeredgecolor="black", zorder=5)
    elif row["status"] == "ok":
        axes.plot(cost, size, marker, color=grey, markerfacecolor=face, markersize=4.5, zorder=3)
    else:
        axes.plot(cost, size, "x", color="#b2182b", markersize=5)
