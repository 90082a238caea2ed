"""What each way to advance many replicas costs: compilation, processor time of a replica and step,
memory.

Sixteen replicas of 64 grains are advanced by 200 steps of dt = 1e-3, at three points, by each way
and engine; and the gradient of a mean over the replicas is taken through 20 steps. Times are those
of the processor, so that other work on the machine counts little.

    python -m benchmarks many_replicas            # 2 minutes
    python -m benchmarks many_replicas --quick    # two replicas, one point, no gradient: 1 minute
"""

import time
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
from jax import lax

import jaxgran as jg
from benchmarks.output import Output
from benchmarks.timing import timed

POINTS = ((0.9, 0.5), (0.5, 0.7), (0.3, 0.75))
GRAINS, TIMESTEP, REPLICAS, STEPS, GRADIENT_STEPS = 64, 1e-3, 16, 200, 20


def by_vmap(engine):
    """The advance of a batch by ``vmap``."""
    return jax.vmap(partial(jg.advance, engine=engine), (0, 0, None))


def by_map(engine):
    """The advance of a batch by ``lax.map``."""

    def batched(flows, states, steps):
        return lax.map(lambda replica: jg.advance(*replica, steps, engine=engine), (flows, states))

    return batched


WAYS = {
    "batch": jg.advance,
    "vmap": by_vmap(None),
    "lax.map": by_map(None),
    "lax.map, Jax": by_map(jg.Jax()),
    "vmap, Jax": by_vmap(jg.Jax()),
}


def run(output: Output) -> None:
    """Measure every way at every point, print, and write JSON."""
    replicas, points = (2, POINTS[:1]) if output.quick else (REPLICAS, POINTS)
    starts = [prepared(alpha, nu, replicas) for alpha, nu in points]
    rows = [measured(name, jax.jit(way), starts, points, replicas) for name, way in WAYS.items()]
    if not output.quick:
        rows.append(gradient(starts[0]))
    output.write_json(
        "many_replicas",
        {
            "grains": GRAINS,
            "timestep": TIMESTEP,
            "replicas": replicas,
            "steps": STEPS,
            "points": points,
            "ways": rows,
        },
    )


def prepared(alpha: float, nu: float, replicas: int) -> tuple[jg.ShearFlow, jg.State]:
    """A batch of flows of one point, and their states."""
    flows = jg.ShearFlow(GRAINS, jnp.full(replicas, alpha), nu, TIMESTEP)
    return flows, jg.prepare(flows, jax.random.split(jax.random.key(0), replicas), equilibrate=2.0)


def compiled(function, *arguments) -> tuple[float, float, object]:
    """Processor seconds to trace and compile, MiB of temporary memory, and the program."""
    start = time.process_time()
    program = function.lower(*arguments).compile()
    seconds = time.process_time() - start
    return seconds, program.memory_analysis().temp_size_in_bytes / 2**20, program


def measured(name: str, way, starts: list, points: tuple, replicas: int) -> dict:
    """Costs of a way: compiled once, and run from the states of each point."""
    steps = jnp.int32(STEPS)
    seconds, memory, program = compiled(way, *starts[0], steps)
    microseconds = []
    for flows, states in starts:
        jax.block_until_ready(program(flows, states, steps))
        run_seconds, _ = timed(
            lambda f=flows, s=states: jax.block_until_ready(program(f, s, steps))
        )
        microseconds.append(run_seconds / (replicas * STEPS) * 1e6)
    texts = " ".join(
        f"({alpha}, {nu}): {us:.2f} µs"
        for (alpha, nu), us in zip(points, microseconds, strict=True)
    )
    print(
        f"{name:32} compile {seconds:5.1f} s  {memory / replicas:6.2f} MiB a replica  {texts}",
        flush=True,
    )
    return {
        "way": name,
        "compile_seconds": seconds,
        "mib_per_replica": memory / replicas,
        "us": microseconds,
    }


def gradient(start: tuple[jg.ShearFlow, jg.State]) -> dict:
    """Costs of the derivative of a mean energy of the replicas with respect to restitution."""
    flows, states = start
    steps = jnp.int32(GRADIENT_STEPS)
    count = jax.jit(jax.vmap(jg.count_events, (0, 0, None)))
    events = int(jnp.max(count(flows, states, steps)))

    def energy(restitution):
        changed, engine = replace(flows, restitution=restitution), jg.Jax(events=events)
        end, _ = jg.advance(changed, states, steps, engine=engine)
        return jnp.mean(jnp.sum(end.velocities**2, axis=(1, 2)))

    seconds, memory, program = compiled(jax.jit(jax.grad(energy)), flows.restitution)
    jax.block_until_ready(program(flows.restitution))
    run_seconds, _ = timed(lambda: jax.block_until_ready(program(flows.restitution)))
    replicas = len(flows.restitution)
    us = run_seconds / (replicas * GRADIENT_STEPS) * 1e6
    print(
        f"gradient, {events} events: compile {seconds:.1f} s, {memory / replicas:.2f} MiB a "
        f"replica, {us:.1f} µs"
    )
    return {
        "way": "gradient",
        "events": events,
        "compile_seconds": seconds,
        "mib_per_replica": memory / replicas,
        "us": [us],
    }
