"""The force ratio against the time step, from 1e-2 to 1e-6, and its extrapolation to zero.

Six flows, both activation rules, several seeds. Each seed reaches its steady state at dt = 1e-3;
from there the coarser time steps are sampled, then the finer ones in turn, each after a strain of
0.5 in which the contact network forgets the one before. Steps without an approaching contact are
jumped over, so that the finest step can be paid for.

As dt → 0 both rules become the same law. So the excess of the force ratio over one is fitted, over
the finer time steps of both, by L + A dt^β with one limit L and an amplitude and an exponent for
each rule. The interval of L is where χ² exceeds its minimum by no more than its value per degree of
freedom (at least one), joined over fits that take in one time step less and one more.

    python -m benchmarks timestep_study           # two to three minutes on two cores
    python -m benchmarks timestep_study --quick   # two flows down to 1e-4, under a minute
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from itertools import product
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from scipy.optimize import minimize_scalar

import jaxgran as jg
from benchmarks.cores import on_all_cores
from benchmarks.output import Output
from jaxgran.plotting.style import RATIO_LABEL, TWO_COLUMNS, styled
from jaxgran.sampling.sample import estimates

ONE_CORE = True

RULES = ("midpoint", "touching")
START = 1e-3  # time step of the steady state
RELAXATION = 0.5
FEWEST_FITTED = 5
TRIED_LIMITS, REFINEMENTS = 30, 3

advance = jax.jit(jg.advance)


class Plan(NamedTuple):
    """Restitutions and packing fractions of the flows, grains, seeds, the sampled strain of each at
    every packing fraction, and the time steps.
    """

    restitution: tuple[float, ...]
    packing_fraction: tuple[float, ...]
    grains: int
    seeds: int
    strain: tuple[float, ...]
    timesteps: tuple[float, ...]


def half_decades(first: int, last: int) -> tuple[float, ...]:
    """Time steps from 10^first down to 10^last, two a decade."""
    return tuple(float(f"{10 ** (first - k / 2):.3g}") for k in range(2 * (first - last) + 1))


FULL = Plan((0.9, 0.5, 0.1), (0.6, 0.8), 256, 3, (25.0, 4.0), half_decades(-2, -6))
QUICK = Plan((0.5, 0.1), (0.6,), 64, 3, (1.0,), half_decades(-2, -4))


def run(output: Output) -> None:
    """Run the plan on all cores, print the extrapolations, and write ``timestep_study`` as JSON and
    PNG.
    """
    plan = QUICK if output.quick else FULL
    flows = list(product(plan.packing_fraction, plan.restitution))
    tasks = [(*flow, rule, seed) for flow in flows for rule in RULES for seed in range(plan.seeds)]
    sampled = on_all_cores(partial(samples, plan), tasks, lambda task: (task[0], -task[1]))
    done, results = dict(zip(tasks, sampled, strict=True)), []
    for nu, alpha in flows:
        points = {
            rule: curve(plan, [done[nu, alpha, rule, seed] for seed in range(plan.seeds)])
            for rule in RULES
        }
        about = {"packing_fraction": nu, "restitution": alpha}
        results.append(about | {"points": points} | extrapolated(points))
        print({name: x for name, x in results[-1].items() if name != "points"})
    output.write_json("timestep_study", {"plan": plan._asdict(), "flows": results})
    output.write_picture(draw(results), "timestep_study")


def samples(plan: Plan, task: tuple[float, float, str, int]) -> dict[float, jg.Sample]:
    """One seed of one flow under one rule: a sample of every time step."""
    nu, alpha, rule, seed = task
    flow = jg.ShearFlow(plan.grains, alpha, nu, START, activation=rule)
    strain = plan.strain[plan.packing_fraction.index(nu)]
    return samples_by_timestep(flow, seed, plan.timesteps, RELAXATION, strain)


def samples_by_timestep(
    flow: jg.ShearFlow, seed: int, timesteps: Sequence[float], relaxation: float, strain: float
) -> dict[float, jg.Sample]:
    """A sample of every time step, the finer ones in turn, each after a strain of relaxation. A
    flow has the time step of its steady state.
    """
    steady = state = jg.prepare(flow, jax.random.key(seed))
    sampled = {}
    for timestep in sorted(timesteps, reverse=True):
        before = steady if timestep >= flow.timestep else state
        stepped, steps = replace(flow, timestep=timestep), jnp.int32(round(relaxation / timestep))
        state, sample = jg.sample(stepped, advance(stepped, before, steps)[0], strain)
        sampled[timestep] = jax.tree.map(np.asarray, sample)
    return sampled


def curve(plan: Plan, seeds: list[dict[float, jg.Sample]]) -> list[dict]:
    """Force ratio with its standard error, and the status, of every time step, the finest first."""
    points = []
    for timestep in sorted(plan.timesteps):
        value, error = estimates([seed[timestep] for seed in seeds])
        status = max(int(seed[timestep].status) for seed in seeds)
        ratio, stderr = float(value["force_ratio"]), float(error["force_ratio"])
        point = {"timestep": timestep, "force_ratio": ratio, "stderr": stderr}
        points.append(point | {"status": jg.Status(status).name})
    return points


def extrapolated(points: dict[str, list[dict]]) -> dict:
    """Force ratio at vanishing time step with its interval, and the exponents of both rules."""
    data = [arrays(points[rule]) for rule in RULES]
    length = len(data[0][0])
    usual = min(length, max(FEWEST_FITTED, 2 * length // 3))
    tried = [n for n in (usual - 1, usual, usual + 1) if FEWEST_FITTED <= n <= length]
    fits = {n: joint_fit([tuple(values[:n] for values in part) for part in data]) for n in tried}
    (best, _, _), exponents = fits[usual]
    low = min(limit[1] for limit, _ in fits.values())
    high = max(limit[2] for limit, _ in fits.values())
    limit = {"best": 1 + best, "low": 1 + low, "high": 1 + high}
    return {"limit": limit, "exponents": dict(zip(RULES, exponents, strict=True))}


def arrays(points: list[dict]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Time steps, excess, and its error. Where hardly a cluster was seen the error is a third of
    that of the next coarser step, as no scatter, whose error is NaN, is no certainty.
    """
    dt, ratio, error = (
        np.array([p[name] for p in points]) for name in ("timestep", "force_ratio", "stderr")
    )
    for k in range(len(error) - 2, -1, -1):
        error[k] = np.fmax(error[k], error[k + 1] / 3)
    return dt, ratio - 1, error


