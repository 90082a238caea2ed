"""Speed against accuracy of whole runs: errors of averages against the time that a unit of strain
takes.

Three flows are brought to their steady states once. From there each is sampled with every
combination of time step, tolerance and activation rule, several seeds each, and compared with a
reference: the finest time step and tolerance, run longest. A force ratio belongs to its time step
and rule, so its reference is the tightest tolerance at the same time step and rule: its error is
that of the solver alone. The figure shows the results of ``peers`` too; it is drawn by ``python -m
benchmarks draw speed_vs_accuracy``.

    python -m benchmarks speed_vs_accuracy           # 11 minutes on two cores
    python -m benchmarks speed_vs_accuracy --quick   # one flow of 64 grains, a minute
"""

import multiprocessing
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from itertools import product
from typing import NamedTuple

import jax
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FixedLocator, LogLocator, NullLocator, StrMethodFormatter

import jaxgran as jg
from benchmarks.output import Output
from benchmarks.peers.front import TARGET
from jaxgran.dynamics.batch import stack
from jaxgran.environment import usable_cores
from jaxgran.plotting.style import TWO_COLUMNS, styled
from jaxgran.sampling.sample import estimates
from jaxgran.sampling.steady_state import prepare_batch

OBSERVABLES = ("pressure", "shear_stress", "granular_temperature", "force_ratio")
SOFT = "#b35806"
RELAXATION = 1.0  # strain after a change of the time step


class Config(NamedTuple):
    timestep: float
    tolerance: float
    activation: str


class Plan(NamedTuple):
    """What is run: flows as (restitution, packing fraction), strains of each seed, and the grid of
    configurations.
    """

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
        *(
            Config(*c, "midpoint")
            for c in product((1e-2, 3e-3, 1e-3, 3e-4, 1e-4), (1e-1, 1e-2, 1e-3, 1e-4, 1e-6))
        ),
        *(
            Config(*c, "touching")
            for c in product((1e-2, 3e-3, 1e-3, 3e-4, 1e-4), (1e-2, 1e-4, 1e-6))
        ),
    ),
)
QUICK = Plan(
    flows=((0.5, 0.7),),
    grains=64,
    seeds=3,
    strain=4.0,
    reference=Config(3e-4, 1e-6, "midpoint"),
    reference_strain=12.0,
    configs=tuple(
        Config(*c) for c in product((1e-2, 1e-3), (1e-1, 1e-4, 1e-6), ("midpoint", "touching"))
    ),
)


def run(output: Output) -> None:
    """Run the plan on all cores, print a table, and write ``speed_vs_accuracy`` as JSON."""
    plan = QUICK if output.quick else FULL
    tasks = list(product(plan.flows, range(plan.seeds)))
    start = time.perf_counter()
    if output.quick:  # compilation takes longer than the runs: once, here
        samples = {task: samples_of_seed(plan, task) for task in tasks}
    else:
        with ProcessPoolExecutor(usable_cores(), multiprocessing.get_context("spawn")) as pool:
            samples = dict(
                zip(tasks, pool.map(samples_of_seed, [plan] * len(tasks), tasks), strict=True)
            )
    flows = [
        summary(plan, flow, [samples[flow, seed] for seed in range(plan.seeds)])
        for flow in plan.flows
    ]
    for flow in flows:
        report(flow)
    result = {
        "plan": {name: value for name, value in plan._asdict().items() if name != "configs"},
        "wall_seconds": time.perf_counter() - start,
        "flows": flows,
    }
    output.write_json("speed_vs_accuracy", result)


def samples_of_seed(
    plan: Plan, task: tuple[tuple[float, float], int]
) -> dict[Config, tuple[jg.Sample, float, int]]:
    """Samples of one seed of one flow for every configuration, with seconds per unit strain and the
    status.
    """
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
        relaxed, _ = jax.block_until_ready(
            sampled(state, RELAXATION)
        )  # so it is compiled before it is timed
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
        tightest = Config(
            config.timestep, min(c.tolerance for c in plan.configs), config.activation
        )
        errors = {}
        for name in OBSERVABLES:
            reference = tightest if name == "force_ratio" else plan.reference
            (value, error), (right, unsure) = (
                (x[0][name], x[1][name]) for x in (found[config], found[reference])
            )
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


