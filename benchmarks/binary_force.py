"""How much does the force ratio depend on what counts as the binary force?

The same flows, contacts and impulses, divided by four binary sums:

- ``approaching``: (1 + α) μ₁₂ max(0, −u⁻), which is that of ``force_ratio``;
- ``signed``: −(1 + α) μ₁₂ u⁻, so that contacts that recede count with a negative sign;
- ``magnitudes``: (1 + α) μ₁₂ |u⁻|;
- ``half_mean_mass``: as ``approaching``, with half of the mean mass in place of the reduced mass μ₁₂.

    python -m benchmarks binary_force           # half a minute
    python -m benchmarks binary_force --quick   # one flow of 64 grains, ten seconds
"""

import jax
import jax.numpy as jnp

import jaxgran as jg
from benchmarks.output import Output, rounded

FLOWS = ((0.1, 0.8), (0.5, 0.8), (0.9, 0.8))  # restitution, packing fraction
GRAINS, TIMESTEP, STRAIN = 256, 1e-3, 20.0
CHOICES = ("approaching", "signed", "magnitudes", "half_mean_mass")


def sums_of(seen: jg.Snapshot) -> dict[str, jax.Array]:
    """Sums over the contacts of a step: impulses by each choice, alone and times ℓ n_x n_y."""
    contacts, masses = seen.contacts, seen.state.grains.masses
    reduced = 1 / jnp.where(contacts.used, contacts.inverse_mass_i + contacts.inverse_mass_j, 1)
    speed = jnp.where(contacts.used, -(1 + seen.restitution) * contacts.approach, 0)
    impulses = {
        "contact": seen.impulses,
        "approaching": reduced * jnp.maximum(speed, 0),
        "signed": reduced * speed,
        "magnitudes": reduced * jnp.abs(speed),
        "half_mean_mass": jnp.mean(masses) / 2 * jnp.maximum(speed, 0),
    }
    moment = contacts.distances * contacts.normals[:, 0] * contacts.normals[:, 1]
    return {name: jnp.stack([jnp.sum(p), jnp.sum(p * moment)]) for name, p in impulses.items()}


def ratios(sample: jg.Sample) -> list[dict]:
    """Force ratio and shear-stress ratio by each choice, with their standard errors."""
    rows = []
    for name in CHOICES:
        values, errors = sample.observed(lambda mean, name=name: mean["contact"] / mean[name])
        force, shear = zip(values.tolist(), errors.tolist(), strict=True)
        rows.append({"choice": name, "force_ratio": list(force), "shear_stress_ratio": list(shear)})
    return rows


def run(output: Output) -> None:
    """Measure, print and write JSON."""
    flows, grains, strain = (FLOWS[1:2], 64, 4.0) if output.quick else (FLOWS, GRAINS, STRAIN)
    rows = []
    for alpha, nu in flows:
        flow = jg.ShearFlow(grains, alpha, nu, TIMESTEP)
        _, sample = jg.sample(flow, jg.prepare(flow, jax.random.key(0)), strain, observe=sums_of)
        head = {"restitution": alpha, "packing_fraction": nu, "status": jg.Status(int(sample.status)).name}
        rows += [rounded(head | one, 4) for one in ratios(sample)]
        print(*rows[-len(CHOICES) :], sep="\n", flush=True)
    output.write_json("binary_force", {"grains": grains, "timestep": TIMESTEP, "strain": strain, "rows": rows})
