"""Flows near the dense limit: friction and pressure against the inertial number.

The map is that of ``jaxgran map --preset dense``; ``dense_limit`` fits its points.

    python -m benchmarks dense_rheology            # about ten minutes on two cores
    python -m benchmarks dense_rheology --quick    # 64 grains, a short strain, a minute
"""

from typing import Any

import xarray as xr

import jaxgran as jg
from benchmarks.output import Output
from jaxgran.environment import usable_cores
from jaxgran.maps.presets import PRESETS

FULL = PRESETS["dense"]
QUICK = FULL | {
    "packing_fraction": (0.77, 0.78, 0.79, 0.8, 0.81),
    "grains": 64,
    "timestep": 5e-4,
    "strain": 4.0,
}


def run(output: Output) -> None:
    """Map, print the points, and write them."""
    plan = QUICK if output.quick else FULL
    data = jg.ratio_map(**plan, workers=usable_cores())
    points = [
        point(data, nu, alpha)
        for nu in data.packing_fraction.values
        for alpha in data.restitution.values
    ]
    print(*points, sep="\n")
    output.write_rows("dense_rheology", {"plan": plan}, "points", points)


def point(data: xr.Dataset, nu: float, alpha: float) -> dict[str, Any]:
    """The averages of one point of the map, with errors."""
    one = data.sel(packing_fraction=nu, restitution=alpha)
    names = (
        "inertial_number",
        "macroscopic_friction",
        "pressure",
        "granular_temperature",
        "force_ratio",
    )
    values = {
        key: float(f"{float(one[key]):.5g}") for name in names for key in (name, f"{name}_stderr")
    }
    return {
        "packing_fraction": float(nu),
        "restitution": float(alpha),
        **values,
        "status": int(one.status),
    }
