"""How often 95 % intervals cover the true mean, by repeats of sheared flows.

The errors are those of ``standard_errors``, and an interval is 1.96 errors to each side. Its width
is given over that of the true interval, 1.96 standard deviations of the mean.

Each flow is repeated with independent grains. A repeat is prepared over five correlation strains
and sampled over eight; its first two, four and six are judged too, all in 32 blocks. The
correlation strain is max(nT/τ, 0.35 L √(ρ/p)). The repeats are divided at random into groups of
seeds. The truth is the value from all R repeats. It shares the k seeds of a group, so a deviation
from it is divided by √(1 - k/R).

With an error, nine points are sampled until it is reached, 40 times by four seeds each, and the
same is asked of these
intervals: a sample that ends when its estimated error is small may be one that underestimates it.

Short samples, of a strain of 2 to 50, are the parts of 64 long ones at nine points, with 64 grains:
the truth is the value of all, and a deviation is divided as above.

    python -m benchmarks coverage           # about 6 minutes on a core
    python -m benchmarks coverage --error 0.05  # about 20 minutes on a core
    python -m benchmarks coverage --short   # about 4 minutes on a core
    python -m benchmarks coverage --quick   # two flows of 64 grains, under a minute
"""

import time
import warnings
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from itertools import product
from typing import NamedTuple

import jax
import numpy as np

import jaxgran as jg
from benchmarks.output import Output
from jaxgran.dynamics.tally import Tally
from jaxgran.maps.status_report import BadPoints
from jaxgran.model.status import Status
from jaxgran.sampling.averages import averages
from jaxgran.sampling.sample import BLOCKS, ERROR_OBSERVABLES, estimates

OBSERVABLES = ("force_ratio", "pressure", "shear_stress", "granular_temperature")
SEEDS = (1, 2, 4, 8)
STRAINS = (2, 4, 6, 8)  # sampled, in correlation strains
PREPARED = 5  # correlation strains before the sample
SHEAR_RATE = 1.0
PILOT = 4.0  # strain of the sample that gives the correlation strain of a flow
NORMAL_QUANTILE = 1.96
ERROR_PLANE = (0.2, 0.5, 0.8), (0.3, 0.6, 0.75)  # restitutions, packing fractions
ERROR_SEEDS = 4
HOLDS = (0.92, 0.98)  # accepted shares of intervals
SHORT_GRAINS, SHORT_STRAINS = 64, (2, 5, 10, 20, 50)
SHORT_FLOWS = (
    *((0.9, 0.2), (0.6, 0.2), (0.3, 0.5), (0.9, 0.5), (0.1, 0.6)),
    *((0.3, 0.7), (0.9, 0.7), (0.5, 0.8), (0.9, 0.8)),
)
SHORT_OBSERVABLES = ("pressure", "force_ratio")
BLOCKS_A_STRAIN = 16


class Plan(NamedTuple):
    """Flows as (restitution, packing fraction), number of grains, time step, repeats of a flow."""

    flows: tuple[tuple[float, float], ...]
    grains: int
    timestep: float
    repeats: int


DILUTE = ((0.1, 0.3), (0.2, 0.2), (0.95, 0.1), (0.8, 0.2), (0.5, 0.4))
DENSE = ((0.2, 0.6), (0.5, 0.6), (0.8, 0.6), (0.9, 0.7), (0.2, 0.75), (0.5, 0.79), (0.8, 0.8))
FULL = Plan((*DILUTE, *DENSE), 256, 1e-3, 64)
QUICK = Plan(((0.8, 0.6), (0.8, 0.8)), 64, 1e-3, 8)


def run(output: Output, error: float | None = None, short: bool = False) -> None:
    """Judge the flows, print a table, and write ``coverage`` as JSON; or judge an error, or short
    samples.
    """
    if error is not None:
        judge_error(output, error)
        return
    if short:
        judge_short(output)
        return
    plan, rng, start = (
        QUICK if output.quick else FULL,
        np.random.default_rng(0),
        time.perf_counter(),
    )
    rows = []
    for flow in plan.flows:
        rows += flow_rows(plan, *flow, rng)
        print(f"α {flow[0]:g}, ν {flow[1]:g}: {time.perf_counter() - start:.0f} s", flush=True)
    over_flows = [*means_over_flows(rows)]
    print(
        f"mean over {len(plan.flows)} flows of the share of intervals that cover [smallest of a "
        "flow] / mean width"
    )
    for row in over_flows:
        shares = f"{row['covered']:.2f} [{row['least_covered']:.2f}] / {row['width']:.2f}"
        print(
            f"{row['observable']:21s} strain/correlation strain {row['strain']}, seeds "
            f"{row['seeds']}: {shares}"
        )
    head = {
        "plan": plan._asdict(),
        "seconds": time.perf_counter() - start,
        "over_flows": over_flows,
    }
    output.write_rows("coverage", head, "rows", rows)


