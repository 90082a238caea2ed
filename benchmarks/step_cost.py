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

import jax
import jax.numpy as jnp
import numpy as np

import jaxgran as jg
from benchmarks.independent import contact_dynamics
from benchmarks.output import Output

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
    print(f"compilation of sample: {compile_seconds:.1f} s")
    print("    dt      α     ν     jaxgran     rival   ratio    force ratio (both)")
    points = []
    for dt in STRAINS:
        for alpha, nu in grid:
            points.append(compare(alpha, nu, dt, repeats))
            print(
                "{dt:8.0e}{alpha:6.2g}{nu:6.2g}{jaxgran_us:9.3f} µs{rival_us:7.3f} µs{ratio:8.2f}"
                "{jaxgran_force_ratio:12.3f}{rival_force_ratio:8.3f}".format(**points[-1]),
                flush=True,
            )
    means = {
        dt: float(np.exp(np.mean([np.log(p["ratio"]) for p in points if p["dt"] == dt])))
        for dt in STRAINS
    }
    for dt, mean in means.items():
        print(f"dt = {dt:g}: geometric mean of jaxgran over rival {mean:.2f}")

    result = {
        "grains": GRAINS,
        "tolerance": TOLERANCE,
        "repeats": repeats,
        "compile_seconds": compile_seconds,
        "geometric_mean_ratio": {f"{dt:g}": mean for dt, mean in means.items()},
        "points": points,
    }
    output.write_json("step_cost", result)


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
    ours, theirs, sums = [], [], []
    for repeat in range(repeats + 1):  # the first is warm-up
        rivals = rival_arguments(flow, state)
        start = time.perf_counter()
        state, tally = jax.block_until_ready(advance(flow, state, jnp.int32(steps)))
        middle = time.perf_counter()
        *_, rival = contact_dynamics.advance(**rivals, steps=steps)
        end = time.perf_counter()
        if repeat:
            ours.append((middle - start) / steps * 1e6)
            theirs.append((end - middle) / steps * 1e6)
            sums.append(
                [
                    float(tally.impulse),
                    float(tally.binary_impulse),
                    rival.impulse,
                    rival.binary_impulse,
                ]
            )
    impulse, binary, rival_impulse, rival_binary = np.sum(sums, axis=0)
    return {
        "alpha": alpha,
        "nu": nu,
        "dt": dt,
        "steps": steps,
        "jaxgran_us": float(np.median(ours)),
        "rival_us": float(np.median(theirs)),
        "ratio": float(np.median(np.array(ours) / np.array(theirs))),
        "jaxgran_us_range": [min(ours), max(ours)],
        "rival_us_range": [min(theirs), max(theirs)],
        "jaxgran_force_ratio": impulse / binary,
        "rival_force_ratio": rival_impulse / rival_binary,
    }


advance = jax.jit(partial(jg.advance, solver=jg.BarzilaiBorwein(TOLERANCE)))


def rival_arguments(flow: jg.ShearFlow, state: jg.State) -> dict[str, np.ndarray | float]:
    """What the rival needs to know of a flow and its state, which it changes."""
    return {
        "positions": np.array(state.positions),
        "velocities": np.array(state.velocities),
        "radii": np.array(state.grains.radii),
        "masses": np.array(state.grains.masses),
        "side": float(state.side),
        "tilt": float(state.tilt),
        "shear_rate": float(flow.shear_rate),
        "restitution": float(flow.restitution),
        "timestep": float(flow.timestep),
        "activation": flow.activation,
        "tolerance": TOLERANCE,
    }