def on_front(row: dict, rows: list[dict], name: str) -> bool:
    """Whether no other configuration costs less and is more accurate beyond the noise of both."""
    error, noise = row["errors"][name]

    def beats(other: dict) -> bool:
        its_error, its_noise = other["errors"][name]
        cheaper = other["seconds_per_strain"] < row["seconds_per_strain"]
        return (
            cheaper
            and other["status"] == "ok"
            and abs(error) - abs(its_error) > np.hypot(noise, its_noise)
        )

    return row["status"] == "ok" and not any(beats(other) for other in rows)


def report(flow: dict) -> None:
    """Print the table of a flow; a star marks what is on the front."""
    print(f"restitution {flow['restitution']:g}, packing fraction {flow['packing_fraction']:g}")
    print(
        "      dt   tolerance  activation   s/strain   "
        + "".join(f"{name:>24s}" for name in OBSERVABLES)
    )
    for row in sorted(flow["rows"], key=lambda row: row["seconds_per_strain"]):
        cells = (
            f"{100 * error:11.2f} ± {100 * noise:5.2f} %{'*' if row['on_front'][name] else ' '}"
            for name, (error, noise) in row["errors"].items()
        )
        head = (
            f"{row['timestep']:8.0e}{row['tolerance']:12.0e}  "
            f"{row['activation']:11s}{row['seconds_per_strain']:10.4f} "
        )
        print(head + "  ".join(cells) + f"  {row['status']}", flush=True)


# of the figure: the errors of peers that share the cell, then those of force ratio and pressure
# here
PROGRAMS = {  # curve of ``peers``: label, marker, line, colour, face
    "jaxgran": ("jaxgran, tolerance $10^{-4}$", "o", "-", "black", "black"),
    "jaxgran, tolerance 1e-2": ("jaxgran, tolerance $10^{-2}$", "s", "--", "0.45", "0.45"),
    "numba loop": ("numba loop", "^", ":", "black", "white"),
    "LAMMPS, 20 steps a contact": ("LAMMPS, 20 steps a contact", "D", "-", SOFT, SOFT),
    "LAMMPS, 10 steps a contact": ("LAMMPS, 10 steps a contact", "d", "--", SOFT, "white"),
}
SERIES = {  # observable, tolerance, activation: label, marker, line, colour, face
    ("force_ratio", 1e-4, "midpoint"): (
        "force ratio, tolerance $10^{-4}$",
        "o",
        "-",
        "black",
        "black",
    ),
    ("force_ratio", 1e-2, "midpoint"): (
        "force ratio, tolerance $10^{-2}$",
        "s",
        "--",
        "0.45",
        "0.45",
    ),
    ("force_ratio", 1e-1, "midpoint"): ("force ratio, tolerance $10^{-1}$", "v", ":", "0.6", "0.6"),
    ("force_ratio", 1e-4, "touching"): (
        "force ratio, touching rule",
        "o",
        "-",
        "tab:green",
        "white",
    ),
    ("pressure", 1e-4, "midpoint"): (
        "pressure, tolerance $10^{-4}$",
        "^",
        "-",
        "tab:blue",
        "white",
    ),
}
TICKS = (-1, -0.3, -0.1, -0.03, 0, 0.03, 0.1, 0.3, 1, 3)


