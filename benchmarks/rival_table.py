"""What the numba loop measures, and how long its step takes: restitutions, packing fractions, coarse and fine dt.

    python -m benchmarks rival_numba            # 27 points
    python -m benchmarks rival_numba --quick    # the same points, shorter strains

``point`` measures any one of them:

    >>> from benchmarks.rival_table import point
    >>> found = point(0.1, 0.6, 1e-4, activation="touching", grains=400)
"""

import math

import numpy as np

from benchmarks.output import Output
from benchmarks.rival_numba import ACTIVATION, advance, settled, start, strained

RESTITUTIONS, PACKING_FRACTIONS, TIMESTEPS = (0.9, 0.5, 0.1), (0.56, 0.7, 0.8), (1e-3, 1e-4, 1e-5)
WINDOWS = 8  # parts of a sample, whose scatter is the error
FEWEST_STEPS = 40_000  # of a sample, so that the cost of a call does not show
STRAINS, QUICK_STRAINS = (20.0, 0.5, 2.0), (4.0, 0.2, 0.5)  # to the steady state, at each shorter dt, of the sample


def run(output: Output) -> None:
    """Measure all points, print them, and write JSON."""
    advance(*start(32, 0.3, 0), 0.0, 1.0, 0.5, 1e-3, 0.5, 1e-4, 10)  # compiles outside the clock
    settle, relax, strain = QUICK_STRAINS if output.quick else STRAINS
    rows = []
    for restitution in RESTITUTIONS:
        for packing_fraction in PACKING_FRACTIONS:
            for timestep in TIMESTEPS:
                strains = settle, relax, max(strain, FEWEST_STEPS * timestep)
                rows.append(point(restitution, packing_fraction, timestep, strains))
                print(
                    f"restitution {restitution:.1f}  packing {packing_fraction:.2f}  timestep {timestep:.0e}  "
                    f"{rows[-1]['microseconds_per_step']:8.3f} us/step  force ratio {rows[-1]['force_ratio']:.3f}  "
                    f"pressure {rows[-1]['pressure']['mean']:.3f}",
                    flush=True,
                )
    output.write_json("rival_numba", {"results": rows})


def point(
    restitution: float,
    packing_fraction: float,
    timestep: float,
    strains: tuple[float, float, float] = STRAINS,
    *,
    activation: str = "midpoint",
    grains: int = 256,
    shear_rate: float = 1.0,
    tolerance: float = 1e-4,
    seed: int = 0,
) -> dict:
    """Force ratio, stresses and the cost of one (restitution, packing fraction), as a dictionary."""
    law = {
        "shear_rate": shear_rate,
        "restitution": restitution,
        "activation": ACTIVATION[activation],
        "tolerance": tolerance,
    }
    settle, relax, strain = strains
    state = settled(grains, packing_fraction, seed, timestep, settle, relax, **law)
    windows = [strained(state, strain / WINDOWS, timestep=timestep, **law)]
    while len(windows) < WINDOWS:
        windows.append(strained(windows[-1][0], strain / WINDOWS, timestep=timestep, **law))
    tallies = [tally for _, tally, _ in windows]
    steps = sum(tally.steps for tally in tallies)

    def mean(name: str) -> dict[str, float]:
        values = [getattr(tally, name) for tally in tallies]
        return {"mean": float(np.mean(values)), "error": float(np.std(values, ddof=1) / math.sqrt(len(values)))}

    return {
        "restitution": restitution,
        "packing_fraction": packing_fraction,
        "activation": activation,
        "timestep": timestep,
        "grains": grains,
        "strain": strain,
        "force_ratio": sum(t.impulse for t in tallies) / max(sum(t.binary_impulse for t in tallies), 1e-300),
        "pressure": mean("pressure"),
        "shear_stress": mean("shear_stress"),
        "temperature": mean("temperature"),
        "contact_stress": np.mean([t.contact_stress for t in tallies], 0).tolist(),
        "binary_stress": np.mean([t.binary_stress for t in tallies], 0).tolist(),
        "kinetic_stress": np.mean([t.kinetic_stress for t in tallies], 0).tolist(),
        "collisions_per_grain_and_strain": 2 * sum(t.collisions for t in tallies) / (grains * strain),
        "contacts_per_step": sum(t.contacts for t in tallies) / steps,
        "solves_per_step": sum(t.solves for t in tallies) / steps,
        "sweeps_per_solve": sum(t.sweeps for t in tallies) / max(1, sum(t.solves for t in tallies)),
        "updates_per_step": sum(t.updates for t in tallies) / steps,
        "unconverged": sum(t.unconverged for t in tallies),
        "largest_overlap": max(t.largest_overlap for t in tallies),
        "microseconds_per_step": 1e6 * float(np.median([s / t.steps for _, t, s in windows])),
    }
