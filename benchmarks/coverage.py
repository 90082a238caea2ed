"""How often 95 % intervals hold the true mean: series made to measure, and repeats of sheared flows.

The errors are those of ``standard_errors``, beside those of ``jackknife``. An interval is 1.96 errors to each side. Its
width is given over that of the true interval, 1.96 standard deviations of the mean.

The made series have 32 blocks and a known mean. Their correlation falls as exp(-k/t) over k blocks, or half of their
variance is white noise, or they have two memories, t with 0.6 and t/8 with 0.4 of the variance. Their strain is given
in 2t, the strain that counts as one independent sample where the correlation falls as exp(-k/t).

Each flow is repeated with independent grains. A repeat is prepared over five memories and sampled over eight, and its
first two, four and six memories are judged too, all in 32 blocks. The memory is max(nT/τ, 0.35 L √(ρ/p)) in strain. The
repeats are divided at random into groups of seeds. The truth is the value from all R repeats. It shares the k seeds of
a group, so a deviation from it is divided by √(1 - k/R).

    python -m benchmarks coverage           # about 6 minutes on a core
    python -m benchmarks coverage --quick   # two flows of 64 grains, under a minute
"""

import time
from collections.abc import Iterator
from functools import partial
from typing import NamedTuple

import jax
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

import jaxgran as jg
from benchmarks.output import Output
from jaxgran.dynamics.tally import Tally
from jaxgran.sampling.correlation_strain import flow_correlation_strain
from jaxgran.sampling.observables import averages
from jaxgran.sampling.sample import BLOCKS
from jaxgran.statistics import jackknife, standard_errors

METHODS = {"jackknife": jackknife, "standard_errors": standard_errors}
OBSERVABLES = ("force_ratio", "pressure", "shear_stress", "granular_temperature")
SEEDS = (1, 2, 4, 8)
STRAINS = (2, 4, 6, 8)  # sampled, in memories of the flow
PARTS = {"one memory": ((1.0, 1),), "with white noise": ((0.5, 1), (0.5, 1e9)), "two memories": ((0.6, 1), (0.4, 8))}
DECAYS = (0.2, 0.5, 1.0, 2.0, 4.0, 8.0, 12.0)  # t of a made series, in blocks
PREPARED = 5  # memories before the sample
PILOT = 4.0  # strain of the sample that gives the memory of a flow
NORMAL_QUANTILE = 1.96
HOLDS = (0.92, 0.98)  # shares of intervals that are accepted


class Plan(NamedTuple):
    """Flows as (restitution, packing fraction), grains, time step, repeats of a flow, trials of a made series."""

    flows: tuple[tuple[float, float], ...]
    grains: int
    timestep: float
    repeats: int
    trials: int


DILUTE = ((0.1, 0.3), (0.2, 0.2), (0.95, 0.1), (0.8, 0.2), (0.5, 0.4))
DENSE = ((0.2, 0.6), (0.5, 0.6), (0.8, 0.6), (0.9, 0.7), (0.2, 0.75), (0.5, 0.79), (0.8, 0.8))
FULL = Plan((*DILUTE, *DENSE), 256, 1e-3, 64, 1000)
QUICK = Plan(((0.8, 0.6), (0.8, 0.8)), 64, 1e-3, 8, 100)


def run(output: Output) -> None:
    """Judge the made series and the flows, print a table, and write ``coverage`` as JSON and PNG."""
    plan, rng, start = QUICK if output.quick else FULL, np.random.default_rng(0), time.perf_counter()
    rows = [row for parts in PARTS for row in made_rows(plan, parts, rng)]
    print("made series: shares of intervals that hold / mean width, jackknife | standard_errors")
    for row in rows:
        print(f"{row['series']:17s} strain/2t {row['strain']:5.1f}, seeds {row['seeds']}: {words(row)}")
    for flow in plan.flows:
        rows += flow_rows(plan, *flow, rng)
        print(f"α {flow[0]:g}, ν {flow[1]:g}: {time.perf_counter() - start:.0f} s", flush=True)
    over_flows = [*means_over_flows(rows)]
    print(f"mean over {len(plan.flows)} flows, and the smallest share of a flow")
    for row in over_flows:
        print(f"{row['series']:21s} strain/memory {row['strain']}, seeds {row['seeds']}: {words(row)}")
    head = {"plan": plan._asdict(), "seconds": time.perf_counter() - start}
    output.write_rows("coverage", head, "rows", [*rows, *over_flows])
    output.write_picture(draw([*rows, *over_flows]), "coverage", dpi=120)


