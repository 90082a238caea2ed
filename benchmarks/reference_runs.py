"""Fresh flows, which the intervals of the reference map and the law of the size are judged on.

40 random points, uniform in ln(1 − α) and ν over the range of the map; N = 6400 up to ν = 0.71 and
2500 above, dt = 1e-4, one run per point sampled over six correlation strains. The large flows have
102,400 grains, four times as many as any that the law of the size was fitted to, at dt = 3e-4;
their long waves need a preparation of 250 strains. Nothing is fitted to any of them.

    python -m benchmarks reference_runs               # five minutes on one core
    python -m benchmarks reference_runs --part large  # two and a half hours on two cores
    python -m benchmarks reference_runs --quick       # 3 points of 64 grains, under a minute
"""

import multiprocessing
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from typing import Literal

import numpy as np
import xarray as xr

import jaxgran as jg
from benchmarks.output import Output
from benchmarks.reference_map import DENSE, LOOSE, RESTITUTIONS
from jaxgran.environment import usable_cores
from jaxgran.maps.schema import flattened

OBSERVABLES = (
    "pressure",
    "shear_stress",
    "granular_temperature",
    "local_granular_temperature",
    "force_ratio",
)
FULL = {"points": 40, "grains": [6400, 2500], "timestep": 1e-4}  # of loose and of dense flows
QUICK = {"points": 3, "grains": [64, 64], "timestep": 1e-4}
FIRST_SEED = 9000  # of no map
LARGE_FLOWS = ((0.3, 0.72), (0.1, 0.5), (0.8, 0.7), (0.5, 0.3))  # the dearest first
LARGE = {"grains": 102_400, "timestep": 3e-4, "equilibrate": 250.0, "strain": 400.0}
QUICK_LARGE = {"grains": 400, "timestep": 1e-3, "equilibrate": 1.0, "strain": 8.0}


def run(output: Output, part: Literal["random", "large"] = "random") -> None:
    """Run the flows of a part, print each, and write them as JSON as they end."""
    start = time.perf_counter()
    name, full, quick, rows_of = PARTS[part]
    plan, rows = quick if output.quick else full, []
    for row in rows_of(**plan):
        rows.append(row)
        seconds = round(time.perf_counter() - start)
        print(f"{len(rows)}: {row}, {seconds} s", flush=True)
        head = {**plan, "first_seed": FIRST_SEED, "seconds": seconds}
        output.write_rows(name, head, "rows", rows)


def large_rows(**plan: float) -> Iterator[dict]:
    """Averages of the large flows on all cores, in the order in which they end."""
    with ProcessPoolExecutor(usable_cores(), multiprocessing.get_context("spawn")) as pool:
        for future in as_completed(pool.submit(large_row, plan, flow) for flow in LARGE_FLOWS):
            yield future.result()


def large_row(plan: dict[str, float], flow: tuple[float, float]) -> dict:
    """Averages of a large flow."""
    chosen = {"restitution": flow[0], "packing_fraction": flow[1], "grains": plan["grains"]}
    begin = time.process_time()
    data = jg.ratio_map(**(plan | chosen), seeds=1, first_seed=FIRST_SEED, workers=1)
    return chosen | _row(data) | {"cpu_seconds": round(time.process_time() - begin)}


def random_points(count: int) -> Iterator[tuple[float, float]]:
    """Random restitutions and packing fractions in the range of the reference map."""
    rng, nus = np.random.default_rng(38), (LOOSE[0], DENSE[-1])
    for _ in range(count):
        alpha = 1 - np.exp(rng.uniform(*np.log(1 - np.array(RESTITUTIONS)[[-1, 0]])))
        yield round(float(alpha), 4), round(float(rng.uniform(*nus)), 4)


def fresh_rows(points: int, grains: list[int], timestep: float) -> Iterator[dict]:
    """Averages, standard errors and the bounds of timestep and tolerance of every point."""
    for k, (alpha, nu) in enumerate(random_points(points)):
        flow = {
            "restitution": alpha,
            "packing_fraction": nu,
            "grains": grains[nu > (LOOSE[-1] + DENSE[0]) / 2],
        }
        data = jg.ratio_map(
            **flow, timestep=timestep, seeds=1, first_seed=FIRST_SEED + k, workers=1
        )
        yield flow | _row(data)


def _row(data: xr.DataTree) -> dict[str, float]:
    point = flattened(data).squeeze(("restitution", "packing_fraction"))
    row = {"status": int(point.status), "strain": round(data["sums"].strain.item(), 1)}
    for name in OBSERVABLES:
        row |= {name: _short(point[name]), f"{name}_stderr": _short(point[f"{name}_stderr"])}
        for source in ("timestep", "tolerance"):
            row[f"{name}_{source}"] = _short(
                point[f"{name}_large_system_ci95"].sel(error_source=source)
            )
    rate = "stresses/dissipation_rate"
    return row | {
        "dissipation_rate": _short(point[rate]),
        "dissipation_rate_stderr": _short(point[f"{rate}_stderr"]),
    }


def _short(value: xr.DataArray) -> float:
    return float(f"{value.item():.6g}")


PARTS = {
    "random": ("reference_runs", FULL, QUICK, fresh_rows),
    "large": ("reference_runs_large", LARGE, QUICK_LARGE, large_rows),
}
