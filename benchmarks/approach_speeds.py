"""How fast do grains approach when they collide, and is that the speed of grains whose velocities are independent?

A collision of the relative normal velocity g and reduced mass μ has the speed x = g √(μ/T_l), with the local granular
temperature T_l. In a gas in equilibrium the collisions have the density x exp(−x²/2), for any sizes. Divided by x and
multiplied by the collision rate over that of equilibrium, the density of collisions becomes that of approaching pairs
at contact, in equilibrium exp(−x²/2). The shape ⟨x³⟩⟨x⟩/⟨x²⟩² of the collisions is 3π/8 = 1.178 where pairs have a
Gaussian density and 4/3 where it is exponential, and hardly depends on the slowest collisions; as the exponent β it is
that of a density exp(−(x/a)^β) with this shape. The collisional temperature is ⟨μg²⟩/2. Γ is ½(1 − α²) ⟨μg²⟩ times the
collisions per area and time. Beside each number stands that of independent Gaussian velocities with the measured
temperature tensor scaled to T_l, the shear across the contact included.

Every collision of a sample counts: N = 1000, midpoint rule, dt = 1e-5, two seeds of a strain of 20; where grains are
very dissipative, dt = 1e-4 before.

    python -m benchmarks approach_speeds           # 10 minutes on two cores
    python -m benchmarks approach_speeds --quick   # 100 grains, three flows, half a minute
"""

import multiprocessing
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from itertools import product
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure
from scipy.integrate import simpson
from scipy.optimize import brentq
from scipy.special import erf, gamma

import jaxgran as jg
from benchmarks.output import Output, rounded
from jaxgran.environment import usable_cores
from jaxgran.plotting.drawing import LABEL_SIZE, SMALL_SIZE, TICK_SIZE, curve_styles
from jaxgran.sampling.sample import Sample
from jaxgran.statistics import standard_errors
from jaxgran.theory.mixture import uniform_mixture

EDGES = np.geomspace(1e-4, 1e2, 241)  # of the bins of g √μ, in γ̇σ√m; slower and faster ones are in the outer bins
POWERS = np.arange(4)  # of the sums over the collisions
SPEEDS = ((0.05, 0.15), (0.4, 0.6), (0.9, 1.1), (1.8, 2.2), (3.5, 4.5))  # x between which pairs are counted
SLOW = 0.5  # x below which a collision counts as slow
RELAXATION = 0.5  # strain between two time steps
ANGLES = 64  # directions of contacts, on the circle
GRID = np.linspace(0, 12, 1201)  # x where the theory is integrated

Sums = dict[str, Any]


class Plan(NamedTuple):
    """Packing fractions, restitutions, number of grains, seeds, strain of a sample, and time steps, the coarse one
    only up to a restitution."""

    packing_fractions: tuple[float, ...]
    restitutions: tuple[float, ...]
    grains: int
    seeds: int
    strain: float
    timestep: float
    coarse_timestep: float
    coarse_up_to: float

    def timesteps(self, alpha: float) -> tuple[float, ...]:
        """Time steps at a restitution, the longest first."""
        return (self.coarse_timestep, self.timestep) if alpha <= self.coarse_up_to else (self.timestep,)


FULL = Plan((0.6, 0.2), (0.98, 0.9, 0.7, 0.5, 0.3, 0.1), 1000, 2, 20.0, 1e-5, 1e-4, 0.3)
QUICK = Plan((0.6,), (0.98, 0.5, 0.1), 100, 2, 16.0, 1e-4, 1e-3, 0.1)


def run(output: Output) -> None:
    """Sample the flows on all cores, print a line for each, and write JSON and PNG."""
    plan = QUICK if output.quick else FULL
    flows = list(product(plan.packing_fractions, plan.restitutions))
    tasks = [(*flow, seed) for flow in flows for seed in range(plan.seeds)]
    with ProcessPoolExecutor(usable_cores(), multiprocessing.get_context("spawn")) as pool:
        found = pool.map(partial(samples, plan), tasks)
        rows = []
        for nu, alpha in flows:
            seeds = [next(found) for _ in range(plan.seeds)]
            for timestep, at_timestep in zip(plan.timesteps(alpha), zip(*seeds, strict=True), strict=True):
                rows.append(row(nu, alpha, timestep, list(at_timestep)))
                numbers = (f"{key} {value}" for key, value in rows[-1].items() if not key.startswith("density"))
                print(", ".join(numbers), flush=True)
    output.write_rows("approach_speeds", {"plan": plan._asdict(), "x": midpoints().tolist()}, "rows", rows)
    output.write_picture(draw(plan, rows), "approach_speeds", dpi=200)