def words(row: dict) -> str:
    """Shares and widths of both methods; in brackets the smallest share of a flow."""
    texts = []
    for method in METHODS:
        least = f" [{row[f'{method}_least']:.2f}]" if f"{method}_least" in row else ""
        texts.append(f"{row[f'{method}_holds']:.2f}{least} / {row[f'{method}_width']:.2f}")
    return " | ".join(texts)


def made_rows(plan: Plan, series: str, rng: np.random.Generator) -> Iterator[dict]:
    """A row for every decay and number of seeds of one kind of made series."""
    for decay in DECAYS:
        lag = np.abs(np.subtract.outer(np.arange(BLOCKS), np.arange(BLOCKS)))
        correlation = sum(share * np.exp(-lag * shorter / decay) for share, shorter in PARTS[series])
        factor = np.linalg.cholesky(correlation)
        for seeds in SEEDS:
            blocks = factor @ rng.normal(size=(seeds, BLOCKS, plan.trials))
            true = np.sqrt(correlation.sum() / BLOCKS**2 / seeds)
            row = {"series": series, "strain": BLOCKS / (2 * decay), "seeds": seeds}
            for name, method in METHODS.items():
                values, errors = method(mean, {"x": blocks, "count": np.ones((seeds, BLOCKS, 1))})
                row |= judged(name, values["mean"], errors["mean"], true)
            yield row