def flow_rows(plan: Plan, alpha: float, nu: float, rng: np.random.Generator) -> Iterator[dict]:
    """A row for every observable, sampled strain and number of seeds of one flow."""
    correlation_strain, samples = repeats(plan, alpha, nu)
    average = partial(
        chosen_averages, area=samples.area[0], grains=plan.grains, shear_rate=SHEAR_RATE
    )
    for strain in STRAINS:
        tally = in_blocks(samples.tally, strain)
        truth = average(tally.total(axis=(0, 1)))
        single = average(tally.total(axis=1))
        for seeds in SEEDS:
            if 2 * seeds > plan.repeats:
                continue
            groups = [group for _ in range(seeds) for group in divided(rng, plan.repeats, seeds)]
            parts = [
                replace(samples[k], tally=jax.tree.map(lambda x, k=k: x[k], tally))
                for k in range(plan.repeats)
            ]
            of_groups = [estimates([parts[k] for k in group]) for group in groups]
            head = {
                "restitution": alpha,
                "packing_fraction": nu,
                "correlation_strain": round(correlation_strain, 3),
            }
            for observable in OBSERVABLES:
                true = np.std(single[observable], ddof=1) / np.sqrt(seeds)
                values, errors = np.array(
                    [[part[observable] for part in pair] for pair in of_groups]
                ).T
                deviations = (values - truth[observable]) / np.sqrt(1 - seeds / plan.repeats)
                yield {
                    **head,
                    "observable": observable,
                    "strain": strain,
                    "seeds": seeds,
                    "covered": round(
                        float(np.mean(np.abs(deviations) < NORMAL_QUANTILE * errors)), 4
                    ),
                    "width": round(float(np.mean(errors / true)), 4),
                }


def judge_short(output: Output) -> None:
    """Print how often the intervals of short samples hold, and write ``coverage_short``."""
    count = 8 if output.quick else 64
    strains = SHORT_STRAINS[: 2 if output.quick else None]
    rows = []
    for alpha, nu in SHORT_FLOWS:
        flow = jg.ShearFlow(SHORT_GRAINS, alpha, nu, 1e-3)
        states = jg.prepare(flow, jax.random.split(jax.random.key(64), count))
        longest = strains[-1]
        _, samples = jg.sample(flow, states, float(longest), BLOCKS_A_STRAIN * longest)
        truth = averages(
            samples.tally.total(axis=(0, 1)), samples.area[0], flow.grains, flow.shear_rate
        )
        row = {
            "restitution": alpha,
            "packing_fraction": nu,
            "correlation_strain": float(samples.correlation_strain.mean()),
            "covered": {name: [] for name in SHORT_OBSERVABLES},
            "width": {name: [] for name in SHORT_OBSERVABLES},
        }
        for strain, name in product(strains, SHORT_OBSERVABLES):
            parts = [part_of(samples[k], strain) for k in range(count)]
            values = np.array([float(part.averages[name]) for part in parts])
            errors = np.array([float(part.errors()[name]) for part in parts])
            off = np.abs(values - float(truth[name])) / np.sqrt(1 - strain / longest / count)
            row["covered"][name].append(float(np.mean(off <= NORMAL_QUANTILE * errors)))
            row["width"][name].append(float(np.median(errors) / np.std(values, ddof=1)))
        rows.append(row)
        print(f"α {alpha:g}, ν {nu:g}: {row['covered']}, widths {row['width']}", flush=True)
    head = {"grains": SHORT_GRAINS, "repeats": count, "timestep": 1e-3, "strains": strains}
    output.write_json("coverage_short", {**head, "rows": rows})


