"""The reference map: averages of large systems over the plane of restitution and packing fraction, at dt = 1e-4.

Packing fractions are 0.01 apart where averages change fast, and restitutions are close where grains cluster. Loose
flows depend on N and have 6400 grains, dense ones 1600. Every seed is a map of its own, sampled over six correlation
strains of each flow, and kept beside the results; all are merged. So a run that was stopped goes on, and another
seed makes all errors smaller.

    python -m benchmarks reference_map             # two hours on two cores
    python -m benchmarks reference_map --seeds 4   # two seeds more
    python -m benchmarks reference_map --quick     # a plane of 3 × 3 points, 64 and 100 grains, a minute
"""

from pathlib import Path
from typing import Any

import jaxgran as jg
from benchmarks.output import RESULTS, Output
from jaxgran.environment import usable_cores
from jaxgran.maps.results import write_dataset

KEPT = RESULTS / ".reference_map"  # the maps of single seeds
RESTITUTIONS = (0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.98)
LOOSE = (0.1, 0.2, 0.3, 0.4, 0.5, 0.56, 0.6, 0.65, 0.7)
DENSE = (0.72, 0.73, 0.74, 0.75, 0.76, 0.77, 0.78, 0.79, 0.8, 0.81, 0.82, 0.83)


def parameters(quick: bool) -> dict[str, Any]:
    """The arguments of ``ratio_map`` for one seed."""
    alphas, loose, dense = ((0.1, 0.5, 0.9), (0.5, 0.7), (0.8,)) if quick else (RESTITUTIONS, LOOSE, DENSE)
    sizes = (100, 64) if quick else (6400, 1600)
    grains = [size for nus, size in zip((loose, dense), sizes, strict=True) for _ in nus for _ in alphas]
    plane = {"restitution": alphas, "packing_fraction": loose + dense, "grains_by_point": grains}
    return plane | {"timestep": 5e-4 if quick else 1e-4, "seeds": 1}


def run(output: Output, seeds: int = 2, folder: Path = KEPT) -> None:
    """Map the seeds that are missing, and write all of them as one map, ``reference.nc``."""
    folder = folder.with_name(f"{folder.name}_quick") if output.quick else folder
    folder.mkdir(parents=True, exist_ok=True)
    about = {"command": "python -m benchmarks reference_map", "commit": output.hardware["commit"]}
    maps = []
    for seed in range(seeds):
        kept = folder / f"seed_{seed}.nc"
        made = {"output": kept, "resume": True, "progress": True, "workers": usable_cores(), "attributes": about}
        maps.append(jg.ratio_map(**parameters(output.quick), first_seed=seed, **made))
    merged = jg.merge_maps(maps)
    merged.attrs |= {"command": about["command"]}
    write_dataset(merged, output.path("reference", ".nc"))
