"""The force ratio against the time step, from 1e-2 to 1e-6, and its extrapolation to zero.

Six flows, both activation rules, several seeds. Each seed reaches its steady state at dt = 1e-3; from there the coarser
time steps are sampled, then the finer ones in turn, each after a strain of 0.5 in which the contact network forgets the
one before. The excess of the force ratio over one is fitted by R₀ − 1 + A dt^β over the finer half of the time steps.
The error of R₀ holds the noise, by refitting data redrawn within their standard errors, and the choice of the range, as
the spread of the fits that leave out the coarsest of them or take in one more.

    python benchmarks/timestep_study.py           # about 15 minutes on two cores
    python benchmarks/timestep_study.py --quick   # two flows down to 1e-4, under a minute
"""

import argparse
import json
import multiprocessing
import os
import time
from concurrent.futures import ProcessPoolExecutor
from itertools import product
from pathlib import Path
from typing import NamedTuple

os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1")

import jax
import jax.numpy as jnp
import numpy as np
from hardware import hardware
from matplotlib.figure import Figure
from scipy.optimize import curve_fit

import jaxgran as jg
from jaxgran.measure import estimates
from jaxgran.sweep import usable_cores

RULES = ("midpoint", "touching")
START = 1e-3  # time step of the steady state
RELAXATION = 0.5
REDRAWN = 200
FEWEST_FITTED = 4

advance = jax.jit(jg.advance)


class Plan(NamedTuple):
    """Restitutions and packing fractions of the flows, grains, seeds, sampled strain of each, and the time steps."""

    restitution: tuple[float, ...]
    packing_fraction: tuple[float, ...]
    grains: int
    seeds: int
    strain: float
    timesteps: tuple[float, ...]


def half_decades(first: int, last: int) -> tuple[float, ...]:
    """Time steps from 10^first down to 10^last, two a decade."""
    return tuple(float(f"{10 ** (first - k / 2):.3g}") for k in range(2 * (first - last) + 1))


FULL = Plan((0.9, 0.5, 0.1), (0.6, 0.8), 256, 3, 4.0, half_decades(-2, -6))
QUICK = Plan((0.5, 0.1), (0.6,), 64, 3, 1.0, half_decades(-2, -4))


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("--quick", action="store_true", help="two flows, fewer time steps")
    arguments.add_argument("--output", type=Path, default=Path(__file__).parent / "results")
    chosen = arguments.parse_args()
    jax.config.update("jax_enable_x64", True)
    study(chosen.quick, chosen.output)


def study(quick: bool, output: Path) -> None:
    """Run the plan on all cores, print the extrapolations, and write ``timestep_study`` as JSON and PNG."""
    plan = QUICK if quick else FULL
    curves = list(product(plan.packing_fraction, plan.restitution, RULES))
    tasks = [(*curve, seed) for curve in curves for seed in range(plan.seeds)]
    dear_first = sorted(tasks, key=lambda task: (-task[0], task[1]))
    start = time.perf_counter()
    with ProcessPoolExecutor(min(usable_cores(), len(tasks)), multiprocessing.get_context("spawn")) as pool:
        done = dict(zip(dear_first, pool.map(samples, [plan] * len(tasks), dear_first), strict=True))
    results = []
    for nu, alpha, rule in curves:
        result = curve(plan, [done[nu, alpha, rule, seed] for seed in range(plan.seeds)])
        results.append({"packing_fraction": nu, "restitution": alpha, "activation": rule, **result})
        fit = "dt → 0 gives {:.4g} ± {:.2g}, exponent {:.2f}".format(*result["limit"], result["exponent"])
        print(f"ν {nu:g}, α {alpha:g}, {rule:8s}: {fit}")
    output.mkdir(parents=True, exist_ok=True)
    stem = output / ("timestep_study_quick" if quick else "timestep_study")
    head = {"hardware": hardware(), "plan": plan._asdict(), "wall_seconds": time.perf_counter() - start}
    stem.with_suffix(".json").write_text(json.dumps({**head, "curves": results}, indent=1) + "\n")
    draw(results).savefig(stem.with_suffix(".png"), dpi=150)


def samples(plan: Plan, task: tuple[float, float, str, int]) -> dict[float, jg.Sample]:
    """One seed of one flow under one rule: a sample of every time step."""
    jax.config.update("jax_enable_x64", True)
    nu, alpha, rule, seed = task

    def flow(timestep: float) -> jg.ShearFlow:
        return jg.ShearFlow(plan.grains, alpha, nu, timestep, activation=rule)

    steady = jg.prepare(flow(START), jax.random.key(seed), equilibrate=max(5.0, 2 / (nu * (1 - alpha**2))))
    found, state = {}, steady
    for timestep in sorted(plan.timesteps, reverse=True):
        before = steady if timestep >= START else state
        relaxed, _ = advance(flow(timestep), before, jnp.int32(round(RELAXATION / timestep)))
        state, sample = jg.sample(flow(timestep), relaxed, plan.strain)
        found[timestep] = jax.tree.map(np.asarray, sample)
    return found


