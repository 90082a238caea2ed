"""What the number of grains does to stresses and temperatures, from 64 grains to 25,600.

Twelve flows at dt = 1e-3 / shear rate, midpoint rule. For each the study measures, against N:
stresses, granular temperature and local granular temperature, with errors; how long the flow
remembers its temperature; how the kinetic energy and the density divide over wavelengths; and the
energy of the mean velocity profile along the velocity gradient.

Before its sample a flow is sheared over ``PREPARED`` memories, and the sample lasts ``SAMPLED``
memories. The memory is max(nT/τ, 0.35 L √(ρ/p)), with the values of the next smaller N.

    python -m benchmarks size_study          # 20 minutes on two cores
    python -m benchmarks size_study --quick  # two flows of 64 and 256 grains, a minute
"""

import time
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import jax
import numpy as np

import jaxgran as jg
from benchmarks.cores import on_all_cores
from benchmarks.output import Output, rounded
from benchmarks.size_figures import draw_sizes, draw_waves
from jaxgran.dynamics.velocity_scales import WAVES
from jaxgran.sampling.correlation_strain import flow_correlation_strain
from jaxgran.sampling.sample import correlation_strains, estimates

TIMESTEP, BLOCKS = 1e-3, 64
PREPARED, SAMPLED = 3.0, 6.0  # memories of the flow
LEAST_STRAIN = 5.0  # of a sample, and of its preparation
WAVE_BINS = np.logspace(-2, 0.5, 31)  # wave numbers, in 1/σ
PROFILE_BINS = 40
AVERAGES = "pressure", "shear_stress", "granular_temperature", "local_granular_temperature"


class Plan(NamedTuple):
    """Restitution and packing fraction of the flows, their largest N, and N with the number of
    seeds.
    """

    flows: tuple[tuple[float, float, int], ...]
    seeds: dict[int, int]


FULL = Plan(
    (
        *((0.1, 0.3, 25_600), (0.2, 0.2, 25_600), (0.2, 0.6, 25_600), (0.5, 0.6, 25_600)),
        *((0.8, 0.2, 25_600), (0.8, 0.6, 25_600), (0.95, 0.1, 25_600), (0.95, 0.6, 25_600)),
        *((0.2, 0.8, 6400), (0.8, 0.82, 6400), (0.2, 0.75, 6400), (0.5, 0.75, 6400)),
    ),
    {64: 16, 100: 16, 400: 8, 1600: 4, 6400: 2, 25_600: 1},
)
QUICK = Plan(((0.5, 0.6, 256), (0.8, 0.2, 256)), {64: 2, 256: 1})


def run(output: Output) -> None:
    """Measure all flows, and write ``size_study`` as JSON, and figures of values and waves."""
    plan = QUICK if output.quick else FULL
    kept = output.unfinished("size_study")
    flows = on_all_cores(partial(rows_of_flow, plan), plan.flows, lambda flow: flow[2], kept)
    rows = [row for some in flows for row in some]
    head = {"sampled_memories": SAMPLED, "blocks": BLOCKS, "timestep": TIMESTEP}
    output.write_json("size_study", head | {"flows": rows})
    output.write_picture(draw_sizes(rows), "size_study")
    output.write_picture(draw_waves(rows), "size_study", "_waves.png")


def rows_of_flow(plan: Plan, flow: tuple[float, float, int]) -> list[dict]:
    """Values with standard errors and the structure of the states of a flow, a row for each N."""
    alpha, nu, most = flow
    rows, memory = [], 20.0 if nu < 0.7 else 5.0
    for grains in (n for n in plan.seeds if n <= most):
        begin, setting = time.perf_counter(), jg.ShearFlow(grains, alpha, nu, TIMESTEP)
        before, strain = (max(x * memory, LEAST_STRAIN) for x in (PREPARED, SAMPLED))
        first_seed = 100 * plan.flows.index(flow)
        samples, states = zip(
            *(
                one_seed(setting, before, strain, first_seed + seed)
                for seed in range(plan.seeds[grains])
            ),
            strict=True,
        )
        structures = {name: np.stack([x[name] for x in states]) for name in states[0]}
        values, errors = estimates(samples)
        area = samples[0].area
        correlation = correlation_strains(samples)["granular_temperature"]
        row = {"restitution": alpha, "packing_fraction": nu, "grains": grains}
        row |= {"seeds": len(samples), "before": before, "strain": strain}
        rows.append(
            row
            | {
                "seconds": time.perf_counter() - begin,
                "memory": memory_of(values, nu, grains, area),
                "correlation_granular_temperature": float(correlation),
                **{name: [float(values[name]), float(errors[name])] for name in AVERAGES},
                "structure_factor": float(structures["longest_waves"].mean()),
                "profile_temperature": profile_temperature(structures["profile"], grains),
            }
        )
        if grains == most:
            rows[-1]["spectrum"] = spectrum(structures, samples, grains)
        else:
            print(rows[-1], flush=True)
            larger = min(n for n in plan.seeds if n > grains)
            means = {name: np.mean([x.averages[name] for x in samples]) for name in AVERAGES}
            memory = memory_of(means, nu, larger, larger / grains * area)
    return rows