def part_of(sample: jg.Sample, strain: int) -> jg.Sample:
    """The beginning of a sample, in 32 blocks or a few more."""
    merged = max(1, BLOCKS_A_STRAIN * strain // BLOCKS)
    count = BLOCKS_A_STRAIN * strain // merged
    tally = jax.tree.map(
        lambda x: np.asarray(x)[: count * merged].reshape(count, merged, *x.shape[1:]),
        sample.tally,
    )
    return replace(sample, tally=tally.total(axis=1))


def judge_error(output: Output, error: float) -> None:
    """Repeat a map with a requested error, print how often its intervals hold, and write
    ``coverage_error``.
    """
    count, grains, start = (
        (3, 64, time.perf_counter()) if output.quick else (40, 256, time.perf_counter())
    )
    given = {
        "grains": grains,
        "timestep": 1e-3,
        "tolerance": 1e-4,
        "error": error,
        "seeds": ERROR_SEEDS,
    }
    maps = []
    for repeat in range(count):
        with warnings.catch_warnings():
            warnings.simplefilter(
                "ignore", BadPoints
            )  # the share of those that reached their longest strain is printed
            maps.append(jg.ratio_map(*ERROR_PLANE, **given, first_seed=ERROR_SEEDS * repeat))
        print(f"repeat {repeat + 1} of {count}: {time.perf_counter() - start:.0f} s", flush=True)
    strain = np.stack([data["sums/strain"].sum("seed") for data in maps])
    limited = np.mean([data["sums/status"] == Status.imprecise for data in maps])
    rows = []
    for name in ERROR_OBSERVABLES:
        values, errors = (
            np.stack([data[f"{name}{end}"] for data in maps]) for end in ("", "_stderr")
        )
        truth = np.sum(strain * values, axis=0) / np.sum(strain, axis=0)
        deviations = np.abs(values - truth) / np.sqrt(1 - 1 / count)
        for nu, alpha in np.ndindex(truth.shape):
            place = (slice(None), nu, alpha)
            inside = deviations[place] < NORMAL_QUANTILE * errors[place]
            rows.append(
                {
                    "restitution": ERROR_PLANE[0][alpha],
                    "packing_fraction": ERROR_PLANE[1][nu],
                    "observable": name,
                    "covered": float(np.mean(inside)),
                    "width": float(np.mean(errors[place]) / np.std(values[place], ddof=1)),
                    "relative_interval": float(
                        np.mean(NORMAL_QUANTILE * errors[place] / truth[nu, alpha])
                    ),
                    "strain": float(np.mean(strain[place])),
                }
            )
    for name in ERROR_OBSERVABLES:
        covered = [row["covered"] for row in rows if row["observable"] == name]
        print(f"{name}: {np.mean(covered):.3f} of the intervals [{min(covered):.2f} at a point]")
    print(
        f"{np.mean([row['covered'] for row in rows]):.3f} of all; {limited:.1%} of the seeds at "
        "their longest strain"
    )
    head = {
        "error": error,
        "grains": grains,
        "seeds": ERROR_SEEDS,
        "repeats": count,
        "limited": float(limited),
    }
    output.write_rows(
        "coverage_error", head | {"seconds": time.perf_counter() - start}, "rows", rows
    )


def repeats(plan: Plan, alpha: float, nu: float) -> tuple[float, jg.Sample]:
    """Correlation strain of a flow, and its independent samples, with a leading axis of repeats."""
    flow = jg.ShearFlow(plan.grains, alpha, nu, plan.timestep)
    _, pilot = jg.sample(
        flow, jg.prepare(flow, jax.random.key(plan.repeats), equilibrate=10.0), PILOT
    )
    correlation_strain = float(pilot.correlation_strain)
    samples = []
    for seed in range(plan.repeats):
        state = jg.prepare(flow, jax.random.key(seed), equilibrate=PREPARED * correlation_strain)
        _, sample = jg.sample(
            flow, state, STRAINS[-1] * correlation_strain, BLOCKS * STRAINS[-1] // STRAINS[0]
        )
        samples.append(jax.tree.map(np.asarray, sample))
    return correlation_strain, jax.tree.map(lambda *x: np.stack(x), *samples)


def in_blocks(tally: Tally, strain: int) -> Tally:
    """The first correlation strains of all repeats in ``BLOCKS`` blocks, (repeats, blocks)."""
    merge = strain // STRAINS[0]
    first = jax.tree.map(
        lambda x: x[:, : BLOCKS * merge].reshape(len(x), BLOCKS, merge, *x.shape[2:]), tally
    )
    return first.total(axis=2)


def divided(rng: np.random.Generator, repeats: int, seeds: int) -> np.ndarray:
    """Numbers of the repeats in random groups, (groups, seeds)."""
    return rng.permutation(repeats)[: repeats // seeds * seeds].reshape(-1, seeds)


def chosen_averages(tally: Tally, **flow: float) -> dict[str, np.ndarray]:
    values = averages(tally, **flow)
    return {name: np.asarray(values[name]) for name in OBSERVABLES}


def means_over_flows(rows: list[dict]) -> Iterator[dict]:
    """Shares and widths averaged over the flows, and the smallest share, by observable, strain and
    seeds.
    """
    keys = ("observable", "strain", "seeds")
    for values in dict.fromkeys(tuple(row[key] for key in keys) for row in rows):
        same = [row for row in rows if tuple(row[key] for key in keys) == values]
        means = {
            name: round(float(np.mean([row[name] for row in same])), 4)
            for name in ("covered", "width")
        }
        yield (
            dict(zip(keys, values, strict=True))
            | means
            | {"least_covered": min(row["covered"] for row in same)}
        )
