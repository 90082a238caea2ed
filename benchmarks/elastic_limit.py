"""Kinetic theory in loose and nearly elastic flow, where its assumptions hold, against the number
of grains.

Averages over those of moments of an anisotropic Gaussian. What remains at vanishing packing
fraction is the error of the Gaussian: its viscosity is 2.2 % below Enskog's (D. M. Gass, J. Chem.
Phys. 54, 1898, 1971). What grows with the number of grains is the share of long waves of velocity.
A flow is prepared until steady and sampled over a strain of 20,000/√N.

    python -m benchmarks elastic_limit           # about 15 minutes on two cores
    python -m benchmarks elastic_limit --quick   # one flow of 100 and 400 grains, half a minute
"""

from itertools import product
from typing import NamedTuple

import numpy as np

import jaxgran as jg
from benchmarks.output import Output, rounded
from jaxgran.environment import usable_cores
from jaxgran.maps.schema import flattened

AVERAGES = {
    "pressure": "theory/pressure",
    "shear_stress": "theory/shear_stress",
    "local_granular_temperature": "theory/granular_temperature",
}
TIMESTEP = 3e-5  # no deep overlaps at any point


class Plan(NamedTuple):
    """Restitutions, packing fractions, numbers of grains, seeds, and strain times √N."""

    restitutions: tuple[float, ...]
    packing_fractions: tuple[float, ...]
    grains: tuple[int, ...]
    seeds: int
    strain: float


FULL = Plan((0.98, 0.9), (0.02, 0.1, 0.3), (400, 1600, 6400, 25_600), 4, 20_000)
QUICK = Plan((0.98,), (0.1,), (100, 400), 2, 2_000)


def run(output: Output) -> None:
    """Measure all flows, print a line for each, and write JSON."""
    plan = QUICK if output.quick else FULL
    rows = []
    for grains in plan.grains:
        rows += rows_of_size(plan, grains)
        output.write_rows("elastic_limit", plan._asdict() | {"timestep": TIMESTEP}, "rows", rows)


def rows_of_size(plan: Plan, grains: int) -> list[dict]:
    """A row for each flow of so many grains: status, and averages over theory less one with their
    standard errors.
    """
    measured = jg.ratio_map(
        restitution=plan.restitutions,
        packing_fraction=plan.packing_fractions,
        grains=grains,
        timestep=TIMESTEP,
        seeds=plan.seeds,
        workers=usable_cores(),
        strain=plan.strain / np.sqrt(grains),
    )
    data, rows = flattened(measured), []
    for alpha, nu in product(plan.restitutions, plan.packing_fractions):
        point = data.sel(restitution=alpha, packing_fraction=nu)
        row = {
            "alpha": alpha,
            "nu": nu,
            "grains": grains,
            "status": jg.Status(int(point.status)).name,
        }
        for name, theory in AVERAGES.items():
            over_theory = point[name] / point[theory] - 1, point[f"{name}_stderr"] / point[theory]
            row[name] = rounded([float(x) for x in over_theory], 4)
        print(", ".join(f"{name} {value}" for name, value in row.items()), flush=True)
        rows.append(row)
    return rows
