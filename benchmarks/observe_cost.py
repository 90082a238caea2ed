"""What an observable of one's own costs: its compilation, and the time that it adds to a sample.

python -m benchmarks observe_cost           # two minutes
python -m benchmarks observe_cost --quick   # one point, a minute
"""

from dataclasses import replace
from statistics import median
from time import process_time

import jax
import jax.numpy as jnp

import jaxgran as jg
from benchmarks.output import Output

POINTS = ((0.7, 1e-4), (0.8, 1e-3))  # ν and dt
FLOW = jg.ShearFlow(grains=256, restitution=0.5, packing_fraction=0.7, timestep=1e-4)
STRAIN, REPEATS = 1.0, 5


def observables(scale: float):
    """A new function of a snapshot: fabric, contact stress and granular temperature; ``scale`` makes it another one."""

    def observe(seen: jg.Snapshot) -> dict[str, jax.Array]:
        contacts, state = seen.contacts, seen.state
        force = scale * seen.impulses / seen.timestep
        return {
            "fabric": contacts.normals.T @ contacts.normals,
            "stress": jnp.einsum("c,ca,cb->ab", force * contacts.distances, contacts.normals, contacts.normals),
            "temperature": jnp.mean(state.velocities**2),
        }

    return observe


def sampled(flow: jg.ShearFlow, state: jg.State, observe=None, engine=None) -> float:
    """CPU seconds of one sample of this process."""
    start = process_time()
    jax.block_until_ready(jg.sample(flow, state, strain=STRAIN, observe=observe, engine=engine)[1].tally)
    return process_time() - start


def run(output: Output) -> None:
    """Time samples with and without an observable beside the numba engine and in JAX, print them, and write JSON."""
    rows = []
    print("engine          ν     dt   compilation (s)   with (s)   without (s)   ratio")
    for nu, dt in POINTS[: 1 if output.quick else None]:
        flow = replace(FLOW, packing_fraction=nu, timestep=dt)
        state = jg.prepare(flow, jax.random.key(0))
        sampled(flow, state)
        without = median(sampled(flow, state) for _ in range(REPEATS))
        for engine in (jg.Numba(), jg.Jax()):
            observe = observables(1.0 + len(rows))
            first = sampled(flow, state, observe, engine)
            with_it = median(sampled(flow, state, observe, engine) for _ in range(REPEATS))
            row = {"engine": engine.name, "packing_fraction": nu, "timestep": dt, "compilation": first - with_it}
            rows.append(row | {"with": with_it, "without": without})
            numbers = f"{first - with_it:18.1f}{with_it:11.3f}{without:14.3f}{with_it / without:8.1f}"
            print(f"{engine.name:13}{nu:5g}{dt:7g}{numbers}", flush=True)
    head = {
        "grains": FLOW.grains,
        "restitution": FLOW.restitution,
        "tolerance": jg.BarzilaiBorwein().tolerance,
        "strain": STRAIN,
    }
    output.write_rows("observe_cost", {"run": head | {"repeats": REPEATS, "unit": "CPU seconds"}}, "rows", rows)
