"""The dense limit: friction and packing fraction against the inertial number, and the exponents at the onset of flow.

The map is that of ``jaxgran map --preset dense``. Beside it runs the bidisperse mixture of the literature, half of the
grains 1.4 times as large as the other half. Each is fitted by μ(I) = μ₀ + a I^b and ν(I) = ν_c − k I^c. Since I goes as
1/√p, the pressure diverges as p ∼ (ν_c − ν)^−β with β = 2/c. The fits are repeated without the loosest flows: where the
parameters still move, the flows are not close enough to the limit for the power laws alone.

    python -m benchmarks dense_rheology            # about 20 minutes on two cores
    python -m benchmarks dense_rheology --quick    # 64 grains, a short strain, three minutes
"""

import multiprocessing
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from typing import Any

import jax
import numpy as np
import xarray as xr

import jaxgran as jg
from benchmarks.output import Output
from jaxgran.environment import usable_cores
from jaxgran.inference.friction_law import CORRELATION, FrictionLaw, PowerLaw
from jaxgran.maps.presets import PRESETS
from jaxgran.sampling.sample import error_correlation_of, estimates

FULL = PRESETS["dense"]
QUICK = FULL | {"packing_fraction": (0.77, 0.78, 0.79, 0.8, 0.81), "grains": 64, "timestep": 5e-4, "strain": 4.0}
SIZE_RATIO = 1.4  # of the two sizes of the mixture
MIXTURE_RESTITUTION = 0.2
PREPARED = 10.0  # strain before the sample of the mixture, ten memories and more
LOOSEST = (0.0, 0.8, 0.81)  # smallest packing fraction of a fit
PUBLISHED = {
    "beta": "5.0 +- 0.4, bidisperse 1:1.4: D. Vagberg, P. Olsson and S. Teitel, Phys. Rev. E 93, 052902 (2016)",
    "critical_packing_fraction": "0.8435, bidisperse 1:1.4: P. Olsson and S. Teitel, Phys. Rev. E 83, 030302 (2011)",
    "friction": "about 0.10, spheres: P.-E. Peyneau and J.-N. Roux, Phys. Rev. E 78, 011307 (2008)",
}


def run(output: Output) -> None:
    """Map, fit, print the table of exponents, and write it."""
    plan = QUICK if output.quick else FULL
    data = jg.ratio_map(**plan, workers=usable_cores())
    rows = []
    for mixture, flows in (("uniform", data), ("bidisperse", bidisperse(plan, data))):
        for least in LOOSEST:
            chosen = flows.sel(packing_fraction=flows.packing_fraction >= least)
            if chosen.sizes["packing_fraction"] > 3:
                rows += table(mixture, jg.friction_law(chosen))
    for row in rows:
        print(", ".join(f"{name} {value}" for name, value in row.items()))
    points = [point(data, nu, alpha) for nu in data.packing_fraction.values for alpha in data.restitution.values]
    head = {"plan": plan, "size_ratio": SIZE_RATIO, "published": PUBLISHED, "points": points}
    output.write_rows("dense_rheology", head, "rows", rows)


def bidisperse(plan: Mapping[str, Any], like: xr.Dataset) -> xr.Dataset:
    """What a friction law needs, measured in the mixture of two sizes at one restitution, in the form of a map."""
    tasks = [(dict(plan), nu, seed) for nu in reversed(plan["packing_fraction"]) for seed in range(plan["seeds"])]
    with ProcessPoolExecutor(usable_cores(), multiprocessing.get_context("spawn")) as pool:
        samples = list(pool.map(mixture_sample, *zip(*tasks, strict=True)))
    names = ("inertial_number", "macroscopic_friction", "pressure", "force_ratio")
    found: dict[str, list] = {name: [] for name in (*names, *(f"{name}_stderr" for name in names), CORRELATION)}
    starts = range(0, len(samples), plan["seeds"])
    for start in starts:
        seeds = samples[start : start + plan["seeds"]]
        values, errors = estimates(seeds)
        for name in names:
            found[name].append(float(values[name]))
            found[f"{name}_stderr"].append(float(errors[name]))
        found[CORRELATION].append(error_correlation_of(seeds, "macroscopic_friction", "inertial_number"))
    dims = ("packing_fraction", "restitution")
    found["status"] = [max(int(one.status) for one in samples[k : k + plan["seeds"]]) for k in starts]
    variables = {name: (dims, np.array(series)[::-1, None]) for name, series in found.items()}
    coordinates = {"packing_fraction": list(plan["packing_fraction"]), "restitution": [MIXTURE_RESTITUTION]}
    made = xr.Dataset(variables, coordinates, {**like.attrs, "restitution": MIXTURE_RESTITUTION})
    made.status.attrs = like.status.attrs
    return made


def mixture_sample(plan: Mapping[str, Any], nu: float, seed: int) -> jg.Sample:
    """One sample of the mixture."""
    jax.config.update("jax_enable_x64", True)
    flow = jg.ShearFlow(plan["grains"], MIXTURE_RESTITUTION, nu, plan["timestep"])
    grains = jg.own_grains(np.where(np.arange(plan["grains"]) % 2, SIZE_RATIO, 1.0))
    state = jg.prepare(flow, jax.random.key(seed), equilibrate=PREPARED, grains=grains)
    _, sample = jg.sample(flow, state, plan["strain"])
    return jax.tree.map(np.asarray, sample)


def table(mixture: str, law: FrictionLaw) -> list[dict[str, Any]]:
    """Parameters of the laws of all restitutions together and of each, a row for each fit."""
    rows = []
    for alpha, one in {"all": law, **law.by_restitution}.items():
        fraction, friction = one.packing_fraction, one.friction
        exponent, error = parameter(fraction, 2)
        rows.append(
            {
                "mixture": mixture,
                "restitution": alpha,
                "largest_inertial_number": round(fraction.span[1], 4),
                "points": fraction.points,
                **named("critical_packing_fraction", parameter(fraction, 0), 5),
                **named("c", (exponent, error), 4),
                **named("beta", (2 / exponent, 2 * error / exponent**2), 3),
                **named("friction_at_onset", parameter(friction, 0), 4),
                **named("b", parameter(friction, 2), 4),
                "chi_squared": [round(float(fraction.chi_squared), 2), round(float(friction.chi_squared), 2)],
            }
        )
    return rows


def parameter(law: PowerLaw, k: int) -> tuple[float, float]:
    return float(law.parameters[k]), float(law.standard_errors[k])


def named(name: str, pair: tuple[float, float], digits: int) -> dict[str, float]:
    value, error = (round(x, digits) if np.isfinite(x) else float("nan") for x in pair)
    return {name: value, f"{name}_stderr": error}


def point(data: xr.Dataset, nu: float, alpha: float) -> dict[str, Any]:
    """The averages of one point of the map, with errors."""
    one = data.sel(packing_fraction=nu, restitution=alpha)
    names = ("inertial_number", "macroscopic_friction", "pressure", "granular_temperature", "force_ratio")
    values = {key: float(f"{float(one[key]):.5g}") for name in names for key in (name, f"{name}_stderr")}
    return {"packing_fraction": float(nu), "restitution": float(alpha), **values, "status": int(one.status)}
