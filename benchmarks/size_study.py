"""What the number of grains does to stresses, temperature and force ratio, from 64 grains to
25,600.

Twelve flows at dt = 1e-3 / shear rate, midpoint rule. For each the study measures, against N:
stresses, granular temperature, local granular temperature, force ratio and collision rate, with
errors; how the kinetic energy divides over wavelengths; the structure factor and the scatter of the
density at long wavelengths; how long the flow remembers; and, in the largest flow, profiles along
the velocity gradient.

Before its sample a flow is sheared over ``PREPARED`` memories, and the sample lasts ``SAMPLED``
memories. The memory is max(nT/τ, 0.35 L √(ρ/p)), with the values of the next smaller N. Every flow
that is done is kept in a folder, so a study that was stopped goes on where it was.

    python -m benchmarks size_study          # 20 minutes on two cores
    python -m benchmarks size_study --quick  # two flows of 64 and 256 grains, a minute
"""

import multiprocessing
import time
from collections.abc import Mapping
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

import jaxgran as jg
from benchmarks import ROOT
from benchmarks.output import Output, rounded
from benchmarks.size_figures import draw_sizes, draw_waves
from jaxgran.dynamics.tally import TABLE, Tally
from jaxgran.dynamics.velocity_scales import BOX_GRAINS, WAVES, boxes_across
from jaxgran.environment import usable_cores
from jaxgran.sampling.correlation_strain import flow_correlation_strain
from jaxgran.sampling.sample import Sample, correlation_strains, estimates

BLOCKS = 64
PREPARED, SAMPLED = 3.0, 6.0  # memories of the flow
LEAST_STRAIN = 5.0  # of a sample, and of its preparation
KEPT = ROOT / "benchmarks" / "results" / ".size_study"  # the flows that are done
WAVE_BINS = np.logspace(-2, 0.5, 31)  # wave numbers, in 1/σ
PROFILE_BINS = 40


class Plan(NamedTuple):
    """Restitution and packing fraction of the flows, their largest N, and N with the number of
    seeds.
    """

    flows: tuple[tuple[float, float, int], ...]
    seeds: dict[int, int]


FULL = Plan(
    (
        (0.1, 0.3, 25_600),
        (0.2, 0.2, 25_600),
        (0.2, 0.6, 25_600),
        (0.5, 0.6, 25_600),
        (0.8, 0.2, 25_600),
        (0.8, 0.6, 25_600),
        (0.95, 0.1, 25_600),
        (0.95, 0.6, 25_600),
        (0.2, 0.8, 6400),
        (0.8, 0.82, 6400),
        (0.2, 0.75, 6400),
        (0.5, 0.75, 6400),
    ),
    {64: 16, 100: 16, 400: 8, 1600: 4, 6400: 2, 25_600: 1},
)
QUICK = Plan(((0.5, 0.6, 256), (0.8, 0.2, 256)), {64: 2, 256: 1})


def flow_of_size(alpha: float, nu: float, grains: int) -> jg.ShearFlow:
    """The flow at one number of grains."""
    return jg.ShearFlow(grains=grains, restitution=alpha, packing_fraction=nu, timestep=1e-3)


def measured_flow(plan: Plan, flow: int, grains: int, folder: Path) -> tuple[int, int]:
    """Measure one flow with all its seeds and keep the result in the folder; returns the number of
    the flow and N.
    """
    alpha, nu, _ = plan.flows[flow]
    start = time.perf_counter()
    memory = expected_memory(plan, flow, grains, folder)
    before, strain = max(PREPARED * memory, LEAST_STRAIN), max(SAMPLED * memory, LEAST_STRAIN)
    setting = flow_of_size(alpha, nu, grains)
    seeds = [
        one_seed(setting, before, strain, 100 * flow + seed) for seed in range(plan.seeds[grains])
    ]
    arrays = {name: np.stack([seed[name] for seed in seeds]) for name in seeds[0]}
    numbers = {
        "memory": memory,
        "before": before,
        "strain": strain,
        "seconds": time.perf_counter() - start,
    }
    folder.mkdir(parents=True, exist_ok=True)
    unfinished = kept_file(folder, alpha, nu, grains).with_suffix(".part")
    with unfinished.open("wb") as file:
        np.savez(file, **numbers, **arrays)
    unfinished.replace(kept_file(folder, alpha, nu, grains))
    return flow, grains