@styled
def draw(peers: dict, own: dict) -> Figure:
    """Signed errors against cost: the pressure by three programs, and below it force ratio and
    pressure of jaxgran.

    Args:
      peers: the result of the benchmark of this name.
      own: the result of this one. A force ratio is compared with that of the finest time step and
        tolerance.
    """
    figure = Figure(figsize=(TWO_COLUMNS, 4.6), layout="constrained")
    grid = figure.subplots(2, 3, sharey=True, sharex="col")
    for axes, flow in zip(grid[0], peers["flows"], strict=True):
        for curve, look in PROGRAMS.items():
            rows = [row for row in flow["rows"] if row["curve"] == curve and "errors" in row]
            draw_curve(
                axes,
                [1e6 * row["cpu_seconds_per_strain"] / peers["discs"] for row in rows],
                *np.transpose([row["errors"]["pressure"] for row in rows]),
                look,
            )
    flows = sorted(own["flows"], key=lambda flow: flow["packing_fraction"])
    for axes, flow in zip(grid[1], flows, strict=True):
        finest = next(
            row
            for row in flow["rows"]
            if Config(**{n: row[n] for n in Config._fields}) == FULL.reference
        )
        for (name, tolerance, activation), look in SERIES.items():
            rows = [
                row
                for row in flow["rows"]
                if (row["tolerance"], row["activation"]) == (tolerance, activation)
            ]
            costs = np.array(
                [1e6 * row["seconds_per_strain"] / own["plan"]["grains"] for row in rows]
            )
            values, noise = np.transpose([row["values"][name] for row in rows])
            right = finest["values"][name][0]
            draw_curve(axes, costs, values / right - 1, noise / right, look)
            bad = np.array([row["status"] != "ok" for row in rows])
            axes.plot(costs[bad], (values / right - 1)[bad], "x", color="tab:red", ms=5, zorder=4)
    for row, letters, what in zip(
        grid, ("abc", "def"), ("pressure", "force ratio and pressure"), strict=True
    ):
        for axes, letter, flow in zip(
            row, letters, peers["flows"] if what == "pressure" else flows, strict=True
        ):
            axes.set_title(
                rf"({letter}) $\alpha={flow['restitution']:g}$, $\nu={flow['packing_fraction']:g}$",
                loc="left",
            )
        row[0].set_ylabel(f"error of {what}")
    for axes in grid.flat:
        axes.axhspan(-TARGET, TARGET, color="0.92", zorder=0)
        axes.axhline(0, color="0.5", lw=0.6, zorder=1)
        axes.set(xscale="log", ylim=(-1.1, 5))
        axes.set_yscale("symlog", linthresh=TARGET, linscale=0.6)
        axes.yaxis.set_major_locator(FixedLocator(TICKS))
        axes.yaxis.set_minor_locator(NullLocator())
        axes.yaxis.set_major_formatter(
            lambda value, _: f"{100 * value:+.0f} %".replace("-", "−").replace("+0", "0")
        )
        axes.xaxis.set_major_locator(LogLocator(subs=(1,)))
        axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    grid[1, 1].set_xlabel(r"CPU time of a grain in a unit of strain (µs)")
    columns = [legend_of(list(looks.values())) for looks in (PROGRAMS, SERIES)]
    columns[1].append(
        Line2D([], [], marker="x", color="tab:red", ls="none", ms=5, label="status not ok")
    )
    columns[0].append(Patch(color="0.92", label=f"within {100 * TARGET:g} %"))
    for handles, place in zip(columns, ("upper", "lower"), strict=True):
        figure.legend(handles=handles, loc=f"outside {place} center", ncols=3)
    return figure


def legend_of(looks: list[tuple[str, ...]]) -> list[Line2D | Patch]:
    """Entries of a legend."""
    return [
        Line2D([], [], marker=marker, ls=line, color=colour, mfc=face, label=label)
        for label, marker, line, colour, face in looks
    ]


def draw_curve(
    axes: Axes, costs: Sequence[float], errors: np.ndarray, noise: np.ndarray, look: tuple
) -> None:
    """One curve with its standard errors."""
    _, marker, line, colour, face = look
    axes.errorbar(
        costs,
        errors,
        noise,
        marker=marker,
        ls=line,
        color=colour,
        mfc=face,
        ms=3.5,
        lw=0.9,
        elinewidth=0.6,
    )
