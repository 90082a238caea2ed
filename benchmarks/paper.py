"""The map of the paper: the force ratio over the plane of restitution and packing fraction, N =
1000, dt = 1e-5.

The same as ``jaxgran map --preset paper``: curves and contours of the ratio, errors of kinetic
theory and their factors, and the dataset with all values.

The paper's binary force has half of the mean mass of two grains in place of their reduced mass.
``--mean-mass`` measures the ratio by both definitions, from the same contacts.

    python -m benchmarks paper                # 20 minutes on two cores
    python -m benchmarks paper --quick        # a plane of 3 × 3 points, 64 grains, dt = 5e-4
    python -m benchmarks paper --mean-mass    # 3 × 3 points, 256 grains, dt = 1e-4, two minutes
"""

import jax
import jax.numpy as jnp
import numpy as np

import jaxgran as jg
from benchmarks.output import Output
from jaxgran.environment import usable_cores
from jaxgran.maps.presets import PRESETS
from jaxgran.maps.results import write_dataset
from jaxgran.plotting.factors import enskog_factors
from jaxgran.plotting.ratio import ratio_contours, ratio_curves
from jaxgran.plotting.theory import theory_errors

QUICK = {"restitution": (0.1, 0.5, 0.9), "packing_fraction": (0.5, 0.7, 0.8)}
QUICK |= {"grains": 64, "seeds": 1, "timestep": 5e-4, "equilibrate": 1.0, "strain": 2.0}
FIGURES = {
    "curves": ratio_curves,
    "contours": ratio_contours,
    "theory": theory_errors,
    "factors": enskog_factors,
}


def run(output: Output, mean_mass: bool = False) -> None:
    """Map, and write the dataset and its main figures; or compare the two definitions."""
    if mean_mass:
        compare_definitions(output)
        return
    data = jg.ratio_map(
        **QUICK if output.quick else PRESETS["paper"], snapshots=True, workers=usable_cores()
    )
    data.attrs |= {"command": "python -m benchmarks paper", "commit": output.hardware["commit"]}
    write_dataset(data, output.path("paper", ".nc"))
    for name, draw in FIGURES.items():
        output.write_picture(draw(data), "paper", f"_{name}.png")


def observe(seen: jg.Snapshot) -> dict[str, jax.Array]:
    """Impulses of a step, and those of binary collisions with half of the mean mass."""
    pair = seen.contacts
    mean_mass = jnp.where(pair.used, (1 / pair.inverse_mass_i + 1 / pair.inverse_mass_j) / 2, 0.0)
    binary = (1 + seen.restitution) * mean_mass / 2 * jnp.maximum(-pair.approach, 0.0)
    return {"impulse": jnp.sum(seen.impulses), "binary_impulse": jnp.sum(binary)}


def compare_definitions(output: Output) -> None:
    """Measure the force ratio by both definitions, and write JSON."""
    jax.config.update("jax_enable_x64", True)
    grains, strain, timestep = (64, 5.0, 1e-3) if output.quick else (256, 40.0, 1e-4)
    plane = np.meshgrid((0.1, 0.5, 0.9), (0.3, 0.7, 0.8))
    flows = jg.ShearFlow(grains, *(x.ravel() for x in plane), timestep)
    states = jg.prepare(flows, jax.random.split(jax.random.key(0), len(flows)))
    _, samples = jg.sample(flows, states, strain, observe=observe)
    rows = []
    for k, (alpha, nu) in enumerate(zip(*(x.ravel().tolist() for x in plane), strict=True)):
        ratio, error = samples[k].observed(lambda mean: mean["impulse"] / mean["binary_impulse"])
        own = float(samples[k].force_ratio), float(samples[k].errors()["force_ratio"])
        row = {"alpha": alpha, "nu": nu, "reduced_mass": own}
        rows.append(row | {"mean_mass": (float(ratio), float(error))})
        print(rows[-1])
    head = {"grains": grains, "strain": strain, "timestep": timestep}
    output.write_json("paper_mean_mass", head | {"rows": rows})
