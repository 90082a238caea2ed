"""Fresh flows at random points of the reference map, which its intervals are judged on.

40 points, uniform in ln(1 − α) and ν over the range of the map; N = 6400 up to ν = 0.71 and 2500
above, dt = 1e-4, one run per point sampled over six correlation strains. Nothing is fitted to them.

    python -m benchmarks reference_runs           # 20 minutes on one core
    python -m benchmarks reference_runs --quick   # 3 points of 64 grains, dt = 1e-3, under a minute
"""

import time
from collections.abc import Iterator

import numpy as np
import xarray as xr

import jaxgran as jg
from benchmarks.output import Output
from benchmarks.reference_map import DENSE, LOOSE, RESTITUTIONS
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


def run(output: Output) -> None:
    """Run the flows, print each, and write ``reference_runs`` as JSON."""
    plan, start = QUICK if output.quick else FULL, time.perf_counter()
    rows = []
    for row in fresh_rows(**plan):
        rows.append(row)
        print(
            f"{len(rows)} of {plan['points']}: {row}, {time.perf_counter() - start:.0f} s",
            flush=True,
        )
    head = {**plan, "first_seed": FIRST_SEED, "seconds": round(time.perf_counter() - start)}
    output.write_rows("reference_runs", head, "rows", rows)


def random_points(count: int) -> Iterator[tuple[float, float]]:
    """Random restitutions and packing fractions in the range of the reference map."""
    rng, nus = np.random.default_rng(38), (LOOSE[0], DENSE[-1])
    for _ in range(count):
        alpha = 1 - np.exp(rng.uniform(*np.log(1 - np.array(RESTITUTIONS)[[-1, 0]])))
        yield round(float(alpha), 4), round(float(rng.uniform(*nus)), 4)


def fresh_rows(points: int, grains: list[int], timestep: float) -> Iterator[dict]:
    """Averages, standard errors and the bounds of timestep and tolerance of every point."""
    for k, (alpha, nu) in enumerate(random_points(points)):
        one = {
            "restitution": alpha,
            "packing_fraction": nu,
            "grains": grains[nu > (LOOSE[-1] + DENSE[0]) / 2],
        }
        data = jg.ratio_map(**one, timestep=timestep, seeds=1, first_seed=FIRST_SEED + k, workers=1)
        yield one | _row(data)


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