def joint_fit(data: list[tuple]) -> tuple[tuple[float, float, float], list[float]]:
    """Limit of the excess, at least 0, with the ends of its interval, and the exponent of each
    curve.
    """
    low, high = 0.0, max(min(excess[0] + 2 * error[0] for _, excess, error in data), 1e-9)
    freedom = max(1, sum(len(part[0]) for part in data) - 5)
    for _ in range(REFINEMENTS):
        limits = np.linspace(low, high, TRIED_LIMITS)
        fits = [
            [power_law(dt, excess - limit, error) for dt, excess, error in data] for limit in limits
        ]
        chi2 = np.array([sum(fit[0] for fit in pair) for pair in fits])
        inside = np.flatnonzero(chi2 <= chi2.min() + max(1.0, chi2.min() / freedom))
        low, high = limits[max(inside[0] - 1, 0)], limits[min(inside[-1] + 1, TRIED_LIMITS - 1)]
    best = int(np.argmin(chi2))
    interval = float(limits[best]), float(limits[inside[0]]), float(limits[inside[-1]])
    return interval, [float(fit[1]) for fit in fits[best]]


def power_law(dt: np.ndarray, excess: np.ndarray, error: np.ndarray) -> tuple[float, float]:
    """χ² and exponent β of the weighted least-squares fit A dt^β; A follows from β, which is
    searched.
    """
    x = dt / dt.max()

    def chi2(exponent: float) -> float:
        shape = x**exponent / error
        amplitude = np.sum(shape * excess / error) / np.sum(shape**2)
        return float(np.sum((excess / error - amplitude * shape) ** 2))

    minimum = minimize_scalar(chi2, bounds=(0.02, 2.0), method="bounded")
    return minimum.fun, minimum.x


LEAST = 1e-5  # smallest excess that is drawn
LOOKS = (("black", "o"), ("tab:blue", "s"), ("tab:red", "D"))  # in the order of the restitutions


@styled
def draw(flows: list[dict]) -> Figure:
    """Excess of the force ratio against the time step, a panel for every packing fraction, with the
    limits.
    """
    fractions, restitutions = (
        sorted({f[name] for f in flows}) for name in ("packing_fraction", "restitution")
    )
    figure = Figure(figsize=(TWO_COLUMNS, 3.4), layout="constrained")
    panels = figure.subplots(1, len(fractions), sharey=True, squeeze=False)[0]
    for axes, nu in zip(panels, fractions, strict=True):
        curves = [flow for flow in flows if flow["packing_fraction"] == nu]
        for place, flow in enumerate(sorted(curves, key=lambda f: -f["restitution"])):
            colour, marker = LOOKS[restitutions.index(flow["restitution"])]
            style = {"color": colour, "marker": marker, "markersize": 3.5}
            for rule, points in flow["points"].items():
                dt, excess, error = arrays(points)
                shown = excess > LEAST
                bars = [np.minimum(error, excess - LEAST)[shown], error[shown]]
                look = {"linestyle": "-"} | style
                if rule == "touching":
                    look |= {"linestyle": "--", "markerfacecolor": "white"}
                look["label"] = rf"$\alpha={flow['restitution']:g}$, {rule}"
                axes.errorbar(dt[shown], excess[shown], bars, **look)
                bad = np.array([p["status"] != "ok" for p in points]) & shown
                axes.plot(dt[bad], excess[bad], "x", color="0.4", markersize=7, zorder=4)
            draw_limit(axes, flow["limit"], dt.min() / (2.2 + 1.3 * place), style)
        axes.axvline(dt.min() / 1.6, color="0.7", linewidth=0.8)
        axes.set(xscale="log", yscale="log", ylim=(LEAST / 1.6, 30), title=rf"$\nu={nu:g}$")
        axes.set_xticks([10.0**k for k in range(round(np.log10(dt.min())), -1)])
        axes.text(dt.min() / 3, 8, r"$\mathrm{d}t\to 0$", ha="center")
        axes.set_xlabel(r"time step $\mathrm{d}t$ ($1/\dot\gamma$)")
    panels[0].set_ylabel(f"excess of the {RATIO_LABEL} $- 1$")
    handles, labels = panels[0].get_legend_handles_labels()
    handles.append(Line2D([], [], marker="x", linestyle="none", color="0.4", markersize=7))
    figure.legend(handles, [*labels, "status not ok"], loc="outside lower center", ncols=4)
    return figure


def draw_limit(axes: Axes, limit: dict, place: float, style: dict) -> None:
    """The interval of the limit as a bar, ending in an arrow where it reaches down to no excess;
    the best as a mark.
    """
    low, best, high = (max(limit[name] - 1, LEAST) for name in ("low", "best", "high"))
    axes.plot([place, place], [low, high], color=style["color"], linewidth=2.5)
    if low <= LEAST:
        axes.plot(place, LEAST, "v", color=style["color"], markersize=6)
    if best > LEAST:
        axes.plot(place, best, **{**style, "markersize": 6})
