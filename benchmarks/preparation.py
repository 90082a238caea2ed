"""Does the preparation end in the steady state? Hot against cold starts, and first parts of samples against the rest.

Eight flows of 256 grains at dt = 1e-3 / shear rate start at ten times and at a tenth of their expected granular
temperature. Each is prepared as a map prepares it, and sampled over as many memories. Both starts must end alike, and
the first quarter of the samples must be like the rest.

    python -m benchmarks preparation           # 5 minutes on two cores
    python -m benchmarks preparation --quick   # two flows of 64 grains, under a minute
"""

import multiprocessing
import time
from concurrent.futures import ProcessPoolExecutor
from typing import NamedTuple

import jax
import numpy as np
from matplotlib.figure import Figure

import jaxgran as jg
from benchmarks.output import Output
from jaxgran.environment import usable_cores
from jaxgran.sampling.batch import stack
from jaxgran.sampling.sample import Sample, estimates
from jaxgran.sampling.steady_state import prepare_batch, sample_batch

HOT, COLD = 10.0, 0.1
FIRST = 8  # blocks of a sample, of 32
QUANTITIES = {"granular_temperature": "granular temperature", "pressure": "pressure"}


class Plan(NamedTuple):
    """Restitution and packing fraction of the flows, number of grains, and seeds of each start."""

    flows: tuple[tuple[float, float], ...]
    grains: int
    seeds: int


FULL = Plan(((0.1, 0.3), (0.2, 0.2), (0.2, 0.6), (0.5, 0.6), (0.8, 0.2), (0.95, 0.1), (0.5, 0.75), (0.8, 0.8)), 256, 24)
QUICK = Plan(((0.2, 0.6), (0.8, 0.2)), 64, 4)


def run(output: Output) -> None:
    """Run the plan on all cores, print the ratios, and write ``preparation`` as JSON and PNG."""
    plan = QUICK if output.quick else FULL
    start = time.perf_counter()
    with ProcessPoolExecutor(usable_cores(), multiprocessing.get_context("spawn")) as pool:
        rows = list(pool.map(compared, [plan] * len(plan.flows), plan.flows))
    for row in rows:
        words = ", ".join(f"{name} {row[name][0]:.3f} ± {row[name][1]:.3f}" for name in row if "over" in name)
        print(f"α {row['restitution']:g}, ν {row['packing_fraction']:g}: {words}; {row['not_ok']} not ok")
    head = {"plan": plan._asdict(), "timestep": 1e-3, "hot": HOT, "cold": COLD}
    output.write_rows("preparation", {**head, "wall_seconds": time.perf_counter() - start}, "flows", rows)
    output.write_picture(draw(rows, plan), "preparation")


def compared(plan: Plan, point: tuple[float, float]) -> dict:
    """One flow: hot over cold starts, and the first quarter of the samples over the rest, with standard errors."""
    alpha, nu = point
    flow = stack([jg.ShearFlow(plan.grains, alpha, nu, 1e-3)] * plan.seeds)
    keys = jax.random.split(jax.random.key(7), plan.seeds)
    hot, cold = (measured(flow, keys, heat) for heat in (HOT, COLD))
    batches = [one[0] for one in (hot, cold)]
    samples = [sample for one in (hot, cold) for sample in one[1]]
    first, rest = ([part(one, early) for one in samples] for early in (True, False))
    row = {
        "restitution": alpha,
        "packing_fraction": nu,
        "memory": float(np.mean([one.memory for one in batches])),
        "strain_before": float(np.mean([one.strain for one in batches])),
        "strain": float(np.mean([np.sum(one.tally.duration) for one in samples])),
        "not_ok": sum(int(np.sum(np.asarray(one.status) != 0)) for one in batches),
    }
    for name in QUANTITIES:
        row[f"{name}_hot_over_cold"] = ratio(name, hot[1], cold[1])
        row[f"{name}_first_over_rest"] = ratio(name, first, rest)
    return row


def measured(flow: jg.ShearFlow, keys: jax.Array, heat: float):
    """The batch and the samples of flows that start at so many times the expected granular temperature."""
    batch, sample = sample_batch(prepare_batch(flow, keys, heat=heat), None)
    return batch, [jax.tree.map(lambda x, k=k: np.asarray(x)[k], sample) for k in range(len(keys))]


def part(sample: Sample, early: bool) -> Sample:
    """The first blocks of a sample, or the rest."""
    tally = jax.tree.map(lambda x: x[:FIRST] if early else x[FIRST:], sample.tally)
    return Sample(tally, sample.area, sample.shear_rate, sample.grains)


def ratio(name: str, above: list[Sample], below: list[Sample]) -> list[float]:
    """The quotient of two averages over seeds, with the standard error that the scatter of the seeds gives."""
    values = [np.array([float(estimates([one])[0][name]) for one in samples]) for samples in (above, below)]
    means = [x.mean() for x in values]
    errors = [x.std(ddof=1) / np.sqrt(len(x)) for x in values]
    quotient = means[0] / means[1]
    return [float(quotient), float(quotient * np.hypot(errors[0] / means[0], errors[1] / means[1]))]


def draw(rows: list[dict], plan: Plan) -> Figure:
    """Both quotients of every flow, with intervals of 95 %."""
    figure = Figure(figsize=(9, 0.5 * len(rows) + 1.8), layout="constrained")
    panels = figure.subplots(1, 2, sharey=True, sharex=True)
    titles = ("hot_over_cold", "hot over cold start"), ("first_over_rest", "first quarter over the rest")
    for axes, (key, title) in zip(panels, titles, strict=True):
        for k, (name, label) in enumerate(QUANTITIES.items()):
            value, error = np.array([row[f"{name}_{key}"] for row in rows]).T
            places = np.arange(len(rows)) + (0.15 if k else -0.15)
            style = {"marker": "os"[k], "color": ("black", "tab:red")[k], "markerfacecolor": ("black", "white")[k]}
            axes.errorbar(value, places, xerr=1.96 * error, linestyle="none", capsize=2, label=label, **style)
        axes.axvline(1, color="0.6", linewidth=0.8)
        axes.set_title(title, fontsize="medium")
        axes.set_xlabel("quotient, with 95 % intervals")
        axes.grid(color="0.9", axis="x")
    names = [f"α {row['restitution']:g}, ν {row['packing_fraction']:g}" for row in rows]
    panels[0].set_yticks(range(len(rows)), names)
    panels[0].invert_yaxis()
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2, fontsize="small", frameon=False)
    figure.suptitle(
        f"{plan.grains} grains, dt = 1e-3 / shear rate, {plan.seeds} seeds of each start", fontsize="medium"
    )
    return figure