def observe(seen: jg.Snapshot) -> Sums:
    """The collisions of a step by g √μ, the sums of its powers, and second and fourth moments of √m c_y."""
    found = seen.contacts
    inverse = jnp.where(found.used, found.inverse_mass_i + found.inverse_mass_j, 1)
    speed = jnp.where(found.used, jnp.maximum(-found.approach, 0), 0) / jnp.sqrt(inverse)
    collides = (speed > 0).astype(speed.dtype)
    per_decade = (EDGES.size - 1) / np.log10(EDGES[-1] / EDGES[0])
    place = jnp.floor((jnp.log10(jnp.where(speed > 0, speed, 1)) - np.log10(EDGES[0])) * per_decade)
    place = jnp.clip(place, 0, EDGES.size - 2).astype(int)
    square = seen.state.grains.masses * seen.state.velocities[:, 1] ** 2
    return {
        "histogram": jnp.zeros(EDGES.size - 1, speed.dtype).at[place].add(collides),
        "powers": jnp.stack([jnp.sum(collides * speed**k) for k in POWERS.tolist()]),
        "velocities": jnp.stack([jnp.mean(square), jnp.mean(square**2)]),
    }


def samples(plan: Plan, task: tuple[float, float, int]) -> list[Sample]:
    """One seed of one flow: a sample at each time step, the longest first."""
    nu, alpha, seed = task
    flows = [jg.ShearFlow(plan.grains, alpha, nu, timestep) for timestep in plan.timesteps(alpha)]
    state = jg.prepare(flows[0], jax.random.key(seed))
    found = []
    for k, flow in enumerate(flows):
        if k:
            state, _ = jg.advance(flow, state, jnp.int32(round(RELAXATION / flow.timestep)))
        state, sample = jg.sample(flow, state, plan.strain, observe=observe)
        found.append(jax.tree.map(np.asarray, sample))
    return found


def row(nu: float, alpha: float, timestep: float, seeds: list[Sample]) -> dict:
    """Numbers of a flow as [value, standard error], those of independent velocities, and both densities by bin."""
    sums = sums_of(seeds)
    local = np.sum(sums["local_kinetic"]) / np.sum(sums["duration"])
    scale = np.sqrt(local)
    still = independent(local * np.eye(2), nu, shear_rate=0.0)["powers"][0]
    known = partial(estimate, alpha, seeds[0].grains, float(seeds[0].area))
    value, error = standard_errors(lambda s: known(s) | by_speed(float(seeds[0].area), scale, still, s), sums)
    tensor = value.pop("tensor")
    theory = independent(tensor, nu)
    powers = theory["powers"] / theory["powers"][0]
    numbers = {name: [x.tolist(), error[name].tolist()] for name, x in value.items() if name != "density"}
    rate, temperature = (numbers[name][0] for name in ("collisions", "collisional_temperature"))
    shape = numbers["shape"]
    exponents = [exponent(shape[0] + shift * shape[1]) for shift in (0, -1, 1)]
    density, density_error = (x["density"] * scale for x in (value, error))
    pairs = rate / still * density * scale / midpoints()
    return {
        "packing_fraction": nu,
        "restitution": alpha,
        "timestep": timestep,
        "status": jg.Status(max(int(seed.status) for seed in seeds)).name,
        **rounded(numbers, 5),
        "exponent": rounded([exponents[0], abs(exponents[1] - exponents[2]) / 2], 4),
        **rounded(
            {
                "collisions_over_independent": float(rate / theory["powers"][0]),
                "collisional_temperature_over_independent": float(temperature / (powers[2] / 2)),
                "pairs_independent_over_equilibrium": pairs_of_theory(theory, still),
                "shape_independent": float(powers[3] * powers[1] / powers[2] ** 2),
                "exponent_independent": exponent(float(powers[3] * powers[1] / powers[2] ** 2)),
                "density": density.tolist(),
                "density_error": density_error.tolist(),
                "density_of_pairs": pairs.tolist(),
                "scale": float(scale),
            },
            4,
        ),
    }


