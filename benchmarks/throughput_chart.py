"""Replica-steps per second against the size of a batch, for the two ways to run one, with compilation apart.

``lax.map`` works replicas off one after another; ``vmap`` with the named axis "replica" advances them in lockstep. The
replicas of a batch are different instants of different packings of one flow. On one core of a CPU.
"""

import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import lax
from matplotlib.figure import Figure

import jaxgran as jg
from benchmarks.networks import TIMESTEP, further, sheared
from benchmarks.output import Output
from jaxgran.model.control_flow import AXIS

FLOWS = ((0.5, 0.7), (0.5, 0.8))  # restitution, packing fraction
SIZES, QUICK_SIZES = tuple(2**k for k in range(9)), (8,)
_SEEDS, _EQUILIBRATION, _APART = 4, 2.0, 0.05  # packings; strains before the first and between two states of one
_STEPS, _SHORTEST_TIMING = 200, 0.3  # of one call, which builds its lists anew; seconds of all calls together


def chart(output: Output) -> None:
    """Measure, print, and write ``throughput.json`` and ``throughput.png``."""
    grains, sizes = (64, QUICK_SIZES) if output.quick else (256, SIZES)
    batches = {flow: states(*flow, grains, max(sizes)) for flow in FLOWS}
    points = []
    print("way      replicas  compile (s)   α    ν   replica-steps per second")
    for way, run in WAYS.items():
        for size in sizes:
            points += throughput(way, run, size, grains, batches)
            for point in points[-len(FLOWS) :]:
                print(
                    "{way:8s}{size:9d}{compile_seconds:13.1f}{alpha:4.1f}{nu:5.2f}{steps_per_second:15.0f}".format(
                        **point
                    ),
                    flush=True,
                )
    output.write_json("throughput", {"grains": grains, "timestep": TIMESTEP, "points": points})
    output.write_picture(draw(points), "throughput")


def _mapped(flow: jg.ShearFlow, states: jg.State, steps: jax.Array) -> jg.State:
    return lax.map(lambda state: jg.advance(flow, state, steps)[0], states)


def _vectorised(flow: jg.ShearFlow, states: jg.State, steps: jax.Array) -> jg.State:
    return jax.vmap(lambda state: jg.advance(flow, state, steps)[0], axis_name=AXIS)(states)


WAYS = {"lax.map": _mapped, "vmap": _vectorised}


def states(restitution: float, packing_fraction: float, grains: int, count: int) -> jg.State:
    """A batch of different states of one flow."""
    flow = packing_fraction, restitution
    members = [sheared(*flow, grains, _EQUILIBRATION, seed) for seed in range(min(_SEEDS, count))]
    while len(members) < count:
        members.append(further(*flow, members[-_SEEDS], _APART))
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *members)


def throughput(way: str, run: Callable, size: int, grains: int, batches: dict[tuple, jg.State]) -> list[dict]:
    """Seconds to compile and replica-steps per second of the first ``size`` states of every flow."""
    compiled, seconds, points = None, 0.0, []
    for (alpha, nu), batch in batches.items():
        flow = jax.tree.map(jnp.asarray, jg.ShearFlow(grains, alpha, nu, TIMESTEP))
        now = jax.tree.map(lambda leaf: leaf[:size], batch)
        if compiled is None:
            start = time.perf_counter()
            compiled = jax.jit(run).lower(flow, now, jnp.int32(1)).compile()
            seconds = time.perf_counter() - start
        calls, start = 0, time.perf_counter()
        while (took := time.perf_counter() - start) < _SHORTEST_TIMING:
            now = jax.block_until_ready(compiled(flow, now, jnp.int32(_STEPS)))
            calls += 1
        rate = size * calls * _STEPS / took
        points.append(
            {
                "way": way,
                "size": size,
                "alpha": alpha,
                "nu": nu,
                "steps": calls * _STEPS,
                "compile_seconds": round(seconds, 2),
                "steps_per_second": float(f"{rate:.4g}"),
            }
        )
    return points


def draw(points: list[dict]) -> Figure:
    """Rates at both flows, and times to compile, against the number of replicas."""
    figure = Figure(figsize=(9.5, 4.2), layout="constrained")
    rates, compilation = figure.subplots(1, 2)
    looks = {"lax.map": ("black", "-"), "vmap": ("tab:blue", "--")}
    for way, (colour, style) in looks.items():
        for (alpha, nu), marker in zip(FLOWS, "os", strict=True):
            here = [p for p in points if (p["way"], p["alpha"], p["nu"]) == (way, alpha, nu)]
            sizes = [p["size"] for p in here]
            label = f"{way}, α = {alpha:g}, ν = {nu:g}"
            rates.plot(
                sizes, [p["steps_per_second"] for p in here], color=colour, linestyle=style, marker=marker, label=label
            )
        compilation.plot(
            sizes, [p["compile_seconds"] for p in here], color=colour, linestyle=style, marker="D", label=way
        )
    rates.set(yscale="log", ylabel="replica-steps per second")
    compilation.set(ylabel="time to compile (s)")
    compilation.set_ylim(bottom=0)
    for axes in (rates, compilation):
        axes.set_xscale("log", base=2)
        axes.set_xticks(sizes, [str(size) for size in sizes])
        axes.set_xlabel("replicas of a batch")
        axes.grid(alpha=0.3)
        axes.margins(y=0.2)
        axes.legend(fontsize="small", loc="best")
    return figure