def one_seed(flow: jg.ShearFlow, before: float, strain: float, seed: int) -> dict[str, np.ndarray]:
    """Prepare and sample one flow: the sums of its blocks, and the structure of the state after
    each block.
    """
    state = jg.prepare(flow, jax.random.key(seed), equilibrate=before)
    tallies, structures = [], []
    for _ in range(BLOCKS):
        state, sample = jg.sample(flow, state, strain / BLOCKS, blocks=1)
        tallies.append(jax.tree.map(lambda x: np.asarray(x[0]), sample.tally))
        structures.append(structure(state))
    sums = {
        f"tally_{name}": np.stack([getattr(block, name) for block in tallies]) for name in TABLE
    }
    structure_of_blocks = {
        name: np.stack([block[name] for block in structures]) for name in structures[0]
    }
    return {"area": np.asarray(state.side) ** 2, **sums, **structure_of_blocks}


def structure(state: jg.State) -> dict[str, np.ndarray]:
    """Velocity and density of one instant by wave number, the amplitudes of the longest waves, and
    profiles along y.

    ==========  ============  ======================================================================
    name        shape         meaning
    ==========  ============  ======================================================================
    waves       (bins,)       number of waves in each bin of wave number
    transverse  (bins,)       sum of their granular temperatures, of the velocity across the wave
                              vector
    along       (bins,)       the same for the velocity along the wave vector
    density     (bins,)       sum of their structure factors
    amplitudes  (4, 3)        Σ m c_x e^{ikr}, Σ m c_y e^{ikr} and Σ e^{ikr} of the longest waves,
                              over √(Σ m), √N
    scatter     ()            variance over mean of the number of grains in boxes of about 25
    profile     (4, bins)     number, mass, momentum along x and Σ m c² of the grains in equal
                              layers of y
    ==========  ============  ======================================================================
    """
    positions, velocities = np.asarray(state.positions), np.asarray(state.velocities)
    masses, side, tilt = np.asarray(state.grains.masses), float(state.side), float(state.tilt)
    count = len(masses)
    row = positions[:, 1] / side % 1
    inside = np.stack([(positions[:, 0] / side - tilt * row) % 1, row], axis=1)

    across = max(4, round(side / 2))
    cells = np.ravel_multi_index(
        tuple(np.minimum(inside * across, across - 1).astype(int).T), (across, across)
    )

    def transformed(weights: np.ndarray) -> np.ndarray:
        return np.fft.fft2(np.bincount(cells, weights, across**2).reshape(across, across))

    momenta = masses[:, None] * velocities
    jx, jy, density = (
        transformed(momenta[:, 0]),
        transformed(momenta[:, 1]),
        transformed(np.ones(count)),
    )
    numbers = np.fft.fftfreq(across, 1 / across)
    kx = 2 * np.pi / side * np.broadcast_to(numbers[:, None], jx.shape)
    ky = 2 * np.pi / side * (numbers[None, :] - tilt * numbers[:, None])
    k = np.hypot(kx, ky)
    k[0, 0] = 1e-30  # no wave, and in no bin
    bins = np.digitize(k.ravel(), WAVE_BINS) - 1
    keep = (bins >= 0) & (bins < len(WAVE_BINS) - 1)
    mass = masses.sum()
    parts = {
        "waves": np.ones(k.shape),
        "transverse": np.abs((kx * jy - ky * jx) / k) ** 2 / mass,
        "along": np.abs((kx * jx + ky * jy) / k) ** 2 / mass,
        "density": np.abs(density) ** 2 / count,
    }
    binned = {
        name: np.bincount(bins[keep], part.ravel()[keep], len(WAVE_BINS) - 1)
        for name, part in parts.items()
    }

    phases = np.exp(-2j * np.pi * np.asarray(WAVES) @ inside.T)
    amplitudes = np.stack(
        [
            phases @ momenta[:, 0] / mass**0.5,
            phases @ momenta[:, 1] / mass**0.5,
            phases.sum(axis=1) / count**0.5,
        ],
        1,
    )
    boxes = boxes_across(count)
    place = np.minimum(inside * boxes, boxes - 1).astype(int)
    number = np.bincount(place[:, 0] * boxes + place[:, 1], minlength=boxes**2)
    layer = np.minimum(row * PROFILE_BINS, PROFILE_BINS - 1).astype(int)
    energy = masses * np.sum(velocities**2, axis=1)
    profile = [
        np.bincount(layer, x, PROFILE_BINS) for x in (np.ones(count), masses, momenta[:, 0], energy)
    ]
    return {
        **binned,
        "amplitudes": amplitudes,
        "scatter": number.var() / number.mean(),
        "profile": np.stack(profile),
    }


