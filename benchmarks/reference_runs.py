"""Fresh flows, which the intervals of the reference map and the law of the size are judged on.

40 random points, uniform in ln(1 − α) and ν over the range of the map; N = 6400 up to ν = 0.71 and
2500 above, dt = 1e-4, one run per point sampled over six correlation strains. The large flows have
102,400 grains, four times as many as any that the law of the size was fitted to, at dt = 3e-4;
their long waves need a preparation of 250 strains. Nothing is fitted to any of them.

    python -m benchmarks reference_runs               # some minutes on two cores
    python -m benchmarks reference_runs --part large  # two and a half hours on two cores
    python -m benchmarks reference_runs --quick       # 3 points of 64 grains, under a minute
"""

from functools import partial
from typing import Any, Literal

import numpy as np

import jaxgran as jg
from benchmarks.cores import on_all_cores
from benchmarks.output import Output
from benchmarks.reference_map import DENSE, LOOSE, RESTITUTIONS
from jaxgran.maps.schema import flattened

AVERAGES = "pressure", "shear_stress", "granular_temperature", "local_granular_temperature"
FULL = {"points": 40, "grains": [6400, 2500], "timestep": 1e-4}  # of loose and of dense flows
QUICK = {"points": 3, "grains": [64, 64], "timestep": 1e-4}
FIRST_SEED = 9000  # of no map
LARGE_FLOWS = ((0.3, 0.72), (0.1, 0.5), (0.8, 0.7), (0.5, 0.3))  # the dearest first
LARGE = {"grains": 102_400, "timestep": 3e-4, "equilibrate": 250.0, "strain": 400.0}
QUICK_LARGE = {"grains": 400, "timestep": 1e-3, "equilibrate": 1.0, "strain": 8.0}
Flow = tuple[float, float, int, int]  # restitution, packing fraction, grains, seed


def run(output: Output, part: Literal["random", "large"] = "random") -> None:
    """Run the flows of a part, print each, and write them as JSON."""
    if part == "random":
        name, plan = "reference_runs", QUICK if output.quick else FULL
        flows, options = random_flows(plan["points"], plan["grains"]), {}
    else:
        name, plan = "reference_runs_large", QUICK_LARGE if output.quick else LARGE
        flows = [(*flow, plan["grains"], FIRST_SEED) for flow in LARGE_FLOWS]
        options = {x: plan[x] for x in ("equilibrate", "strain")}
    measured = partial(row_of, options | {"timestep": plan["timestep"]})
    rows = on_all_cores(measured, flows, lambda flow: -flows.index(flow), output.unfinished(name))
    output.write_json(name, {**plan, "first_seed": FIRST_SEED} | {"rows": rows})


def random_flows(points: int, grains: list[int]) -> list[Flow]:
    """Flows of random restitutions and packing fractions in the range of the reference map."""
    rng, nus, flows = np.random.default_rng(38), (LOOSE[0], DENSE[-1]), []
    for k in range(points):
        alpha = 1 - np.exp(rng.uniform(*np.log(1 - np.array(RESTITUTIONS)[[-1, 0]])))
        nu = round(float(rng.uniform(*nus)), 4)
        count = grains[nu > (LOOSE[-1] + DENSE[0]) / 2]
        flows.append((round(float(alpha), 4), nu, count, FIRST_SEED + k))
    return flows


def row_of(options: dict[str, Any], flow: Flow) -> dict[str, float]:
    """Averages of a flow, their standard errors, and the bounds of time step and tolerance."""
    *where, seed = flow
    chosen = dict(zip(("restitution", "packing_fraction", "grains"), where, strict=True))
    data = jg.ratio_map(**chosen, **options, seeds=1, first_seed=seed, workers=1)
    point = flattened(data).squeeze(("restitution", "packing_fraction"))
    values = {}
    for name in AVERAGES:
        values |= {name: point[name], f"{name}_stderr": point[f"{name}_stderr"]}
        bounds = point[f"{name}_large_system_ci95"]
        for source in ("timestep", "tolerance"):
            values[f"{name}_{source}"] = bounds.sel(error_source=source)
    for end in ("", "_stderr"):
        values[f"dissipation_rate{end}"] = point[f"stresses/dissipation_rate{end}"]
    row = chosen | {"status": int(point.status)}
    row |= {name: float(f"{value.item():.6g}") for name, value in values.items()}
    print(row, flush=True)
    return row
