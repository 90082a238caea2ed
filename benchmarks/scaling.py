"""How cost and memory grow: with the grains of a flow, the replicas, the contacts, the time step; and mixed maps.

Every size of a flow is measured in a process of its own, whose largest resident memory is told. Seconds are those of
the processor, which do not count what else runs on a machine. The exponent of each growth is a least-squares fit to the
logarithms.

    python -m benchmarks scaling           # up to 1e6 grains and 4096 replicas; 6 minutes
    python -m benchmarks scaling --quick   # up to 1e4 grains and 64 replicas, no mixed map; most of it compilation
    python -m benchmarks scaling --grains 100000   # one flow, for a strain of 0.1, as JSON
"""

import json
import resource
import tempfile
import time
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import jaxgran as jg
from benchmarks.output import Output
from benchmarks.process import printed_by
from jaxgran.dynamics.engine import DEFAULT_NUMERICS
from jaxgran.environment import usable_cores
from jaxgran.sampling.batch import advance_batch, for_replicas, stack

GRAINS, QUICK_GRAINS = (128, 512, 2_000, 10_000, 30_000, 100_000, 1_000_000), (1_000, 10_000)
REPLICAS, QUICK_REPLICAS = (1, 4, 16, 64, 256, 1024, 4096), (8, 64)
TIMESTEPS, QUICK_TIMESTEPS = (1e-2, 3e-3, 1e-3, 3e-4, 1e-4, 3e-5, 1e-5), (1e-2, 1e-3, 1e-4)
PACKING_FRACTIONS, QUICK_PACKING_FRACTIONS = (0.2, 0.4, 0.6, 0.7, 0.75, 0.78, 0.8, 0.81, 0.82), (0.4, 0.7, 0.8)
LARGE_FLOW = (0.8, 0.6)  # restitution, packing fraction
DENSE_FLOW = (0.5, 0.8)
STRAIN = 0.1  # of a timing
REPEATS = 5
LINEAR = 1_000, 100_000  # grains: smaller flows have steps without a contact, larger ones outgrow the caches


def run(output: Output, grains: int | None = None) -> None:
    """Measure all growths, print, and write JSON and PNG; or print one flow of so many grains as JSON."""
    if grains is not None:
        print(json.dumps(large_flow(grains)))
        return
    sizes, batches, dts, fractions = (
        (QUICK_GRAINS, QUICK_REPLICAS, QUICK_TIMESTEPS, QUICK_PACKING_FRACTIONS)
        if output.quick
        else (GRAINS, REPLICAS, TIMESTEPS, PACKING_FRACTIONS)
    )
    rows = {
        "grains": [in_a_process_of_its_own(n) for n in sizes],
        "replicas": replicas(batches),
        "timestep": [row for at in (LARGE_FLOW, DENSE_FLOW) for row in timesteps(at, dts)],
        "contacts": contacts(fractions),
    }
    mixed = None if output.quick else mixed_map(48.0)
    found = exponents(rows)
    report(rows, found, mixed)
    output.write_json("scaling", {"exponents": found, "mixed map": mixed, **rows})
    output.write_picture(draw(rows, found), "scaling")


def in_a_process_of_its_own(grains: int) -> dict[str, float]:
    text = printed_by("scaling", "--grains", str(grains))
    print(f"{grains} grains: {text.strip()}", flush=True)
    return json.loads(text)


def large_flow(grains: int) -> dict[str, float]:
    """Time and memory of one flow from a random packing: sheared to a strain of 2 STRAIN, timed over STRAIN."""
    alpha, nu = LARGE_FLOW
    flow = jg.ShearFlow(grains, alpha, nu, 1e-3)
    before, wall = time.process_time(), time.perf_counter()
    state = jax.block_until_ready(jg.prepare(flow, jax.random.key(0), equilibrate=2 * STRAIN))
    prepared = {"prepare cpu seconds": time.process_time() - before, "prepare seconds": time.perf_counter() - wall}
    start = time.process_time()
    compiled = jax.jit(jg.advance).lower(flow, state, jnp.int32(1)).compile()
    compilation = time.process_time() - start
    state, seconds, tally = timed(compiled, flow, state, STRAIN)
    return {
        "grains": grains,
        **{name: round(value, 3) for name, value in prepared.items()},
        "compile cpu seconds": round(compilation, 2),
        "seconds": seconds["wall"],
        "cpu seconds": seconds["cpu"],
        "microseconds per grain and step": float(f"{1e6 * seconds['cpu'] / (grains * float(tally.steps)):.4g}"),
        "contacts per solve": round(float(tally.contacts / tally.solves), 2),
        "status": jg.Status(int(tally.status)).name,
        "peak resident MiB": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024),
    }