def curve(plan: Plan, seeds: list[dict[float, jg.Sample]]) -> dict:
    """Force ratio of every time step with its standard error and status, and the limit of vanishing time steps."""
    points = []
    for timestep in sorted(plan.timesteps):
        value, error = estimates([seed[timestep] for seed in seeds])
        status = max(int(seed[timestep].status) for seed in seeds)
        points.append(
            {
                "timestep": timestep,
                "force_ratio": float(value["force_ratio"]),
                "stderr": float(error["force_ratio"]),
                "pressure": [float(value["pressure"]), float(error["pressure"])],
                "status": jg.Status(status).name,
            }
        )
    dt, excess, error = (
        np.array([of(point) for point in points])
        for of in (lambda p: p["timestep"], lambda p: p["force_ratio"] - 1, lambda p: p["stderr"])
    )
    count = max(FEWEST_FITTED, len(points) // 2 + 1)
    choices = [n for n in (count - 1, count, count + 1) if FEWEST_FITTED <= n <= len(points)]
    limits = [fitted(dt[:n], excess[:n], error[:n]) for n in choices]
    limit, exponent = fitted(dt[:count], excess[:count], error[:count])
    rng = np.random.default_rng(0)
    redrawn = [fitted(dt[:count], rng.normal(excess, error)[:count], error[:count])[0] for _ in range(REDRAWN)]
    uncertain = float(np.hypot(np.std(redrawn), np.std([value for value, _ in limits])))
    return {"points": points, "limit": [1 + limit, uncertain], "exponent": exponent, "fitted": count}


def fitted(dt: np.ndarray, excess: np.ndarray, error: np.ndarray) -> tuple[float, float]:
    """Excess at vanishing time step, at least 0, and exponent of the weighted least-squares fit e₀ + A dt^β."""
    scale = dt.max()

    def model(x, limit, amplitude, exponent):
        return limit + amplitude * (x / scale) ** exponent

    start = [max(excess[0], 0) / 2, max(excess[-1] - excess[0], 1e-9), 0.5]
    ranges = ([0, 0, 0.05], [np.inf, np.inf, 2])
    sigma = np.maximum(error, 1e-12)
    values, _ = curve_fit(
        model, dt, excess, start, sigma, bounds=ranges, max_nfev=20_000, x_scale=np.maximum(start, 1e-6)
    )
    return float(values[0]), float(values[2])


def draw(curves: list[dict]) -> Figure:
    """Excess of the force ratio against the time step, a panel for every packing fraction, with the limits."""
    fractions = sorted({c["packing_fraction"] for c in curves})
    restitutions = sorted({c["restitution"] for c in curves})
    figure = Figure(figsize=(1.2 + 4.2 * len(fractions), 4.6), layout="constrained")
    panels = figure.subplots(1, len(fractions), sharey=True, squeeze=False)[0]
    for axes, nu in zip(panels, fractions, strict=True):
        for one in (c for c in curves if c["packing_fraction"] == nu):
            k, touching = restitutions.index(one["restitution"]), one["activation"] == "touching"
            color = ("#1b1b1b", "#2166ac", "#b2182b")[k % 3]
            dt, value, error = (
                np.array([p[name] for p in one["points"]]) for name in ("timestep", "force_ratio", "stderr")
            )
            style = {"color": color, "marker": "osD"[k % 3], "markersize": 4, "capsize": 2}
            style |= {"linestyle": "--", "markerfacecolor": "white"} if touching else {"linestyle": "-"}
            label = f"α {one['restitution']:g}, {one['activation']}"
            axes.errorbar(dt, value - 1, np.minimum(error, 0.9 * np.abs(value - 1)), label=label, **style)
            limit, unsure = one["limit"]
            left = dt.min() / (2.2 if touching else 3.2)
            low = min(unsure, 0.99 * (limit - 1))
            axes.errorbar(left, limit - 1, [[low], [unsure]], **{**style, "linestyle": "none", "markersize": 6})
        axes.axvline(dt.min() / 1.5, color="0.7", linewidth=0.8)
        axes.text(0.02, 0.02, "dt → 0", transform=axes.transAxes, fontsize="small")
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_title(f"packing fraction {nu:g}", fontsize="medium")
        axes.set_xlabel("time step dt (1/shear rate)")
    panels[0].set_ylabel("excess of the force ratio, ⟨F⟩/⟨F_bc⟩ − 1")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize="small", frameon=False)
    return figure


if __name__ == "__main__":
    main()