def expected_memory(plan: Plan, flow: int, grains: int, folder: Path) -> float:
    """Strain that a flow remembers, from the values of the next smaller N that is done, or of
    kinetic theory.
    """
    alpha, nu, _ = plan.flows[flow]
    smaller = [n for n in plan.seeds if n < grains and kept_file(folder, alpha, nu, n).exists()]
    if not smaller:
        return 20.0 if nu < 0.7 else 5.0
    row = read_flow(folder, alpha, nu, max(smaller))
    batch = sample_of(row, flow_of_size(alpha, nu, max(smaller)))
    means = {name: np.mean(x, axis=0) for name, x in batch.averages.items()}
    larger = grains / max(smaller)
    return memory_of(means, nu, grains, larger * row["area"][0])


def memory_of(averages: Mapping[str, np.ndarray], nu: float, grains: int, area: float) -> float:
    """Strain that a flow of discs of mass d² remembers; their mass is 4/π of the area that they
    fill.
    """
    return float(flow_correlation_strain(averages, grains, 4 / np.pi * nu * area, area, 1.0))


def kept_file(folder: Path, alpha: float, nu: float, grains: int) -> Path:
    """Where a flow that is done is kept."""
    return folder / f"{alpha:g}_{nu:g}_{grains}.npz"


def read_flow(folder: Path, alpha: float, nu: float, grains: int) -> dict[str, np.ndarray]:
    """A flow that is done: arrays (seeds, blocks, ...) and numbers."""
    with np.load(kept_file(folder, alpha, nu, grains)) as file:
        return dict(file)


def sample_of(row: dict[str, np.ndarray], flow: jg.ShearFlow) -> Sample:
    """The seeds of a flow that is done as a batch of samples."""
    tally = Tally(**{name: row[f"tally_{name}"] for name in TABLE})
    area = row["area"]
    numbers = jax.tree.map(lambda x: np.full(len(area), x), flow)
    return Sample(tally, area, 4 / np.pi * flow.packing_fraction * area, numbers)


def measure(plan: Plan, folder: Path) -> None:
    """Measure all flows that are not yet done, the smaller N of a flow first, on all cores."""
    sizes = {k: [n for n in plan.seeds if n <= most] for k, (_, _, most) in enumerate(plan.flows)}
    left = {
        k: [n for n in ns if not kept_file(folder, *plan.flows[k][:2], n).exists()]
        for k, ns in sizes.items()
    }
    total = sum(map(len, left.values()))
    with ProcessPoolExecutor(usable_cores(), multiprocessing.get_context("spawn")) as pool:
        running: set = set()
        busy: set[int] = set()
        done = 0
        while done < total:
            free = sorted((ns[0], k) for k, ns in left.items() if ns and k not in busy)
            for grains, k in free[: usable_cores() - len(running)]:
                running.add(pool.submit(measured_flow, plan, k, grains, folder))
                busy.add(k)
                left[k].pop(0)
            finished, running = wait(running, return_when=FIRST_COMPLETED)
            for future in finished:
                k, grains = future.result()
                busy.discard(k)
                done += 1
                seconds = float(read_flow(folder, *plan.flows[k][:2], grains)["seconds"])
                alpha, nu, _ = plan.flows[k]
                print(
                    f"{done} of {total}: restitution {alpha:g}, packing fraction {nu:g}, {grains} "
                    f"grains, {seconds:.0f} s",
                    flush=True,
                )


RESULTS = (
    "pressure",
    "shear_stress",
    "granular_temperature",
    "local_granular_temperature",
    "longwave_energy_ratio",
    "force_ratio",
    "collision_rate",
    "macroscopic_friction",
)
SERIES = (
    "granular_temperature",
    "pressure",
    "shear_stress",
)  # whose correlation is compared with the memory


def result(plan: Plan, flow: int, grains: int, folder: Path) -> dict:
    """The row of one flow and N: values with standard errors, memory, and what the structure of its
    states says.
    """
    alpha, nu, _ = plan.flows[flow]
    row = read_flow(folder, alpha, nu, grains)
    batch = sample_of(row, flow_of_size(alpha, nu, grains))
    seeds = [jax.tree.map(lambda x, k=k: x[k], batch) for k in range(len(row["area"]))]
    values, errors = estimates(seeds)
    measured = {
        f"correlation_{name}": float(x)
        for name, x in correlation_strains(seeds).items()
        if name in SERIES
    }
    number = {"restitution": alpha, "packing_fraction": nu, "grains": grains, "seeds": len(seeds)}
    numbers = {name: float(row[name]) for name in ("before", "strain", "seconds")}
    averages = {name: [float(values[name]), float(errors[name])] for name in RESULTS}
    return {
        **number,
        **numbers,
        "memory": memory_of(values, nu, grains, row["area"][0]),
        **measured,
        **averages,
        **structure_result(row, grains),
    }


