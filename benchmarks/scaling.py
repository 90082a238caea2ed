"""How cost and memory grow with the number of grains, cost with the time step, and the cost of a
collision with both.

Every size of a flow is measured in its own process, with its peak resident memory. Seconds are CPU
time, which does not count what else runs on a machine. The exponent of each growth is a
least-squares fit to the logarithms.

    python -m benchmarks scaling           # up to 1e6 grains; 7 minutes
    python -m benchmarks scaling --quick   # up to 1e4 grains; most of it compilation
"""

import multiprocessing
import resource
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import jaxgran as jg
from benchmarks.output import Output
from jaxgran.plotting.style import TWO_COLUMNS, styled

GRAINS, QUICK_GRAINS = (128, 512, 2_000, 10_000, 30_000, 100_000, 1_000_000), (1_000, 10_000)
TIMESTEPS, QUICK_TIMESTEPS = (1e-2, 3e-3, 1e-3, 3e-4, 1e-4, 3e-5, 1e-5), (1e-2, 1e-3, 1e-4)
LARGE_FLOW = (0.8, 0.6)  # restitution, packing fraction
DENSE_FLOW = (0.5, 0.8)
STRAIN = 0.1  # of a timing of a large flow
STRAIN_OF_TIMESTEP = 5.0  # of a timing of 256 grains, whose dense flow is intermittent
STRAIN_BEFORE = 10.0  # of a large flow: temperature and stresses of the grains nearby are steady
COLLIDING_FLOW = (0.9, 0.6)
COLLIDING_GRAINS, QUICK_COLLIDING_GRAINS = (256, 2_048, 16_384, 108_000), (256, 2_048)
COLLISION_TIMESTEPS = (1e-3, 1e-4, 1e-5, 1e-6)
FEW_COLLISIONS = 40_000  # of a timing, or two a grain in larger flows
REPEATS = 5
# grains: smaller flows have steps without a contact, larger ones outgrow the caches
LINEAR = (1_000, 100_000)


def run(output: Output) -> None:
    """Measure all growths, print, and write JSON and PNG."""
    sizes, dts = (QUICK_GRAINS, QUICK_TIMESTEPS) if output.quick else (GRAINS, TIMESTEPS)
    colliding = QUICK_COLLIDING_GRAINS if output.quick else COLLIDING_GRAINS
    rows = {
        "grains": [in_own_process(n) for n in sizes],
        "timestep": [row for at in (LARGE_FLOW, DENSE_FLOW) for row in timesteps(at, dts)],
        "collision": [row for n in colliding for row in collisions(n)],
    }
    fits = exponents(rows)
    print(fits)
    output.write_json("scaling", {"exponents": fits, **rows})
    output.write_picture(draw(rows, fits), "scaling")


def in_own_process(grains: int) -> dict[str, float]:
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        row = pool.submit(large_flow, grains).result()
    print(row, flush=True)
    return row


def large_flow(grains: int) -> dict[str, float]:
    """Time and memory of one flow from a random packing: sheared to STRAIN_BEFORE, timed over
    STRAIN.
    """
    alpha, nu = LARGE_FLOW
    flow = jg.ShearFlow(grains, alpha, nu, 1e-3)
    begin = time.perf_counter()
    state = jax.block_until_ready(jg.prepare(flow, jax.random.key(0), equilibrate=STRAIN_BEFORE))
    prepared = time.perf_counter() - begin
    compiled = jax.jit(jg.advance).lower(flow, state, jnp.int32(1)).compile()
    state, seconds, _ = timed(compiled, flow, state, STRAIN)
    return {
        "grains": grains,
        "prepare seconds": round(prepared, 3),
        "seconds": seconds["wall"],
        "cpu seconds": seconds["cpu"],
        "peak resident MiB": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024),
    }


def timed(
    compiled, flow: jg.ShearFlow, state: jg.State, strain: float
) -> tuple[jg.State, dict[str, float], jg.Tally]:
    """The state after a strain, seconds of the processor and of the clock (medians), and the
    tally.
    """
    steps = jnp.int32(round(strain / float(flow.timestep)))
    seconds = {"cpu": [], "wall": []}
    for _ in range(REPEATS):
        cpu, wall = time.process_time(), time.perf_counter()
        end, tally = jax.block_until_ready(compiled(flow, state, steps))
        seconds["cpu"].append(time.process_time() - cpu)
        seconds["wall"].append(time.perf_counter() - wall)
    return end, {name: float(f"{np.median(x):.4g}") for name, x in seconds.items()}, tally


