"""A batch of replicas on the device that JAX finds, beside one core of the numba rival; and the map
of the paper.

1000 replicas of 256 grains are advanced from the same states by what jaxgran takes for this device,
by the plain advance, and, a few of them, by the rival. Replica-steps per second are printed and
written as JSON, with the peak of the device's memory where it tells. ``--paper`` adds the seconds
of ``jaxgran map --preset paper``.

    python -m benchmarks device_batch                    # a processor: 3 minutes
    python -m benchmarks device_batch --quick            # under a minute
    python -m benchmarks device_batch --paper --output .
"""

import time
from functools import partial

import jax
import jax.numpy as jnp

import jaxgran as jg
from benchmarks.independent import contact_dynamics
from benchmarks.output import Output
from benchmarks.step_cost import rival_arguments
from jaxgran.dynamics.engine import DEFAULT_NUMERICS, select_engine
from jaxgran.environment import usable_cores
from jaxgran.maps.presets import PRESETS
from jaxgran.sampling.observe import advance_batch

POINTS, TIMESTEPS = ((0.9, 0.56), (0.5, 0.7), (0.5, 0.8)), (1e-3, 1e-4)
REPLICAS, GRAINS, STRAIN = 1000, 256, 0.2
PLAIN_SHARE = 10  # the plain advance takes a tenth of the strain
DISTINCT, APART = 16, 0.5  # states of a batch, and the strain between them


def run(output: Output, paper: bool = False) -> None:
    """Compare at every point, print, and write JSON; with the map of the paper where it is asked
    for.
    """
    replicas, points, timesteps = (
        (64, POINTS[:2], TIMESTEPS[:1]) if output.quick else (REPLICAS, POINTS, TIMESTEPS)
    )
    device = jax.local_devices()[0]
    print(f"{jax.device_count()} × {device.device_kind}, {replicas} replicas of {GRAINS} grains")
    print(
        "     dt     α     ν   taken: replica-steps/s   plain    one core of the rival   "
        "taken/rival"
    )
    rows = []
    for dt in timesteps:
        for alpha, nu in points:
            rows.append(compare(alpha, nu, dt, replicas))
            print(
                "{dt:7.0e}{alpha:6.2g}{nu:6.2g}{taken:23.3g}{plain:11.3g}{rival:17.3g}"
                "{ratio:14.1f}".format(**rows[-1])
            )
    result = {
        "hardware": output.hardware | {"device": device.device_kind, "devices": jax.device_count()},
        "engine": rows[0]["engine"],
        "replicas": replicas,
        "grains": GRAINS,
        "peak_bytes": (device.memory_stats() or {}).get("peak_bytes_in_use"),
        "rows": rows,
    }
    if paper:
        result["paper_map_seconds"] = paper_map()
        print(f"the map of the paper: {result['paper_map_seconds']:.0f} s")
    output.write_json(f"device_batch_{device.platform}", result)


def compare(alpha: float, nu: float, dt: float, replicas: int) -> dict:
    """Replica-steps per second from the same states: the fastest of three calls each, in turn."""
    flow = jg.ShearFlow(grains=GRAINS, restitution=alpha, packing_fraction=nu, timestep=dt)
    state = jg.prepare(flow, jax.random.key(0), equilibrate=5.0)
    forward = jax.jit(jg.advance)
    distinct = [
        state := forward(flow, state, jnp.int32(round(APART / dt)))[0] for _ in range(DISTINCT)
    ]
    batch = jax.tree.map(
        lambda *x: jnp.stack([x[n % DISTINCT] for n in range(replicas)]), *distinct
    )
    flows = jax.tree.map(lambda x: jnp.full(replicas, x), flow)
    steps, numerics = round(STRAIN / dt), DEFAULT_NUMERICS
    few = steps // PLAIN_SHARE
    ways = {  # what is done in a call, and how many replica-steps that is
        "taken": (
            lambda: advance_batch(flows, numerics, batch, jnp.full(replicas, steps)),
            steps * replicas,
        ),
        "plain": (lambda: plain(flows, batch, jnp.full(replicas, few)), few * replicas),
        "rival": (partial(rivals, flow, distinct, steps), steps * DISTINCT),
    }
    seconds = {name: [] for name in ways}
    for turn in range(4):  # the first compiles
        for name, (call, _) in ways.items():
            start = time.perf_counter()
            jax.block_until_ready(call())
            if turn:
                seconds[name].append(time.perf_counter() - start)
    speeds = {name: done / min(seconds[name]) for name, (_, done) in ways.items()}
    taken = select_engine(flow, DEFAULT_NUMERICS, state).name
    return {
        "alpha": alpha,
        "nu": nu,
        "dt": dt,
        "engine": taken,
        **speeds,
        "ratio": speeds["taken"] / speeds["rival"],
    }


def _plain_replica(
    flow: jg.ShearFlow, state: jg.State, steps: jax.Array
) -> tuple[jg.State, jg.Tally]:
    return jg.advance(flow, state, steps, engine=jg.Jax())


plain = jax.jit(jax.vmap(_plain_replica))


def rivals(flow: jg.ShearFlow, states: list[jg.State], steps: int) -> None:
    for state in states:
        contact_dynamics.advance(**rival_arguments(flow, state), steps=steps)


def paper_map() -> float:
    """Seconds of the map of the paper, with a worker for each core of a processor."""
    start = time.perf_counter()
    jg.ratio_map(
        **PRESETS["paper"], workers=usable_cores() if jax.default_backend() == "cpu" else 1
    )
    return time.perf_counter() - start
