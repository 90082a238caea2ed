"""Do the flows have the properties that the paper names, and what error has an average over 2000
time steps?

- ``short_averages``: the force ratio over windows of 2000 steps, N = 1000, dt = 1e-5, beside that
  of all windows.
- ``order``: hexatic order, by freud, of one instant of each point of the map of ``python -m
  benchmarks paper``; that of points at random; and of flows of equal and of different discs, N =
  256, dt = 1e-3, strain 100.

All with the midpoint rule.

    python -m benchmarks paper_claims           # 3 minutes on two cores
    python -m benchmarks paper_claims --quick   # 64 grains and short strains, half a minute
"""

from typing import Any

import freud
import jax
import jax.numpy as jnp
import numpy as np

import jaxgran as jg
from benchmarks.output import RESULTS, Output, rounded
from jaxgran.analysis.series import Measured, with_errors

WINDOW = 2000  # time steps
SHORT = (
    (0.9, 0.6),
    (0.1, 0.6),
    (0.5, 0.75),
    (0.1, 0.75),
    (0.5, 0.8),
)  # restitution, packing fraction
ORDERED = ((0.9, 0.7), (0.9, 0.75), (0.9, 0.8), (0.5, 0.75), (0.5, 0.8))


def run(output: Output) -> None:
    """Measure, print and write JSON."""
    result: dict[str, Any] = {}
    for name, measure in (("order", order), ("short_averages", short_averages)):
        result[name] = rounded(measure(output.quick), 4)
        print(name, *result[name], sep="\n  ", flush=True)
    output.write_json("paper_claims", result)


def prepared(
    flows: tuple[tuple[float, float], ...],
    grains: int,
    timestep: float,
    polydispersity: float = 0.26,
) -> tuple[jg.ShearFlow, jg.State]:
    """A batch of steady flows of given restitutions and packing fractions, and their states."""
    alphas, nus = (jnp.array(x) for x in zip(*flows, strict=True))
    flow = jg.ShearFlow(grains, alphas, nus, timestep, polydispersity=polydispersity)
    return flow, jg.prepare(flow, jax.random.split(jax.random.key(0), len(flows)))


# -----------------------------------------------------------------------------------------------
# short averages


def short_averages(quick: bool) -> list[dict]:
    """Means and spreads of the force ratio over windows of 2000 steps."""
    grains, timestep, windows = (64, 1e-4, 20) if quick else (1000, 1e-5, 160)
    flow, state = prepared(SHORT, grains, timestep)
    _, samples = jg.sample(flow, state, windows * WINDOW * timestep, blocks=windows)
    return [
        {
            "restitution": alpha,
            "packing_fraction": nu,
            "grains": grains,
            "timestep": timestep,
            **spread(samples[k]),
        }
        for k, (alpha, nu) in enumerate(SHORT)
    ]


def spread(sample: jg.Sample) -> dict[str, Any]:
    """The force ratio of a sample with its standard error, and what averages over single blocks
    are.
    """
    impulse, binary = (np.asarray(x) for x in (sample.tally.impulse, sample.tally.binary_impulse))
    ratios = impulse[binary > 0] / binary[binary > 0]
    low, high = np.quantile(ratios, (0.025, 0.975))
    return {
        "force_ratio": [float(sample.force_ratio), float(sample.errors()["force_ratio"])],
        "windows": ratios.size,
        "mean_of_windows": float(ratios.mean()),
        "standard_deviation_of_a_window": float(ratios.std(ddof=1)),
        "middle_95_percent_of_windows": [float(low), float(high)],
        "collisions_of_a_window": float(np.mean(np.asarray(sample.tally.collisions))),
    }


# -----------------------------------------------------------------------------------------------
# hexatic order


def order(quick: bool) -> list[dict]:
    """Overall and local hexatic order over the map, of points at random, and with and without
    polydispersity.
    """
    data = jg.open_map(RESULTS / "paper.nc")
    instants = data["states"].to_dataset()
    rows = []
    for nu in data.packing_fraction.values:
        instants_here = instants.sel(packing_fraction=nu)
        orders = [
            hexatic(*instant(instants_here.isel(restitution=k)))
            for k in range(data.sizes["restitution"])
        ]
        rows.append(
            {
                "packing_fraction": float(nu),
                "grains": instants_here.sizes["grain"],
                **ranges(orders),
            }
        )
        if quick:
            break
    rng, grains = np.random.default_rng(0), instants.sizes["grain"]
    at_random = [hexatic(rng.uniform(0, 30, (grains, 2)), 30.0, 0.0) for _ in range(10)]
    rows.append(
        {"packing_fraction": None, "points": "at random", "grains": grains, **ranges(at_random)}
    )
    grains, strain, count = (64, 4.0, 4) if quick else (256, 100.0, 50)
    for width in (0.26, 0.0):
        flow, state = prepared(ORDERED, grains, 1e-3, width)
        _, seen = jg.snapshot_series(flow, state, strain, count)
        for k, (alpha, nu) in enumerate(ORDERED):
            orders = hexatic_order(seen.state[k])
            rows.append(
                {
                    "restitution": alpha,
                    "packing_fraction": nu,
                    "polydispersity": width,
                    "grains": grains,
                    "timestep": 1e-3,
                    "strain": strain,
                    "overall": [float(x) for x in orders["overall"]],
                    "local": [float(x) for x in orders["local"]],
                }
            )
    return rows


def instant(point: Any) -> tuple[np.ndarray, float, float]:
    """Positions, side and tilt of one point of a map."""
    return point.positions.values, float(point.side), float(point.tilt)


def hexatic(positions: np.ndarray, side: float, tilt: float) -> tuple[float, float]:
    """Overall |⟨ψ₆⟩| and local ⟨|ψ₆|⟩; ψ₆ of a grain is the mean of exp(6iθ) over its Voronoi
    neighbours.
    """
    cell = freud.box.Box(side, side, xy=tilt, is2D=True), np.pad(positions, ((0, 0), (0, 1)))
    cell = cell[0], cell[0].wrap(cell[1])
    neighbours = freud.locality.Voronoi().compute(cell).nlist
    psi = freud.order.Hexatic(k=6).compute(cell, neighbors=neighbours).particle_order
    return float(np.abs(psi.mean())), float(np.abs(psi).mean())


def hexatic_order(states: jg.State) -> dict[str, Measured]:
    """``hexatic`` of a series of states, with standard errors."""
    orders = np.array(
        [hexatic(*state) for state in zip(states.positions, states.side, states.tilt, strict=True)]
    )
    sums = {"overall": orders[:, 0], "local": orders[:, 1], "times": np.ones(len(orders))}
    return with_errors(
        lambda s: {name: s[name] / s["times"] for name in ("overall", "local")}, sums
    )


def ranges(orders: list[tuple[float, float]]) -> dict[str, list[float]]:
    """Smallest, mean and largest order."""
    values = dict(zip(("overall", "local"), np.array(orders).T, strict=True))
    return {name: [x.min(), x.mean(), x.max()] for name, x in values.items()}
