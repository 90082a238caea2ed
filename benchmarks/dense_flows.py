"""Dense flows of a few thousand grains between the largest packing fraction of a map, 0.83, and
jamming at about 0.84.

A map refuses them: fewer grains often cannot be packed there, since the packing fraction at which
they jam scatters. Every flow is packed, sheared from rest at dt = 1e-4 and at its own dt, and
sampled, α = 0.2, midpoint rule; its energy is dissipated and supplied anew within a strain of some
hundredths. It is written when it is done, so a study that was stopped goes on where it was, at the
same commit. ``dense_limit`` fits these flows together with those of ``dense_rheology``.

    python -m benchmarks dense_flows           # an hour on one core
    python -m benchmarks dense_flows --quick   # one flow of 256 grains, a minute
"""

import json
import time
from typing import Any

import jax

import jaxgran as jg
from benchmarks.output import Output, rounded
from benchmarks.stability import unjudged
from jaxgran.sampling.sample import estimates

FULL = (
    (0.83, 5e-5),
    (0.832, 5e-5),
    (0.834, 2e-5),
    (0.836, 2e-5),
    (0.838, 1e-5),
)  # packing fraction, dt
QUICK = ((0.81, 1e-4),)
RESTITUTION = 0.2
GRAINS = 4000
COARSE = 1e-4  # dt of the first part of the preparation
PREPARED, SAMPLED = 1.0, 4.0  # strain at each of the two time steps, and of the sample
AVERAGES = (
    "inertial_number",
    "macroscopic_friction",
    "pressure",
    "granular_temperature",
    "force_ratio",
)


def run(output: Output) -> None:
    """Measure the flows that a run of this commit has not written, print a line for each, and write
    them as JSON.
    """
    file = output.path("dense_flows", ".json")
    written = json.loads(file.read_text()) if file.exists() else {}
    same = written.get("hardware") == output.hardware
    rows = written["points"] if same else []
    grains, strain = (256, 1.0) if output.quick else (GRAINS, SAMPLED)
    head = {"restitution": RESTITUTION, "grains": grains, "prepared": PREPARED, "strain": strain}
    for nu, dt in QUICK if output.quick else FULL:
        if all(row["packing_fraction"] != nu for row in rows):
            rows.append(measured(nu, dt, grains, strain))
            output.write_rows("dense_flows", head, "points", rows)
            print(", ".join(f"{name} {value}" for name, value in rows[-1].items()), flush=True)


def measured(nu: float, dt: float, grains: int, strain: float) -> dict[str, Any]:
    """The averages of one flow with their standard errors, and the worst status on the way to
    them.
    """
    start = time.perf_counter()
    coarse, flow = (
        unjudged(jg.ShearFlow(grains, RESTITUTION, 0.5, x), packing_fraction=nu)
        for x in (COARSE, dt)
    )
    state, packed = jax.jit(jg.pack)(flow, jax.random.key(0))
    if not packed:
        raise RuntimeError(f"{grains} grains could not be packed at ν = {nu:g}.")
    state, first = jg.sample(coarse, state, PREPARED)
    state, second = jg.sample(flow, state, PREPARED)
    _, sample = jg.sample(flow, state, strain)
    values, errors = estimates([sample])
    row = {"packing_fraction": nu, "restitution": RESTITUTION, "timestep": dt}
    for name in AVERAGES:
        row |= rounded({name: float(values[name]), f"{name}_stderr": float(errors[name])}, 5)
    drift = float(sample.pressure / second.pressure) - 1
    row |= {
        "change_since_preparation": round(drift, 4),
        "seconds": round(time.perf_counter() - start),
    }
    return row | {"status": max(int(one.status) for one in (first, second, sample))}
