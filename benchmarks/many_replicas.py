"""What each way to advance many replicas costs: compilation, processor time of a replica and step,
memory.

Sixteen replicas of 64 grains are advanced by 200 steps of dt = 1e-3, at three points. Times are
those of the processor, so that other work on the machine counts little.

    python -m benchmarks many_replicas            # 1 minute
    python -m benchmarks many_replicas --quick    # two replicas, one point: half a minute
"""

import time
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

import jaxgran as jg
from benchmarks.output import Output
from benchmarks.timing import timed

POINTS = ((0.9, 0.5), (0.5, 0.7), (0.3, 0.75))
GRAINS, TIMESTEP, REPLICAS, STEPS = 64, 1e-3, 16, 200
WAYS = {
    "batch": jg.advance,
    "vmap": jax.vmap(jg.advance, (0, 0, None)),
    "vmap, Jax": jax.vmap(partial(jg.advance, engine=jg.Jax()), (0, 0, None)),
}


def run(output: Output) -> None:
    """Measure every way at every point, print, and write JSON."""
    replicas, points = (2, POINTS[:1]) if output.quick else (REPLICAS, POINTS)
    starts = [prepared(alpha, nu, replicas) for alpha, nu in points]
    rows = [measured(name, jax.jit(way), starts, replicas) for name, way in WAYS.items()]
    head = {"grains": GRAINS, "timestep": TIMESTEP, "replicas": replicas, "steps": STEPS}
    output.write_json("many_replicas", head | {"points": points, "ways": rows})


def prepared(alpha: float, nu: float, replicas: int) -> tuple[jg.ShearFlow, jg.State]:
    """A batch of flows of one point, and their states."""
    flows = jg.ShearFlow(GRAINS, jnp.full(replicas, alpha), nu, TIMESTEP)
    return flows, jg.prepare(flows, jax.random.split(jax.random.key(0), replicas), equilibrate=2.0)


def measured(name: str, way: Any, starts: list, replicas: int) -> dict:
    """Costs of a way: compiled once, and run from the states of each point."""
    steps = jnp.int32(STEPS)
    begun = time.process_time()
    program = way.lower(*starts[0], steps).compile()
    seconds, microseconds = time.process_time() - begun, []
    memory = program.memory_analysis().temp_size_in_bytes / 2**20
    for flows, states in starts:
        jax.block_until_ready(program(flows, states, steps))
        call = partial(program, flows, states, steps)
        run_seconds, _ = timed(lambda call=call: jax.block_until_ready(call()))
        microseconds.append(run_seconds / (replicas * STEPS) * 1e6)
    row = {"way": name, "compile_seconds": seconds, "mib_per_replica": memory / replicas}
    print(row | {"us": microseconds}, flush=True)
    return row | {"us": microseconds}
