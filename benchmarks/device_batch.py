"""Batches of replicas on the device that JAX finds, beside one core of the numba rival.

Replicas are advanced from the same states by what jaxgran takes for this device and, a few of them,
by the rival. Replica-steps per second are printed and written as JSON, with the pressure against
that of the rival and the peak of the device's memory where it tells. Where the replicas advance in
lockstep their number decides the speed, so it is raised, and one large flow is advanced as well.
States are prepared on the processor. With ``--engine numba`` a device takes the numba engine, whose
calls must repeat to the bit, also at 64 and 1024 grains; the last of its batches needs some 25 GB.

    python -m benchmarks device_batch           # a processor: 2 minutes
    python -m benchmarks device_batch --quick   # under a minute
    python -m benchmarks device_batch --engine numba   # on a CUDA device
"""

import time
from functools import partial
from itertools import product
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np

import jaxgran as jg
from benchmarks.independent import contact_dynamics
from benchmarks.output import Output
from benchmarks.step_cost import rival_arguments
from jaxgran.dynamics.engine import Numerics, engine_named, select_engine
from jaxgran.environment import on_processor
from jaxgran.sampling.averages import averages
from jaxgran.sampling.observe import advance_batch

POINTS = ((0.9, 0.56), (0.5, 0.7), (0.5, 0.8))
BATCHES = ((1000, 256, 1e-3), (1000, 256, 1e-4))  # replicas, grains, time step
ACCELERATOR_BATCHES = ((1, 100_000, 1e-3), (16_000, 256, 1e-3), (16_000, 256, 1e-4))
NUMBA_BATCHES = ((1000, 64, 1e-3), (16_000, 64, 1e-3), (1000, 1024, 1e-3), (16_000, 1024, 1e-3))
STRAIN = 0.2
DISTINCT, APART = 16, 0.5  # states of a batch, and the strain between them
TURNS, ENOUGH_SECONDS = 3, 60


def run(output: Output, engine: Literal["auto", "numba"] = "auto") -> None:
    """Compare every batch at every point, print, and write JSON after each."""
    numerics = Numerics(engine=engine_named(engine))
    batches, points = BATCHES, POINTS
    if not on_processor():
        batches += ACCELERATOR_BATCHES + NUMBA_BATCHES * (engine == "numba")
    if output.quick:
        batches, points = ((64, 256, 1e-3),), POINTS[:2]
    device = jax.local_devices()[0]
    head = {"device": device.device_kind, "devices": jax.device_count()}
    rows = []
    for (replicas, grains, dt), (alpha, nu) in product(batches, points):
        flow = jg.ShearFlow(grains=grains, restitution=alpha, packing_fraction=nu, timestep=dt)
        about = {"replicas": replicas, "grains": grains, "dt": dt, "alpha": alpha, "nu": nu}
        rows.append(about | compare(flow, replicas, numerics))
        print(rows[-1], flush=True)
        name = f"device_batch_{device.platform}{'_numba' * (engine == 'numba')}"
        memory = (device.memory_stats() or {}).get("peak_bytes_in_use")
        output.write_json(name, head | {"peak_bytes": memory} | {"rows": rows})


def compare(flow: jg.ShearFlow, replicas: int, numerics: Numerics) -> dict:
    """Replica-steps per second from the same states, the fastest of some calls in turn, and the
    mean pressure of the device over that of the processor.
    """
    steps, apart = (round(strain / float(flow.timestep)) for strain in (STRAIN, APART))
    with jax.default_device(jax.local_devices(backend="cpu")[0]):
        state = jg.prepare(flow, jax.random.key(0), equilibrate=5.0)
        forward = jax.jit(jg.advance)
        distinct = [
            state := forward(flow, state, jnp.int32(apart))[0]
            for _ in range(min(DISTINCT, replicas))
        ]
        tallies = [forward(flow, state, jnp.int32(steps))[1] for state in distinct]
        distinct, tallies = jax.device_get((distinct, tallies))
    which = np.arange(replicas) % len(distinct)
    batch = jax.tree.map(lambda *x: np.stack(x)[which], *distinct)
    flows = jax.tree.map(lambda x: np.full(replicas, x), flow)
    ways = {  # what is done in a call, and how many replica-steps that is
        "device": (
            partial(advance_batch, flows, numerics, batch, np.full(replicas, np.int32(steps))),
            steps * replicas,
        ),
        "rival": (partial(rivals, flow, distinct, steps), steps * len(distinct)),
    }
    seconds, of_turns = {name: [] for name in ways}, []
    pressures = [pressure(tally, flow, distinct[0]) for tally in tallies]
    begun = time.perf_counter()
    for turn in range(1 + TURNS):  # the first compiles
        if turn > 1 and time.perf_counter() - begun > ENOUGH_SECONDS:
            break
        for name, (call, _) in ways.items():
            start = time.perf_counter()
            result = jax.block_until_ready(call())
            seconds[name].append(time.perf_counter() - start)
            if name == "device":
                of_turns.append(pressure(result[1], flow, distinct[0])[: len(distinct)])
    speeds = {name: done / min(seconds[name][1:]) for name, (_, done) in ways.items()}
    return {
        "engine": select_engine(numerics).name,
        "repeats": all(np.array_equal(x, of_turns[0]) for x in of_turns),
        **speeds,
        "ratio": speeds["device"] / speeds["rival"],
        "pressure": float(np.mean(of_turns[0]) / np.mean(pressures)),
        "compilation": seconds["device"][0] - min(seconds["device"][1:]),
    }


def pressure(tally: jg.Tally, flow: jg.ShearFlow, state: jg.State) -> np.ndarray:
    """Pressure of one sample, or of each of a batch."""
    area, sums = float(state.side) ** 2, jax.device_get(tally)
    return np.asarray(averages(sums, area, flow.grains, flow.shear_rate)["pressure"])


def rivals(flow: jg.ShearFlow, states: list[jg.State], steps: int) -> None:
    for state in states:
        contact_dynamics.advance(**rival_arguments(flow, state), steps=steps)