def sums_of(seeds: list[Sample]) -> Sums:
    """What is summed over each block of each seed, (seeds, blocks, ...)."""
    parts = [
        {
            **seed.observed_sums,
            "steps": seed.tally.steps,
            "duration": seed.tally.duration,
            "local_kinetic": seed.tally.local_kinetic,
            "kinetic_moment": seed.tally.kinetic_moment,
        }
        for seed in seeds
    ]
    return jax.tree.map(lambda *x: np.stack([np.asarray(one) for one in x]), *parts)


def estimate(alpha: float, grains: int, area: float, sums: Sums) -> Sums:
    """Averages of sums with any leading axes; collisions per area and time."""
    count, speed, square, cube = np.moveaxis(sums["powers"], -1, 0)
    duration = sums["duration"]
    local = sums["local_kinetic"] / duration
    tensor = sums["kinetic_moment"] / (grains * duration[..., None, None])
    granular = np.trace(tensor, axis1=-2, axis2=-1) / 2
    temperature = square / count / 2
    second, fourth = np.moveaxis(sums["velocities"] / sums["steps"][..., None], -1, 0)
    return {
        "collisions": count / (area * duration),
        "granular_temperature": granular,
        "local_temperature": local,
        "collisional_temperature": temperature,
        "collisional_over_local": temperature / local,
        "collisional_over_granular": temperature / granular,
        "shape": cube * speed / square**2,
        "dissipation_rate": (1 - alpha**2) / 2 * square / (area * duration),
        "binned_over_summed_energy": sums["histogram"] @ midpoints() ** 2 / square,
        "velocity_kurtosis": fourth / second**2,
        "tensor": tensor * (local / granular)[..., None, None],
        "density": sums["histogram"] / (count[..., None] * np.diff(EDGES)),
    }


def by_speed(area: float, scale: float, still: float, sums: Sums) -> Sums:
    """Pairs at contact over those of equilibrium in ``SPEEDS``, and shares of slow collisions; ``scale`` is √T_l.

    ``still`` are the collisions of equilibrium per area and time. Sums have any leading axes.
    """
    x, edges = midpoints() / scale, EDGES / scale
    pairs = sums["histogram"] / x / (area * sums["duration"][..., None])
    at_rest = still * np.sqrt(np.pi / 2) * np.diff(erf(edges / np.sqrt(2)))
    energy = sums["histogram"] * x**2
    here = [(x > low) & (x < high) for low, high in SPEEDS]
    return {
        "pairs_over_equilibrium": np.stack([pairs[..., k].sum(-1) / at_rest[k].sum() for k in here], axis=-1),
        "slow_share_of_collisions": sums["histogram"][..., x < SLOW].sum(-1) / sums["histogram"].sum(-1),
        "slow_share_of_energy": energy[..., x < SLOW].sum(-1) / energy.sum(-1),
    }


def independent(tensor: np.ndarray, nu: float, shear_rate: float = 1.0, polydispersity: float = 0.26) -> Sums:
    """Collisions of independent Gaussian velocities of a temperature tensor in mσ²/t², by Enskog's theory.

    Returns:
      ``powers``: collisions per area and time, and the sums of (g √μ)^k over them, k up to 3; ``x`` and ``density``:
      g √(μ/T) with T half of the trace, and the density of the collisions there.
    """
    mixture = jax.tree.map(np.asarray, uniform_mixture(jnp.asarray(nu), jnp.asarray(polydispersity), 4))
    angle = 2 * np.pi * (np.arange(ANGLES) + 0.5) / ANGLES
    n = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    root = np.sqrt(mixture.reduced_masses)[..., None]
    temperature = np.trace(tensor) / 2
    spread = np.sqrt(np.einsum("ka,ab,kb->k", n, tensor, n) / temperature)
    shift = -shear_rate * mixture.contact_diameters[..., None] * n[:, 0] * n[:, 1] * root / np.sqrt(temperature)
    pairs = mixture.number_densities[:, None] * mixture.encounters / 2 * (2 * np.pi / ANGLES)
    weight = pairs[..., None] / root * np.sqrt(temperature)
    z = (GRID - shift[..., None]) / spread[:, None]
    flux = GRID * np.einsum("ijk,ijkx->x", weight, np.exp(-(z**2) / 2) / (np.sqrt(2 * np.pi) * spread[:, None]))
    powers = simpson(flux * GRID ** POWERS[:, None], GRID) * temperature ** (POWERS / 2)
    return {"powers": powers, "x": GRID, "density": flux / powers[0]}