def timesteps(at: tuple[float, float], dts: tuple[float, ...]) -> list[dict[str, float]]:
    """Time of a unit of strain against the time step, 256 grains."""
    flow = jg.ShearFlow(256, *at, 1e-3)
    state = jg.prepare(flow, jax.random.key(1), equilibrate=4.0)
    compiled = jax.jit(jg.advance).lower(flow_of_arrays(flow), state, jnp.int32(1)).compile()
    rows = []
    for dt in dts:
        shorter = flow_of_arrays(replace(flow, timestep=dt))
        state, _, _ = timed(compiled, shorter, state, STRAIN_OF_TIMESTEP)
        state, seconds, _ = timed(compiled, shorter, state, STRAIN_OF_TIMESTEP)
        row = {"alpha": at[0], "nu": at[1], "timestep": dt}
        rows.append(row | {"cpu seconds per strain": seconds["cpu"] / STRAIN_OF_TIMESTEP})
        print(rows[-1], flush=True)
    return rows


def collisions(grains: int) -> list[dict[str, float]]:
    """CPU time of a collision against the time step, in samples of about as many collisions each;
    the cost of a call without a step is taken off.
    """
    flow = flow_of_arrays(jg.ShearFlow(grains, *COLLIDING_FLOW, 1e-3))
    state = jg.prepare(flow, jax.random.key(2), equilibrate=2.0)
    compiled = jax.jit(jg.advance).lower(flow, state, jnp.int32(1)).compile()
    state, _, tally = timed(compiled, flow, state, STRAIN)
    strain = STRAIN * max(FEW_COLLISIONS, 2 * grains) / float(tally.collisions)
    rows = []
    for dt in COLLISION_TIMESTEPS:
        shorter = replace(flow, timestep=jnp.asarray(dt))
        state, _, _ = timed(compiled, shorter, state, strain)
        _, none, _ = timed(compiled, shorter, state, 0.0)
        _, seconds, tally = timed(compiled, shorter, state, strain)
        each = 1e6 * (seconds["cpu"] - none["cpu"]) / float(tally.collisions)
        row = {"grains": grains, "timestep": dt}
        rows.append(row | {"microseconds per collision": float(f"{each:.3g}")})
        print(rows[-1], flush=True)
    return rows


def flow_of_arrays(flow: jg.ShearFlow) -> jg.ShearFlow:
    """The flow with arrays for numbers, so that one compilation serves all."""
    return jax.tree.map(jnp.asarray, flow)


def exponents(rows: dict[str, list[dict]]) -> dict[str, float]:
    """Exponents of cost against the number of grains and the time step, from where it is a power
    law.
    """

    def fitted(points: list[dict], x: str, y: str) -> float:
        logs = np.log([[point[x], point[y]] for point in points])
        return round(float(np.polyfit(*logs.T, 1)[0]), 3)

    large = [row for row in rows["grains"] if LINEAR[0] <= row["grains"] <= LINEAR[1]]
    fits = {"grains": fitted(large, "grains", "cpu seconds")}
    for alpha, nu in (LARGE_FLOW, DENSE_FLOW):
        name = f"timestep at α = {alpha:g}, ν = {nu:g}"
        points = [row for row in rows["timestep"] if (row["alpha"], row["nu"]) == (alpha, nu)]
        fits[name] = fitted(points, "timestep", "cpu seconds per strain")
    return fits


@styled
def draw(rows: dict[str, list[dict]], fits: dict[str, float]) -> Figure:
    """CPU time of a unit of strain against the number of grains and against the time step."""
    figure = Figure(figsize=(TWO_COLUMNS, 2.5), layout="constrained")
    grains, timestep = figure.subplots(1, 2)
    sizes = np.array([row["grains"] for row in rows["grains"]])
    costs = np.array([row["cpu seconds"] for row in rows["grains"]]) / STRAIN
    grains.plot(sizes, costs, "ko-", label=rf"measured: $N^{{{fits['grains']:.2f}}}$ up to $10^5$")
    last = np.flatnonzero(sizes <= LINEAR[1])[-1]
    grains.plot(sizes, costs[last] / sizes[last] * sizes, ":", color="gray", label=r"$\propto N$")
    grains.set_xlabel("number of grains $N$")
    grains.set_ylabel("CPU time of a unit of strain (s)")
    for (alpha, nu), look in ((DENSE_FLOW, "ks--"), (LARGE_FLOW, "ko-")):
        points = [row for row in rows["timestep"] if (row["alpha"], row["nu"]) == (alpha, nu)]
        exponent = round(fits[f"timestep at α = {alpha:g}, ν = {nu:g}"], 1) + 0.0  # no -0.0
        label = rf"$\alpha={alpha:g}$, $\nu={nu:g}$: $\mathrm{{d}}t^{{{exponent:.1f}}}$"
        x, y = ([row[name] for row in points] for name in ("timestep", "cpu seconds per strain"))
        timestep.plot(x, y, look, label=label)
    timestep.set_xlabel(r"time step $\mathrm{d}t$ ($1/\dot\gamma$)")
    for axes in (grains, timestep):
        axes.set(xscale="log", yscale="log")
        axes.legend()
    return figure
