"""Do the flows have the properties that the paper names, and what error has an average over 2000 time steps?

- ``short_averages``: the force ratio over windows of 2000 steps, N = 1000, dt = 1e-5, beside that of all windows.
- ``order``: hexatic order of one instant of each point of the map of ``python -m benchmarks paper``; that of points at
  random; and of flows of equal and of different discs, N = 256, dt = 1e-3, strain 100.
- ``uniformity``: density and velocity in bands along y, and stresses by other forms, over a strain of 500, N = 256,
  dt = 1e-3. The binary stress from the density of approaching pairs at contact and the kinetic stress from the velocity
  distribution, both of snapshots, are beside the sums over all contacts and times of another strain of 500.

All with the midpoint rule.

    python -m benchmarks paper_claims           # 6 minutes on two cores
    python -m benchmarks paper_claims --quick   # 64 grains and short strains, half a minute
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxgran as jg
from benchmarks.output import RESULTS, Output, rounded
from jaxgran.analysis.order import hexatic_order, profiles
from jaxgran.analysis.velocity_correlations import near_contact, velocity_distribution
from jaxgran.dynamics.snapshots import Snapshot
from jaxgran.model.grains import Grains

WINDOW = 2000  # time steps
BANDS = 8
SHORT = ((0.9, 0.6), (0.1, 0.6), (0.5, 0.75), (0.1, 0.75), (0.5, 0.8))  # restitution, packing fraction
UNIFORM = ((0.9, 0.6), (0.5, 0.3), (0.5, 0.6), (0.5, 0.75))
ORDERED = ((0.9, 0.7), (0.9, 0.75), (0.9, 0.8), (0.5, 0.75), (0.5, 0.8))


def run(output: Output) -> None:
    """Measure, print and write JSON."""
    found: dict[str, Any] = {}
    for name, measure in (("order", order), ("uniformity", uniformity), ("short_averages", short_averages)):
        found[name] = rounded(measure(output.quick), 4)
        print(name, *found[name], sep="\n  ", flush=True)
    output.write_json("paper_claims", found)


def prepared(
    flows: tuple[tuple[float, float], ...], grains: int, timestep: float, polydispersity: float = 0.26
) -> tuple[jg.ShearFlow, jg.State]:
    """A batch of steady flows of given restitutions and packing fractions, and their states."""
    alphas, nus = (jnp.array(x) for x in zip(*flows, strict=True))
    flow = jg.ShearFlow(grains, alphas, nus, timestep, polydispersity=polydispersity)
    return flow, jg.prepare(flow, jax.random.split(jax.random.key(0), len(flows)))


# ----------------------------------------------------------------------------------------------- short averages


def short_averages(quick: bool) -> list[dict]:
    """Means and spreads of the force ratio over windows of 2000 steps."""
    grains, timestep, windows = (64, 1e-4, 20) if quick else (1000, 1e-5, 160)
    flow, state = prepared(SHORT, grains, timestep)
    _, samples = jg.sample(flow, state, windows * WINDOW * timestep, blocks=windows)
    return [
        {"restitution": alpha, "packing_fraction": nu, "grains": grains, "timestep": timestep, **spread(samples[k])}
        for k, (alpha, nu) in enumerate(SHORT)
    ]


def spread(sample: jg.Sample) -> dict[str, Any]:
    """The force ratio of a sample with its standard error, and what averages over single blocks are."""
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


# ----------------------------------------------------------------------------------------------- hexatic order


def order(quick: bool) -> list[dict]:
    """Overall and local hexatic order over the map, of points at random, and with and without polydispersity."""
    data = jg.open_map(RESULTS / "paper.nc")
    instants = data["snapshots"].to_dataset()
    rows = []
    for nu in data.packing_fraction.values:
        here = instants.sel(packing_fraction=nu)
        found = [hexatic_order(instant(here.isel(restitution=k))) for k in range(data.sizes["restitution"])]
        rows.append({"packing_fraction": float(nu), "grains": here.sizes["grain"], **ranges(found)})
        if quick:
            break
    rng, grains = np.random.default_rng(0), instants.sizes["grain"]
    at_random = [hexatic_order(snapshot(rng.uniform(0, 30, (grains, 2)), 30.0, 0.0)) for _ in range(10)]
    rows.append({"packing_fraction": None, "points": "at random", "grains": grains, **ranges(at_random)})
    grains, strain, count = (64, 4.0, 4) if quick else (256, 100.0, 50)
    for width in (0.26, 0.0):
        flow, state = prepared(ORDERED, grains, 1e-3, width)
        _, seen = jg.snapshot_series(flow, state, strain, count)
        for k, (alpha, nu) in enumerate(ORDERED):
            found = hexatic_order(seen[k])
            rows.append(
                {
                    "restitution": alpha,
                    "packing_fraction": nu,
                    "polydispersity": width,
                    "grains": grains,
                    "timestep": 1e-3,
                    "strain": strain,
                    "overall": [float(x) for x in found.overall],
                    "local": [float(x) for x in found.local],
                }
            )
    return rows


def instant(point: Any) -> Snapshot:
    """The positions of one point of a map."""
    positions = np.stack([point.x.values, point.y.values], axis=1).astype(float)
    return snapshot(positions, float(point.side), float(point.tilt))


def snapshot(positions: np.ndarray, side: float, tilt: float) -> Snapshot:
    """A snapshot of which only the positions are known."""
    ones = np.ones(len(positions))
    state = jg.State(Grains(ones / 2, ones), positions, 0 * positions, np.float64(side), np.float64(tilt))
    nothing = np.zeros(())
    return Snapshot(state, nothing, nothing, nothing, nothing, nothing, nothing)  # type: ignore[arg-type]


def ranges(found: list) -> dict[str, list[float]]:
    """Smallest, mean and largest order."""
    values = {name: np.array([float(getattr(one, name).value) for one in found]) for name in ("overall", "local")}
    return {name: [x.min(), x.mean(), x.max()] for name, x in values.items()}


# ----------------------------------------------------------------------------------------------- uniformity, forms


def uniformity(quick: bool) -> list[dict]:
    """Deviations of density and velocity in bands, and stresses by two forms each."""
    grains, strain, count = (64, 16.0, 64) if quick else (256, 500.0, 1000)
    flow, state = prepared(UNIFORM, grains, 1e-3)
    state, seen = jg.snapshot_series(flow, state, strain, count)
    _, samples = jg.sample(flow, state, strain, observe=impulses)
    rows = []
    for k, (alpha, nu) in enumerate(UNIFORM):
        bands, sample = profiles(seen[k], BANDS), samples[k]
        density = grains / float(sample.area)
        pairs, velocities = near_contact(seen[k]), velocity_distribution(seen[k])
        mean, error = sample.observed(ratios)
        rows.append(
            {
                "restitution": alpha,
                "packing_fraction": nu,
                "grains": grains,
                "timestep": 1e-3,
                "strain": strain,
                "density": deviation(bands.density.value / density - 1, bands.density.error / density),
                "velocity": deviation(bands.peculiar_velocity.value, bands.peculiar_velocity.error),
                **{
                    f"binary_{name}_from_pairs_over_sum": quotient(
                        sign * np.einsum("ab,ab", weight, pairs.binary_stress.value),
                        np.sqrt(np.einsum("ab,ab", weight**2, pairs.binary_stress.error**2)),
                        getattr(sample, f"binary_{name}"),
                        sample.errors()[f"binary_{name}"],
                    )
                    for name, sign, weight in (
                        ("pressure", 1, np.eye(2) / 2),
                        ("shear_stress", -1, np.array([[0, 0.5], [0.5, 0]])),
                    )
                },
                "kinetic_pressure_from_velocities_over_sum": quotient(
                    density * velocities.temperature.value,
                    density * velocities.temperature.error,
                    sample.kinetic_pressure,
                    sample.errors()["kinetic_pressure"],
                ),
                **{name: [float(mean[name]), float(error[name])] for name in mean},
            }
        )
    return rows


def impulses(seen: Snapshot) -> dict[str, jax.Array]:
    """Contact impulses of a step, and binary ones with the reduced mass and with half of the mean mass."""
    found = seen.contacts
    inverse = jnp.where(found.used, found.inverse_mass_i + found.inverse_mass_j, 1)
    speed = (1 + seen.restitution) * jnp.where(found.used, jnp.maximum(-found.approach, 0), 0)
    half = jnp.mean(seen.state.grains.masses) / 2
    return {"contact": jnp.sum(seen.impulses), "reduced": jnp.sum(speed / inverse), "half": jnp.sum(speed) * half}


def ratios(mean: dict) -> dict[str, Any]:
    """The force ratio with the reduced mass of the pair and with half of the mean mass."""
    return {
        "force_ratio": mean["contact"] / mean["reduced"],
        "force_ratio_with_half_of_the_mean_mass": mean["contact"] / mean["half"],
    }


def deviation(found: np.ndarray, error: np.ndarray) -> dict[str, float]:
    """Root mean square over the bands, that of the standard errors, and χ² over the number of bands."""
    return {
        "rms": float(np.sqrt(np.mean(found**2))),
        "rms_error": float(np.sqrt(np.mean(error**2))),
        "largest": float(np.max(np.abs(found))),
        "chi_square_of_a_band": float(np.mean((found / error) ** 2)),
    }


def quotient(value: Any, error: Any, other: Any, other_error: Any) -> list[float]:
    """A quotient of independent numbers and its standard error."""
    found = value / other
    return [float(found), float(abs(found) * np.hypot(error / value, other_error / other))]
