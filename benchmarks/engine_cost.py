"""What an engine costs: replica-steps per second of the numba engine and of JAX, replica by replica and in lockstep.

The original design is the last way: JAX alone, all replicas of a batch in lockstep by ``vmap``, contacts by Jacobi
iterations. The replicas of a batch are packings of one flow, prepared by the numba engine; every way takes the same
states through the same steps. Seconds are those that the processor spends, on one core, with compilation apart, so that
other programs on the machine hardly matter.

    python -m benchmarks engine_cost
    python -m benchmarks engine_cost --quick
"""

import time
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from matplotlib.figure import Figure

import jaxgran as jg
from benchmarks.output import Output
from jaxgran.model.control_flow import AXIS
from jaxgran.sampling.batch import stack
from jaxgran.sampling.steady_state import prepare_batch

FLOWS, QUICK_FLOWS = ((0.9, 0.6), (0.5, 0.7), (0.5, 0.8)), ((0.5, 0.6),)  # restitution, packing fraction
TIMESTEPS, QUICK_TIMESTEPS = (1e-3, 1e-4), (1e-3,)
SIZES, QUICK_SIZES = (1, 16), (1, 4)  # of a batch; one after another replicas cost the same in any
TOLERANCE, EQUILIBRATION = 1e-4, 1.0  # strain
TRIAL_STRAIN, LONGEST_STRAIN, SECONDS = 0.01, 1.0, 1.0  # of a first call; of the timed one, which takes so long


def run(output: Output) -> None:
    """Measure, print, and write ``engine_cost.json`` and ``engine_cost.png``."""
    quick = output.quick
    grains, sizes = (64, QUICK_SIZES) if quick else (256, SIZES)
    flows, timesteps = (QUICK_FLOWS, QUICK_TIMESTEPS) if quick else (FLOWS, TIMESTEPS)
    prepared = {(flow, dt): states(*flow, dt, grains, max(sizes)) for dt in timesteps for flow in flows}
    points = []
    print("way                  replicas  compile (s)   α    ν      dt   replica-steps per second")
    for way, (choice, together) in WAYS.items():
        for size in sizes if together is _in_lockstep else sizes[-1:]:
            compiled, seconds = None, 0.0
            for ((alpha, nu), dt), batch in prepared.items():
                flow = jg.ShearFlow(grains, alpha, nu, dt)
                now = jax.tree.map(lambda leaf, size=size: leaf[:size], batch)
                if compiled is None:
                    start = time.process_time()
                    compiled = jax.jit(partial(together, **choice)).lower(_traced(flow), now, jnp.int32(1)).compile()
                    seconds = time.process_time() - start
                rate, iterations = throughput(compiled, _traced(flow), now, dt)
                points.append(
                    {
                        "way": way,
                        "size": size,
                        "alpha": alpha,
                        "nu": nu,
                        "dt": dt,
                        "compile_seconds": round(seconds, 2),
                        "steps_per_second": float(f"{rate:.4g}"),
                        "iterations_per_solve": float(f"{iterations:.3g}"),
                    }
                )
                line = "{way:22s}{size:7d}{compile_seconds:13.1f}{alpha:4.1f}{nu:5.2f}{dt:8.0e}{steps_per_second:15.0f}"
                print(line.format(**points[-1]), flush=True)
    output.write_rows("engine_cost", {"grains": grains, "tolerance": TOLERANCE}, "points", points)
    output.write_picture(draw(points), "engine_cost")


def _in_turn(flow: jg.ShearFlow, states: jg.State, steps: jax.Array, **how: Any) -> tuple[jg.State, jg.Tally]:
    return lax.map(lambda state: jg.advance(flow, state, steps, **how), states)


def _in_lockstep(flow: jg.ShearFlow, states: jg.State, steps: jax.Array, **how: Any) -> tuple[jg.State, jg.Tally]:
    return jax.vmap(lambda state: jg.advance(flow, state, steps, **how), axis_name=AXIS)(states)


WAYS: dict[str, tuple[dict[str, Any], Callable]] = {
    "numba engine": ({"engine": jg.Numba()}, _in_turn),
    "jax, lax.map": ({"engine": jg.Jax()}, _in_turn),
    "jax, vmap": ({"engine": jg.Jax()}, _in_lockstep),
    "jax, Jacobi, vmap": ({"engine": jg.Jax(), "solver": jg.Jacobi()}, _in_lockstep),
}


def states(restitution: float, packing_fraction: float, timestep: float, grains: int, count: int) -> jg.State:
    """Packings of one flow, sheared and relaxed at the time step."""
    flow = stack([jg.ShearFlow(grains, restitution, packing_fraction, timestep)] * count)
    return prepare_batch(flow, jax.random.split(jax.random.key(0), count), EQUILIBRATION).state


def _traced(flow: jg.ShearFlow) -> jg.ShearFlow:
    return jax.tree.map(jnp.asarray, flow)


def throughput(compiled: Callable, flow: jg.ShearFlow, states: jg.State, timestep: float) -> tuple[float, float]:
    """Replica-steps per second of a call of about ``SECONDS``, and iterations of its contact solves."""

    def timed(steps: int) -> tuple[float, jg.Tally]:
        start = time.process_time()
        _, tally = jax.block_until_ready(compiled(flow, states, jnp.int32(steps)))
        return (time.process_time() - start) / steps, tally

    least, most = round(TRIAL_STRAIN / timestep), round(LONGEST_STRAIN / timestep)
    cost, _ = timed(least)
    cost, tally = timed(round(np.clip(SECONDS / cost, least, most)))
    return len(states.side) / cost, float(np.sum(tally.iterations) / max(1, np.sum(tally.solves)))


def draw(points: list[dict]) -> Figure:
    """Replica-steps per second at every flow: a panel for each time step, a bar for each way and size of a batch."""
    timesteps = sorted({p["dt"] for p in points}, reverse=True)
    bars = list(dict.fromkeys((p["way"], p["size"]) for p in points))
    figure = Figure(figsize=(5 * len(timesteps) + 1, 4.2), layout="constrained")
    panels = np.atleast_1d(figure.subplots(1, len(timesteps), sharey=True))
    for axes, dt in zip(panels, timesteps, strict=True):
        here = [p for p in points if p["dt"] == dt]
        flows = list(dict.fromkeys((p["alpha"], p["nu"]) for p in here))
        for k, (way, size) in enumerate(bars):
            rates = [p["steps_per_second"] for p in here if (p["way"], p["size"]) == (way, size)]
            label = f"{way}, {size} replica{'s' if size > 1 else ''}"
            width, colour = 0.8 / len(bars), str(0.1 + 0.85 * k / len(bars))
            places = np.arange(len(flows)) + width * (k - (len(bars) - 1) / 2)
            axes.bar(places, rates, width, color=colour, edgecolor="black", label=label)
        axes.set(yscale="log", title=f"dt = {dt:g}/γ̇", xlabel="restitution α (above), packing fraction ν (below)")
        axes.set_xticks(range(len(flows)), [f"{alpha:g}\n{nu:g}" for alpha, nu in flows])
        axes.grid(axis="y", alpha=0.3)
    panels[0].set_ylabel("replica-steps per second of one core")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper center", ncols=3, fontsize="small")
    return figure