def timed(compiled, flow: jg.ShearFlow, state: jg.State, strain: float) -> tuple[jg.State, dict[str, float], jg.Tally]:
    """The state after a strain, seconds of the processor and of the clock (medians), and the tally."""
    steps = jnp.int32(round(strain / float(flow.timestep)))
    seconds = {"cpu": [], "wall": []}
    for _ in range(REPEATS):
        cpu, wall = time.process_time(), time.perf_counter()
        end, tally = jax.block_until_ready(compiled(flow, state, steps))
        seconds["cpu"].append(time.process_time() - cpu)
        seconds["wall"].append(time.perf_counter() - wall)
    return end, {name: float(f"{np.median(x):.4g}") for name, x in seconds.items()}, tally


def replicas(sizes: tuple[int, ...]) -> list[dict[str, float]]:
    """Time of one batch against its number of replicas; the way of the backend (one after the other on a CPU)."""
    flow = jg.ShearFlow(64, *LARGE_FLOW, 1e-3)
    state = jg.prepare(flow, jax.random.key(0), equilibrate=4.0)
    rows = []
    for size in sizes:
        flows, states = stack([flow] * size), jax.tree.map(lambda leaf, n=size: jnp.stack([leaf] * n), state)
        steps, numerics = jnp.full(size, 1000, jnp.int32), for_replicas(DEFAULT_NUMERICS, size)
        jax.block_until_ready(advance_batch(flows, numerics, states, steps // 10))
        start = time.process_time()
        jax.block_until_ready(advance_batch(flows, numerics, states, steps))
        seconds = time.process_time() - start
        rate = float(f"{1000 * size / seconds:.4g}")
        rows.append({"replicas": size, "cpu seconds": float(f"{seconds:.4g}"), "replica-steps per second": rate})
    return rows


def timesteps(at: tuple[float, float], dts: tuple[float, ...]) -> list[dict[str, float]]:
    """Time of a unit of strain against the time step, 256 grains."""
    flow = jg.ShearFlow(256, *at, 1e-3)
    state = jg.prepare(flow, jax.random.key(1), equilibrate=4.0)
    compiled = jax.jit(jg.advance).lower(flow_of_arrays(flow), state, jnp.int32(1)).compile()
    rows = []
    for dt in dts:
        shorter = flow_of_arrays(replace(flow, timestep=dt))
        state, _, _ = timed(compiled, shorter, state, STRAIN)
        state, seconds, tally = timed(compiled, shorter, state, STRAIN)
        contacts = float(tally.contacts / tally.solves)
        row = {"alpha": at[0], "nu": at[1], "timestep": dt, "cpu seconds per strain": seconds["cpu"] / STRAIN}
        rows.append(row | {"solves per step": float(tally.solves / tally.steps), "contacts per solve": contacts})
    return rows


def contacts(packing_fractions: tuple[float, ...]) -> list[dict[str, float]]:
    """Time of a step against the contacts of a grain, 256 grains, dt = 1e-3, at three restitutions."""
    rows, compiled = [], None
    for alpha in (0.1, 0.5, 0.9):
        for nu in packing_fractions:
            flow = jg.ShearFlow(256, alpha, nu, 1e-3)
            state = jg.prepare(flow, jax.random.key(2), equilibrate=4.0)
            if compiled is None:
                compiled = jax.jit(jg.advance).lower(flow_of_arrays(flow), state, jnp.int32(1)).compile()
            state, seconds, tally = timed(compiled, flow_of_arrays(flow), state, 1.0)
            per_grain = 2 * float(tally.contacts / tally.steps) / flow.grains
            rows.append(
                {
                    "alpha": alpha,
                    "nu": nu,
                    "contacts per grain": per_grain,
                    "iterations": float(tally.iterations / tally.solves),
                    "microseconds per step": 1e6 * seconds["cpu"] / float(tally.steps),
                }
            )
    return rows


def flow_of_arrays(flow: jg.ShearFlow) -> jg.ShearFlow:
    """The flow with arrays for numbers, so that one compilation serves all."""
    return jax.tree.map(jnp.asarray, flow)


def mixed_map(strain: float) -> dict[str, float]:
    """Clock time of a map of loose and dense flows on all cores, and of two maps of one kind each."""
    with tempfile.TemporaryDirectory() as folder:
        jax.config.update("jax_compilation_cache_dir", folder)  # workers compile once
        return _mixed_map(strain)


def _mixed_map(strain: float) -> dict[str, float]:
    options = {"grains": 256, "seeds": 4, "timestep": 5e-4, "equilibrate": 1.0, "strain": strain}

    def seconds(*packing_fractions: float) -> float:
        start = time.perf_counter()
        jg.ratio_map([0.3, 0.7], list(packing_fractions), workers=usable_cores(), **options)
        return time.perf_counter() - start

    start_up = (without_flows(options), without_flows(options))[1]  # the first compiles
    apart, together = seconds(0.2) + seconds(0.82), seconds(0.2, 0.82)
    return {
        "seconds apart": round(apart, 2),
        "seconds together": round(together, 2),
        "seconds to start a map": round(start_up, 2),
        "loss of throughput": round(1 - (apart - 2 * start_up) / (together - start_up), 3),
    }


def without_flows(options: dict) -> float:
    """Clock time of a map whose flows take next to none."""
    start = time.perf_counter()
    jg.ratio_map([0.3, 0.7], [0.2], workers=usable_cores(), **options | {"equilibrate": 0.0, "strain": 0.16})
    return time.perf_counter() - start


def exponents(rows: dict[str, list[dict]]) -> dict[str, float]:
    """Exponents of cost against the grains, the replicas and the time step, from where it is a power law."""

    def fitted(points: list[dict], x: str, y: str) -> float:
        logs = np.log([[point[x], point[y]] for point in points])
        return round(float(np.polyfit(*logs.T, 1)[0]), 3)

    large = [row for row in rows["grains"] if LINEAR[0] <= row["grains"] <= LINEAR[1]]
    several = [row for row in rows["replicas"] if row["replicas"] >= 8]
    by_flow = {
        f"timestep at α = {at[0]:g}, ν = {at[1]:g}": fitted(
            [row for row in rows["timestep"] if (row["alpha"], row["nu"]) == at], "timestep", "cpu seconds per strain"
        )
        for at in (LARGE_FLOW, DENSE_FLOW)
    }
    return {
        "grains": fitted(large, "grains", "cpu seconds"),
        "replicas": fitted(several, "replicas", "cpu seconds"),
        **by_flow,
    }


def report(rows: dict[str, list[dict]], found: dict[str, float], mixed: dict[str, float] | None) -> None:
    for name, value in found.items():
        print(f"exponent of the cost against {name}: {value:.3f}")
    first, *larger = (row for row in rows["grains"] if row["grains"] >= LINEAR[0])  # of one program
    for row in larger:
        resident = (row["peak resident MiB"] - first["peak resident MiB"]) * 2**20 / (row["grains"] - first["grains"])
        print(
            f"{row['grains']} grains for a strain of {STRAIN:g}: {row['seconds']:.3g} s, peak "
            f"{row['peak resident MiB']} MiB; {resident:.0f} bytes more for each grain than {first['grains']} have"
        )
    if mixed:
        print(f"a map of ν 0.2 and 0.82 loses {100 * mixed['loss of throughput']:.1f} % of throughput against two maps")


def draw(rows: dict[str, list[dict]], found: dict[str, float]) -> Figure:
    """Four growths, logarithmic."""
    figure = Figure(figsize=(9.5, 7.6), layout="constrained")
    grains, replicas, timestep, contact = figure.subplots(2, 2).flat
    sizes = np.array([row["grains"] for row in rows["grains"]])
    grains.plot(sizes, [row["cpu seconds"] / STRAIN for row in rows["grains"]], "ko-", label="measured")
    *_, last = (row for row in rows["grains"] if row["grains"] <= LINEAR[1])
    linear = last["cpu seconds"] / STRAIN / last["grains"] * sizes[-1]
    _guide(grains, sizes, linear, f"linear (fitted to 10⁵: {found['grains']:.2f})")
    grains.set(xlabel="grains N", ylabel="processor time per unit strain (s)", title="α = 0.8, ν = 0.6, dt = 1e-3")
    many = np.array([row["replicas"] for row in rows["replicas"]])
    replicas.plot(many, [row["cpu seconds"] for row in rows["replicas"]], "ko-", label="measured")
    _guide(replicas, many, rows["replicas"][-1]["cpu seconds"], f"linear (fitted: {found['replicas']:.2f})")
    replicas.set(xlabel="replicas of 64 grains", ylabel="processor time per unit strain (s)", title="dt = 1e-3")
    for (alpha, nu), look, colour in ((LARGE_FLOW, "o-", "black"), (DENSE_FLOW, "s--", "tab:blue")):
        here = [row for row in rows["timestep"] if (row["alpha"], row["nu"]) == (alpha, nu)]
        label = f"α = {alpha:g}, ν = {nu:g} (exponent {found[f'timestep at α = {alpha:g}, ν = {nu:g}']:.2f})"
        x, y = ([row[name] for row in here] for name in ("timestep", "cpu seconds per strain"))
        timestep.plot(x, y, look, color=colour, label=label)
    timestep.set(xlabel="dt (1/shear rate)", ylabel="processor time per unit strain (s)", title="256 grains")
    for alpha, look, colour in ((0.1, "^-", "tab:red"), (0.5, "s--", "tab:blue"), (0.9, "o-", "black")):
        here = [row for row in rows["contacts"] if row["alpha"] == alpha]
        x, y = ([row[name] for row in here] for name in ("contacts per grain", "microseconds per step"))
        contact.plot(x, y, look, color=colour, label=f"α = {alpha:g}")
    contact.set(xlabel="contacts per grain and step", ylabel="processor time per step (µs)")
    contact.set_title(f"256 grains, dt = 1e-3, ν = {rows['contacts'][0]['nu']:g} to {rows['contacts'][-1]['nu']:g}")
    for axes in (grains, replicas, timestep, contact):
        axes.set(xscale="log", yscale="log")
        axes.grid(alpha=0.3)
        axes.legend(fontsize="small")
    return figure


def _guide(axes: Axes, x: np.ndarray, last: float, label: str) -> None:
    axes.plot(x, last * x / x[-1], ":", color="gray", label=label)