def pairs_of_theory(theory: Sums, still: float) -> list[float]:
    """The result of ``independent`` as pairs at contact over those of equilibrium in ``SPEEDS``, see ``by_speed``."""
    x = theory["x"]
    here = [(x > low) & (x < high) for low, high in SPEEDS]
    rate = theory["powers"][0] / still
    return [float(rate * np.sum(theory["density"][k] / x[k]) / np.sum(np.exp(-(x[k] ** 2) / 2))) for k in here]


def exponent(shape: float) -> float:
    """β of a density of pairs exp(−(x/a)^β) whose collisions have a shape ⟨x³⟩⟨x⟩/⟨x²⟩²: 2 Gaussian, 1 exponential."""

    def difference(beta: float) -> float:
        return gamma(5 / beta) * gamma(3 / beta) / gamma(4 / beta) ** 2 - shape

    return float(brentq(difference, 0.2, 50))


def midpoints() -> np.ndarray:
    """Geometric midpoints of the bins of g √μ."""
    return np.sqrt(EDGES[1:] * EDGES[:-1])


def draw(plan: Plan, rows: list[dict]) -> Figure:
    """Densities of collisions and of approaching pairs, a row of panels for each packing fraction, shortest step."""
    across = len(plan.packing_fractions)
    figure = Figure(figsize=(6.7, 2.6 * across), layout="constrained")
    panels = figure.subplots(across, 2, squeeze=False, sharex=True)
    x = np.linspace(0, 6, 200)
    shortest = [one for one in rows if one["timestep"] == plan.timestep]
    for (left, right), nu in zip(panels, plan.packing_fractions, strict=True):
        left.plot(x, x * np.exp(-(x**2) / 2), "k--", linewidth=0.8, label="equilibrium")
        right.plot(x, np.exp(-(x**2) / 2), "k--", linewidth=0.8)
        here = [one for one in shortest if one["packing_fraction"] == nu]
        for one, style in zip(here, curve_styles(len(here)), strict=True):
            at = midpoints() / one["scale"]
            density, error = np.array(one["density"]), np.array(one["density_error"])
            known = (density > 3 * error) & (at > 0.03) & (at < 6)
            look = {**style, "markersize": 2.5, "linewidth": 0.9, "markevery": 4}
            left.plot(at[known], density[known], **look, label=rf"$\alpha$ = {one['restitution']:g}")
            right.plot(at[known], np.array(one["density_of_pairs"])[known], **look)
        left.set_ylabel(r"collisions $P(x)$", fontsize=LABEL_SIZE)
        right.set_ylabel("pairs at contact", fontsize=LABEL_SIZE)
        left.set(yscale="log", ylim=(1e-4, 4), xlim=(0, 6))
        right.set(yscale="log", ylim=(1e-4, 200))
        for axes in (left, right):
            axes.tick_params(labelsize=TICK_SIZE)
            axes.set_title(rf"$\nu$ = {nu:g}", fontsize=LABEL_SIZE, loc="right")
    panels[0, 0].legend(fontsize=SMALL_SIZE, frameon=False, loc="upper right", ncols=2)
    for axes in panels[-1]:
        axes.set_xlabel(r"speed of approach $x = g\,\sqrt{\mu/T_\mathrm{l}}$", fontsize=LABEL_SIZE)
    return figure