def mean(sums: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    return {"mean": sums["x"] / sums["count"]}


def judged(method: str, deviations: np.ndarray, errors: np.ndarray, true: float | np.ndarray) -> dict[str, float]:
    """The share of intervals that hold the truth, and their mean width over the true one."""
    holds = np.mean(np.abs(deviations) < NORMAL_QUANTILE * errors)
    return {f"{method}_holds": round(float(holds), 4), f"{method}_width": round(float(np.mean(errors / true)), 4)}


def flow_rows(plan: Plan, alpha: float, nu: float, rng: np.random.Generator) -> Iterator[dict]:
    """A row for every observable, sampled strain and number of seeds of one flow."""
    memory, samples = repeats(plan, alpha, nu)
    average = partial(chosen_averages, area=samples.area[0], grains=plan.grains, shear_rate=samples.shear_rate[0])
    for strain in STRAINS:
        tally = in_blocks(samples.tally, strain)
        truth = average(tally.total(axis=(0, 1)))
        single = average(tally.total(axis=1))
        for seeds in SEEDS:
            if 2 * seeds > plan.repeats:
                continue
            groups = [group for _ in range(seeds) for group in divided(rng, plan.repeats, seeds)]
            found = {name: [method(average, picked(tally, one)) for one in groups] for name, method in METHODS.items()}
            head = {"restitution": alpha, "packing_fraction": nu, "memory": round(memory, 3)}
            for observable in OBSERVABLES:
                true = np.std(single[observable], ddof=1) / np.sqrt(seeds)
                row = {"series": observable, **head, "strain": strain, "seeds": seeds}
                for name, pairs in found.items():
                    values, errors = np.array([[part[observable] for part in pair] for pair in pairs]).T
                    deviations = (values - truth[observable]) / np.sqrt(1 - seeds / plan.repeats)
                    row |= judged(name, deviations, errors, true)
                yield row


def repeats(plan: Plan, alpha: float, nu: float) -> tuple[float, jg.Sample]:
    """Memory of a flow in strain, and its independent samples, with a leading axis of repeats."""
    flow = jg.ShearFlow(plan.grains, alpha, nu, plan.timestep)
    state, pilot = jg.sample(flow, jg.prepare(flow, jax.random.key(plan.repeats), equilibrate=10.0), PILOT)
    mass = float(np.sum(state.grains.masses))
    memory = float(flow_correlation_strain(pilot.averages, plan.grains, mass, pilot.area, flow.shear_rate))
    samples = []
    for seed in range(plan.repeats):
        state = jg.prepare(flow, jax.random.key(seed), equilibrate=PREPARED * memory)
        _, sample = jg.sample(flow, state, STRAINS[-1] * memory, BLOCKS * STRAINS[-1] // STRAINS[0])
        samples.append(jax.tree.map(np.asarray, sample))
    return memory, jax.tree.map(lambda *x: np.stack(x), *samples)


def in_blocks(tally: Tally, strain: int) -> Tally:
    """The first memories of all repeats in ``BLOCKS`` blocks, (repeats, blocks)."""
    merge = strain // STRAINS[0]
    first = jax.tree.map(lambda x: x[:, : BLOCKS * merge].reshape(len(x), BLOCKS, merge, *x.shape[2:]), tally)
    return first.total(axis=2)


def picked(tally: Tally, group: np.ndarray) -> Tally:
    return jax.tree.map(lambda x: x[group], tally)


def divided(rng: np.random.Generator, repeats: int, seeds: int) -> np.ndarray:
    """Numbers of the repeats in random groups, (groups, seeds)."""
    return rng.permutation(repeats)[: repeats // seeds * seeds].reshape(-1, seeds)


def chosen_averages(tally: Tally, **flow: float) -> dict[str, np.ndarray]:
    found = averages(tally, **flow)
    return {name: np.asarray(found[name]) for name in OBSERVABLES}


def means_over_flows(rows: list[dict]) -> Iterator[dict]:
    """Shares and widths averaged over the flows, and the smallest share, by observable, strain and seeds."""
    of_flows = [row for row in rows if "memory" in row]
    for key in dict.fromkeys((row["series"], row["strain"], row["seeds"]) for row in of_flows):
        same = [row for row in of_flows if (row["series"], row["strain"], row["seeds"]) == key]
        averaged = dict(zip(("series", "strain", "seeds"), key, strict=True))
        for method in METHODS:
            for what in ("holds", "width"):
                averaged[f"{method}_{what}"] = round(float(np.mean([row[f"{method}_{what}"] for row in same])), 4)
            averaged[f"{method}_least"] = min(row[f"{method}_holds"] for row in same)
        yield averaged


STYLES = {1: ("0.0", "o"), 2: ("0.4", "s"), 8: ("0.65", "^")}  # of the seeds drawn: grey and marker
LINES = {"standard_errors": "-", "jackknife": ":"}


def draw(rows: list[dict]) -> Figure:
    """Shares of intervals that hold against the sampled strain: made series above, means over the flows below."""
    figure = Figure(figsize=(12, 6.8), layout="constrained")
    above, below = figure.subfigures(2, 1)
    for subfigure, names, unit in ((above, tuple(PARTS), "2t"), (below, OBSERVABLES, "memory")):
        panels = subfigure.subplots(1, len(names), sharey=True)
        for axes, name in zip(panels, names, strict=True):
            draw_panel(axes, [row for row in rows if row["series"] == name and "memory" not in row])
            axes.set_title(name.replace("_", " "), fontsize="medium")
            axes.set_xlabel(f"sampled strain of a seed / {unit}")
        panels[0].set_ylabel("95 % intervals that hold")
    above.suptitle("made series", fontsize="medium", fontweight="bold")
    below.suptitle("repeated flows", fontsize="medium", fontweight="bold")
    handles = [
        Line2D([], [], color=grey, marker=marker, label=f"{seeds} seed{'s' if seeds > 1 else ''}")
        for seeds, (grey, marker) in STYLES.items()
    ]
    handles += [Line2D([], [], color="0", linestyle=line, label=method) for method, line in LINES.items()]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), fontsize="small", frameon=False)
    return figure


def draw_panel(axes: Axes, rows: list[dict]) -> None:
    """One line for each method and number of seeds; the accepted shares are shaded."""
    axes.axhspan(*HOLDS, color="0.88", zorder=0)
    for seeds, (grey, marker) in STYLES.items():
        some = [row for row in rows if row["seeds"] == seeds]
        for method, line in LINES.items():
            face = grey if method == "standard_errors" else "white"
            axes.plot(
                [row["strain"] for row in some],
                [row[f"{method}_holds"] for row in some],
                color=grey,
                linestyle=line,
                marker=marker,
                markersize=5,
                markerfacecolor=face,
            )
    strains = sorted({row["strain"] for row in rows})
    if strains and strains[-1] > 10:
        axes.set_xscale("log")
        ticks = [2, 4, 8, 16, 32, 80]
        axes.set_xticks(ticks, [str(tick) for tick in ticks])
        axes.minorticks_off()
    else:
        axes.set_xticks(strains)
    axes.set_ylim(0.5, 1.0)
