"""Time of a replica and step against the numba rival, from the same states, on one core.

For every (restitution, packing fraction, dt) a flow is prepared once. Then jaxgran and the rival
advance the same state by the same number of steps in turn, several times; the medians, their ratio
and its geometric mean over the points are printed and written as JSON. Compilation is reported
apart.

    python -m benchmarks step_cost            # about 1 minute
    python -m benchmarks step_cost --quick    # half a minute
"""

import time
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxgran as jg
from benchmarks.independent import contact_dynamics
from benchmarks.output import Output
from benchmarks.peers.jaxgran_itself import discs_of

ONE_CORE = True

RESTITUTIONS, PACKING_FRACTIONS = (0.9, 0.5, 0.1), (0.56, 0.7, 0.8)
STRAINS = {1e-3: 2.0, 1e-4: 1.0, 1e-5: 0.5}  # advanced at a time
GRAINS, TOLERANCE = 256, 1e-4


def run(output: Output, repeats: int = 7) -> None:
    """Compare at every point, print, and write JSON."""
    compile_seconds = compilation()
    grid = [(alpha, nu) for alpha in RESTITUTIONS for nu in PACKING_FRACTIONS]
    if output.quick:
        grid, repeats = [(0.5, 0.56), (0.5, 0.7)], 3
    points = []
    for dt in STRAINS:
        for alpha, nu in grid:
            points.append(compare(alpha, nu, dt, repeats))
            print(points[-1], flush=True)
    means = {
        f"{dt:g}": float(np.exp(np.mean([np.log(p["ratio"]) for p in points if p["dt"] == dt])))
        for dt in STRAINS
    }
    head = {"grains": GRAINS, "tolerance": TOLERANCE, "repeats": repeats}
    head |= {"compile_seconds": compile_seconds, "geometric_mean_ratio": means}
    print(head)
    output.write_json("step_cost", head | {"points": points})


def compilation() -> float:
    """Seconds to trace and compile ``sample`` for one shape, without the persistent cache."""
    flow = jg.ShearFlow(grains=GRAINS, restitution=0.9, packing_fraction=0.56, timestep=1e-3)
    state = jax.jit(jg.pack)(flow, jax.random.key(0))[0]
    start = time.perf_counter()
    jax.jit(lambda f, s, strain: jg.sample(f, s, strain)).lower(flow, state, 0.1).compile()
    return time.perf_counter() - start


def compare(alpha: float, nu: float, dt: float, repeats: int) -> dict:
    """Median microseconds per step of both programs, in turn from the same states."""
    flow = jg.ShearFlow(grains=GRAINS, restitution=alpha, packing_fraction=nu, timestep=dt)
    state = jg.prepare(flow, jax.random.key(1), equilibrate=5.0)
    steps = round(STRAINS[dt] / dt)
    ours, theirs = [], []
    for repeat in range(repeats + 1):  # the first is warm-up
        rivals = rival_arguments(flow, state)
        start = time.perf_counter()
        state, _ = jax.block_until_ready(advance(flow, state, jnp.int32(steps)))
        middle = time.perf_counter()
        contact_dynamics.advance(**rivals, steps=steps)
        end = time.perf_counter()
        if repeat:
            ours.append((middle - start) / steps * 1e6)
            theirs.append((end - middle) / steps * 1e6)
    ratio = np.median(np.array(ours) / np.array(theirs))
    row = {"alpha": alpha, "nu": nu, "dt": dt, "ratio": float(ratio)}
    return row | {"jaxgran_us": float(np.median(ours)), "rival_us": float(np.median(theirs))}


advance = jax.jit(partial(jg.advance, solver=jg.BarzilaiBorwein(TOLERANCE)))


def rival_arguments(flow: jg.ShearFlow, state: jg.State) -> dict[str, Any]:
    """What the rival needs to know of a flow and its state, which it changes."""
    law = {name: float(getattr(flow, name)) for name in ("shear_rate", "restitution", "timestep")}
    rule = {"activation": flow.activation, "tolerance": TOLERANCE}
    return discs_of(state)._asdict() | law | rule