def structure_result(row: dict[str, np.ndarray], grains: int) -> dict[str, float]:
    """What the states of a flow say of long waves of density and velocity.

    ==================  ============================================================================
    name                meaning
    ==================  ============================================================================
    structure_factor    mean structure factor of the four longest waves
    scatter             variance over mean of the number of grains in boxes of about 25
    wave_temperature    granular temperature that stands in waves longer than the boxes
    profile_temperature granular temperature of the mean profile of c_x along y, over the whole
                        sample
    lasting_velocity    share of the energy of the longest wave along y that has a constant phase,
                        for c_x
    lasting_density     the same for the density
    ==================  ============================================================================
    """
    amplitudes = row["amplitudes"]  # (seeds, blocks, waves, 3)
    along_y = amplitudes[:, :, 1]
    lasting = np.abs(along_y.mean(axis=1)) ** 2 / np.mean(
        np.abs(along_y) ** 2, axis=1
    )  # (seeds, 3)
    box = np.sqrt(BOX_GRAINS * row["area"][0] / grains)
    longer = WAVE_BINS[1:] < 2 * np.pi / box
    waves = (row["transverse"] + row["along"]).mean(axis=(0, 1))
    _, mass, momentum, _ = np.moveaxis(row["profile"].mean(axis=1), 1, 0)  # (seeds, bins) each
    profile = np.sum(momentum**2 / mass, axis=-1) / (2 * grains)
    return {
        "structure_factor": float(np.mean(np.abs(amplitudes[..., 2]) ** 2)),
        "scatter": float(row["scatter"].mean()),
        "wave_temperature": float(waves[longer].sum() / (2 * grains)),
        "profile_temperature": float(profile.mean()),
        "lasting_velocity": float(lasting[:, 0].mean()),
        "lasting_density": float(lasting[:, 2].mean()),
    }


def spectrum(row: dict[str, np.ndarray], grains: int) -> dict[str, list[float]]:
    """Energy of a wave of the velocity across its wave vector over equipartition, and structure
    factor, by wave number.

    Bins without a wave are left out.
    """
    waves = row["waves"].mean(axis=(0, 1))
    present = waves > 0
    temperature = (
        row["tally_kinetic_moment"].sum(axis=(0, 1)).trace()
        / 2
        / row["tally_duration"].sum()
        / grains
    )
    transverse, density = (
        row[name].mean(axis=(0, 1))[present] / waves[present] for name in ("transverse", "density")
    )
    middle = np.sqrt(WAVE_BINS[1:] * WAVE_BINS[:-1])[present]
    series = {"wave_number": middle, "transverse": transverse / temperature, "density": density}
    return {name: rounded(values.tolist(), 4) for name, values in series.items()}


def run(output: Output, folder: Path = KEPT) -> None:
    """Measure what is not yet done, and write ``size_study`` as JSON, and figures of values and
    waves.
    """
    plan = QUICK if output.quick else FULL
    folder = folder.with_name(f"{folder.name}_quick") if output.quick else folder
    measure(plan, folder)
    done = [(k, n) for k, (_, _, most) in enumerate(plan.flows) for n in plan.seeds if n <= most]
    rows = [result(plan, k, n, folder) for k, n in done]
    for (k, n), row in zip(done, rows, strict=True):
        if n == dict(done)[k]:  # the last one of a flow is its largest
            row["spectrum"] = spectrum(read_flow(folder, *plan.flows[k][:2], n), n)
    print_table(rows)
    head = {
        "prepared_memories": PREPARED,
        "sampled_memories": SAMPLED,
        "blocks": BLOCKS,
        "timestep": 1e-3,
    }
    output.write_rows("size_study", head, "flows", rows)
    output.write_picture(draw_sizes(rows), "size_study")
    output.write_picture(draw_waves(rows), "size_study", "_waves.png")


def print_table(rows: list[dict]) -> None:
    """Values with standard errors, a line for each flow and N."""
    names = (
        "pressure",
        "shear_stress",
        "granular_temperature",
        "local_granular_temperature",
        "force_ratio",
    )
    print("    α     ν       N  memory  " + "  ".join(f"{name[:18]:>18}" for name in names))
    for row in rows:
        cells = "  ".join(f"{row[name][0]:9.4g} ± {row[name][1]:6.2g}" for name in names)
        print(
            f"{row['restitution']:5g} {row['packing_fraction']:5g} {row['grains']:7d} "
            f"{row['memory']:7.2f}  {cells}"
        )
