"""What foretells the error of the pressure from the time step: over restitution and packing
fraction, the pressure of time steps from 1e-2 to 1e-4, and what a sample itself knows of its step.

Each seed reaches its steady state at dt = 1e-3. From there the coarser time steps are sampled, then
the finer ones in turn, each after a strain of two. The error is that against the finest step, with
its standard error over all seeds.

    python -m benchmarks timestep_error           # half an hour on two cores
    python -m benchmarks timestep_error --quick   # two flows, under a minute
"""

from collections.abc import Mapping, Sequence
from functools import partial
from itertools import product
from typing import NamedTuple

import numpy as np

import jaxgran as jg
from benchmarks.cores import on_all_cores
from benchmarks.output import Output
from benchmarks.timestep_study import START, samples_by_timestep
from jaxgran.sampling.sample import estimates
from jaxgran.sampling.timestep import deepest_overlap, stress_error

ONE_CORE = True

RELAXATION = 2.0  # strain at a new time step before its sample
ALLOWED = 0.03  # relative error of the pressure that has to be foretold


class Plan(NamedTuple):
    """Restitutions and packing fractions, grains, seeds, strain of each sample and time steps."""

    restitution: tuple[float, ...]
    packing_fraction: tuple[float, ...]
    grains: int
    seeds: int
    strain: float
    timesteps: tuple[float, ...]


FULL = Plan(
    (0.1, 0.3, 0.5, 0.7, 0.9, 0.95),
    (0.1, 0.3, 0.5, 0.6, 0.7, 0.75, 0.8, 0.82),
    256,
    4,
    100.0,
    (1e-2, 3.16e-3, 1e-3, 3.16e-4, 1e-4),
)
QUICK = Plan((0.9, 0.5), (0.8,), 64, 2, 10.0, (1e-2, 1e-3, 1e-4))


def run(output: Output) -> None:
    """Run the plan on all cores and write ``timestep_error`` as JSON, a row a flow and step."""
    plan = QUICK if output.quick else FULL
    flows = list(product(plan.packing_fraction, plan.restitution))
    tasks = [(*flow, seed) for flow in flows for seed in range(plan.seeds)]
    sampled = on_all_cores(partial(samples, plan), tasks, lambda task: (task[0], -task[1]))
    done, rows = dict(zip(tasks, sampled, strict=True)), []
    for nu, alpha in flows:
        rows += rows_of_flow(alpha, nu, [done[nu, alpha, seed] for seed in range(plan.seeds)])
    output.write_json("timestep_error", {"plan": plan._asdict()} | {"rows": rows})


def verdicts(rows: Sequence[Mapping], grains: int) -> dict:
    """Which samples are off, and which of them ``deep_overlap`` flags, for the page of errors."""

    def flagged(row: Mapping) -> bool:
        return row["mean_overlap"] > deepest_overlap(row["packing_fraction"], grains)

    def bound(row: Mapping) -> float:
        crossing = row["timestep"] * np.sqrt(row["temperature"])
        return float(stress_error(crossing, row["packing_fraction"], grains))

    finest = min(row["timestep"] for row in rows)
    judged = [row for row in rows if row["timestep"] > finest]
    off = [row for row in judged if abs(row["error"]) > ALLOWED + 2 * row["error_stderr"]]
    return {
        "samples": len(judged),
        "off": len(off),
        "beyond": max(abs(row["error"]) / bound(row) for row in off),
        "hits": sum(map(flagged, off)),
        "false": sum(flagged(row) and abs(row["error"]) <= ALLOWED for row in judged),
    }


def samples(plan: Plan, task: tuple[float, float, int]) -> dict[float, jg.Sample]:
    """A sample of every time step of one seed of a flow."""
    nu, alpha, seed = task
    print(f"ν {nu:g}, α {alpha:g}, seed {seed}", flush=True)
    flow = jg.ShearFlow(plan.grains, alpha, nu, START)
    return samples_by_timestep(flow, seed, plan.timesteps, RELAXATION, plan.strain)


def rows_of_flow(alpha: float, nu: float, seeds: Sequence[dict[float, jg.Sample]]) -> list[dict]:
    """The error of the pressure at every time step of a flow, and what its samples know of the
    step: temperature, the share of deep contacts, and the mean overlap.
    """
    measured = {dt: estimates([seed[dt] for seed in seeds]) for dt in sorted(seeds[0])[::-1]}
    pressures = {dt: [float(x["pressure"]) for x in both] for dt, both in measured.items()}
    truth, its_error = pressures[min(pressures)]
    rows = []
    for dt, (pressure, stderr) in pressures.items():
        deep, overlap, contacts = (
            float(sum(np.sum(getattr(seed[dt].tally, name)) for seed in seeds))
            for name in ("deep_contacts", "overlap", "contacts")
        )
        rows.append(
            {
                "restitution": alpha,
                "packing_fraction": nu,
                "timestep": dt,
                "temperature": float(measured[dt][0]["granular_temperature"]),
                "error": pressure / truth - 1,
                "error_stderr": np.hypot(stderr / pressure, its_error / truth).item(),
                "deep_share": deep / contacts,
                "mean_overlap": overlap / contacts,
            }
        )
    return rows