def memory_of(averages: Mapping[str, np.ndarray], nu: float, grains: int, area: float) -> float:
    """Strain that a flow of discs of mass d² remembers; their mass is 4/π of the area that they
    fill.
    """
    return float(flow_correlation_strain(averages, grains, 4 / np.pi * nu * area, area, 1.0))


def one_seed(
    flow: jg.ShearFlow, before: float, strain: float, seed: int
) -> tuple[jg.Sample, dict[str, np.ndarray]]:
    """Prepare and sample one flow: its sample, and the structure of the state after each block."""
    state = jg.prepare(flow, jax.random.key(seed), equilibrate=before)
    blocks, structures = [], []
    for _ in range(BLOCKS):
        state, block = jg.sample(flow, state, strain / BLOCKS, blocks=1)
        blocks.append(jax.tree.map(np.asarray, block))
        structures.append(structure(state))
    tally = jax.tree.map(lambda *x: np.concatenate(x), *(block.tally for block in blocks))
    return replace(blocks[0], tally=tally), {
        name: np.stack([x[name] for x in structures]) for name in structures[0]
    }


def structure(state: jg.State) -> dict[str, np.ndarray]:
    """Velocity and density of one instant by wave number, and a profile along y.

    =============  =========  ======================================================================
    name           shape      meaning
    =============  =========  ======================================================================
    waves          (bins,)    number of waves in each bin of wave number
    transverse     (bins,)    sum of their granular temperatures, of the velocity across the wave
                              vector
    density        (bins,)    sum of their structure factors
    longest_waves  (4,)       structure factors |Σ e^{ikr}|²/N of the longest waves
    profile        (2, bins)  mass and momentum along x of the grains in equal layers of y
    =============  =========  ======================================================================
    """
    positions, velocities = np.asarray(state.positions), np.asarray(state.velocities)
    masses, side, tilt = np.asarray(state.grains.masses), float(state.side), float(state.tilt)
    count, mass = len(masses), masses.sum()
    row = positions[:, 1] / side % 1
    inside = np.stack([(positions[:, 0] / side - tilt * row) % 1, row], axis=1)
    across = max(4, round(side / 2))
    cells = np.ravel_multi_index(
        tuple(np.minimum(inside * across, across - 1).astype(int).T), (across, across)
    )
    momenta = masses[:, None] * velocities
    jx, jy, density = (
        np.fft.fft2(np.bincount(cells, weights, across**2).reshape(across, across))
        for weights in (momenta[:, 0], momenta[:, 1], np.ones(count))
    )
    numbers = np.fft.fftfreq(across, 1 / across)
    kx = 2 * np.pi / side * np.broadcast_to(numbers[:, None], jx.shape)
    ky = 2 * np.pi / side * (numbers[None, :] - tilt * numbers[:, None])
    k = np.hypot(kx, ky)
    k[0, 0] = 1e-30  # no wave, and in no bin
    bins = np.digitize(k.ravel(), WAVE_BINS) - 1
    keep = (bins >= 0) & (bins < len(WAVE_BINS) - 1)
    parts = {
        "waves": np.ones(k.shape),
        "transverse": np.abs((kx * jy - ky * jx) / k) ** 2 / mass,
        "density": np.abs(density) ** 2 / count,
    }
    binned = {
        name: np.bincount(bins[keep], part.ravel()[keep], len(WAVE_BINS) - 1)
        for name, part in parts.items()
    }
    longest = np.exp(-2j * np.pi * np.asarray(WAVES) @ inside.T).sum(axis=1) / count**0.5
    layer = np.minimum(row * PROFILE_BINS, PROFILE_BINS - 1).astype(int)
    profile = [np.bincount(layer, x, PROFILE_BINS) for x in (masses, momenta[:, 0])]
    return binned | {"longest_waves": np.abs(longest) ** 2, "profile": np.stack(profile)}


def profile_temperature(profiles: np.ndarray, grains: int) -> float:
    """Granular temperature of the mean profile of c_x along y, over the whole sample; profiles
    (seeds, blocks, 2, bins).
    """
    mass, momentum = np.moveaxis(profiles.mean(axis=1), 1, 0)
    return float((np.sum(momentum**2 / mass, axis=-1) / (2 * grains)).mean())


def spectrum(
    structures: dict[str, np.ndarray], samples: tuple[jg.Sample, ...], grains: int
) -> dict[str, list[float]]:
    """Energy of a wave of the velocity across its wave vector over equipartition, and structure
    factor, by wave number.

    Bins without a wave are left out.
    """
    waves = structures["waves"].mean(axis=(0, 1))
    present = waves > 0
    moment, duration = (
        np.stack([getattr(sample.tally, name) for sample in samples]).sum(axis=(0, 1))
        for name in ("kinetic_moment", "duration")
    )
    temperature = moment.trace() / 2 / duration / grains
    transverse, density = (
        structures[name].mean(axis=(0, 1))[present] / waves[present]
        for name in ("transverse", "density")
    )
    middle = np.sqrt(WAVE_BINS[1:] * WAVE_BINS[:-1])[present]
    series = {"wave_number": middle, "transverse": transverse / temperature, "density": density}
    return {name: rounded(values.tolist(), 4) for name, values in series.items()}
