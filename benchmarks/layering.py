"""Do sheared flows separate into layers along y, where continuum mechanics with the measured stresses says so?

Let pressure and shear stress at a packing fraction ν and a local shear rate be those of steady shear, p = f(ν) γ̇² and
τ = μ(ν) p: the temperature follows the shear rate at once. In a weak wave of density along y of long wavelength the
pressure stays uniform, and the balances of mass and momentum give its growth rate

    s = k² p μ′ / [ρ γ̇ (1/ν + ½ (ln p)′)],        k = 2π/L, ρ = 4ν/π, ′ = d/dν.

So a flow would form layers wherever its friction grows with the packing fraction. The slopes are those of the map of
``python -m benchmarks paper``, between the packing fractions on either side. Four flows in which the friction grows are
followed for so long that a growing wave would exceed its first amplitude by orders of magnitude: dt = 1e-3, midpoint
rule, the amplitude of the gravest wave S = |Σ exp(2πi y/L)|²/N taken every 5 strains.

    python -m benchmarks layering           # 1600 and 6400 grains, strains of 10,000 and 2000
    python -m benchmarks layering --quick   # 100 grains, a strain of 200
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from matplotlib.figure import Figure

import jaxgran as jg
from benchmarks.output import RESULTS, Output
from jaxgran.plotting.drawing import curve_styles
from jaxgran.statistics import drift

FLOWS = ((0.1, 0.3), (0.2, 0.4), (0.5, 0.3), (0.7, 0.5))  # restitution, packing fraction
INTERVAL = 5.0  # strain between two amplitudes
PREPARED = 100.0  # strain before the first one
BINS = 40  # of the strain, in the figure and the result


class Slopes(NamedTuple):
    """What the growth rate follows from, at every point of a map (packing fraction, restitution)."""

    friction: np.ndarray  # dμ/dν
    friction_error: np.ndarray
    rate: np.ndarray  # s/(k²σ²γ̇)
    rate_error: np.ndarray


def slopes(data: xr.Dataset) -> Slopes:
    """Slopes of friction and pressure by differences between neighbouring packing fractions, with standard errors."""
    data = data.transpose("packing_fraction", "restitution", ...)
    nu = data.packing_fraction.values
    column = nu[:, None]
    difference = np.gradient(np.eye(len(nu)), nu, axis=0)  # (derivative at, value at)
    pressure, friction = data.pressure.values, data.macroscopic_friction.values
    slope = difference @ friction
    slope_error = np.sqrt(difference**2 @ data.macroscopic_friction_stderr.values**2)
    log_error = np.sqrt(difference**2 @ (data.pressure_stderr.values / pressure) ** 2)
    resistance = 4 / np.pi * column * (1 / column + difference @ np.log(pressure) / 2)
    rate = pressure * slope / resistance
    relative = np.hypot(slope_error / slope, 4 / np.pi * column * log_error / 2 / resistance)
    return Slopes(slope, slope_error, rate, np.abs(rate) * relative)


def followed(grains: int, strain: float) -> tuple[jg.ShearFlow, np.ndarray, np.ndarray, np.ndarray]:
    """The flows, their sides, the complex amplitudes of the gravest wave along y (times, flows), and the statuses."""
    alphas, nus = np.array(FLOWS).T
    flows = jg.ShearFlow(grains, jnp.asarray(alphas), jnp.asarray(nus), 1e-3)
    states = jg.prepare(flows, jax.random.split(jax.random.key(grains), len(FLOWS)), equilibrate=PREPARED)
    amplitudes, worst = [], np.zeros(len(FLOWS), int)
    for done in range(round(strain / INTERVAL)):
        states, samples = jg.sample(flows, states, INTERVAL, blocks=1)
        heights = np.asarray(states.positions)[..., 1] / np.asarray(states.side)[:, None]
        amplitudes.append(np.exp(2j * np.pi * heights).sum(axis=1) / np.sqrt(grains))
        worst = np.maximum(worst, np.asarray(samples.status))
        if done % 100 == 99:
            print(f"N = {grains}: strain {(done + 1) * INTERVAL:g} of {strain:g}", flush=True)
    return flows, np.asarray(states.side), np.array(amplitudes), worst


def decay_strain(amplitude: np.ndarray) -> float:
    """Strain at which the correlation of a complex amplitude with itself has fallen to 1/e; NaN if it has not."""
    lags = np.arange(len(amplitude) // 4)
    products = [np.mean(amplitude[lag:] * amplitude[: len(amplitude) - lag].conj()).real for lag in lags]
    below = np.flatnonzero(np.array(products) < products[0] / np.e)
    if not below.size:
        return float("nan")
    high, low = products[below[0] - 1], products[below[0]]
    return float(INTERVAL * (below[0] - (products[0] / np.e - low) / (high - low)))


def rows_of(grains: int, strain: float, data: xr.Dataset) -> list[dict]:
    """A row for each flow: the growth that is predicted, and both halves of the amplitudes that were measured."""
    rates = slopes(data)
    _, sides, amplitudes, statuses = followed(grains, strain)
    rows = []
    for k, (alpha, nu) in enumerate(FLOWS):
        at = (
            int(np.argmin(np.abs(data.packing_fraction.values - nu))),
            int(np.argmin(np.abs(data.restitution.values - alpha))),
        )
        squared_wave_number = (2 * np.pi / sides[k]) ** 2
        power = np.abs(amplitudes[:, k]) ** 2
        change, error = drift(power)
        bins = [float(f"{part.mean():.4g}") for part in np.array_split(power, BINS)]
        found = {
            "friction_slope": [rates.friction[at], rates.friction_error[at]],
            "predicted_growth_rate": [x * squared_wave_number for x in (rates.rate[at], rates.rate_error[at])],
            "predicted_e_folds": [x * squared_wave_number * strain for x in (rates.rate[at], rates.rate_error[at])],
            "first_half": [power[: len(power) // 2].mean()],
            "change_in_second_half": [change, error],
            "decay_strain": [decay_strain(amplitudes[:, k])],
        }
        rows.append(
            {
                "restitution": alpha,
                "packing_fraction": nu,
                "grains": grains,
                "strain": strain,
                "status": jg.Status(int(statuses[k])).name,
                **{name: [float(f"{x:.4g}") for x in pair] for name, pair in found.items()},
                "structure_factor": bins,
            }
        )
    return rows


def run(output: Output) -> None:
    """Follow the flows, print a line for each, and write JSON and PNG."""
    data = jg.open_map(RESULTS / "paper.nc").to_dataset()
    plan = ((100, 200.0),) if output.quick else ((1600, 10_000.0), (6400, 2000.0))
    rows = [row for grains, strain in plan for row in rows_of(grains, strain, data)]
    for row in rows:
        print(", ".join(f"{name} {value}" for name, value in row.items() if name != "structure_factor"))
    output.write_rows("layering", {"interval": INTERVAL, "prepared": PREPARED, "timestep": 1e-3}, "rows", rows)
    output.write_picture(draw(rows, data), "layering", dpi=200)


def draw(rows: list[dict], data: xr.Dataset) -> Figure:
    """Where friction grows with packing fraction, and the amplitude of the gravest wave beside the growth predicted."""
    figure = Figure(figsize=(6.7, 3.0), layout="constrained")
    plane, course = figure.subplots(1, 2, width_ratios=(1, 1.35))
    slope = slopes(data)
    nu, distance = data.packing_fraction.values, 1 - data.restitution.values
    limit = 1.0
    drawn = plane.pcolormesh(distance, nu, slope.friction, cmap="RdBu_r", vmin=-limit, vmax=limit, shading="nearest")
    bar = figure.colorbar(drawn, ax=plane, extend="both")
    bar.set_label(r"$\mathrm{d}\mu/\mathrm{d}\nu$", fontsize=8)
    bar.ax.tick_params(labelsize=7)
    plane.contour(distance, nu, slope.friction, levels=[0], colors="black", linewidths=1.2)
    plane.set_xlabel(r"$1-\alpha$", fontsize=8)
    plane.set_ylabel(r"packing fraction $\nu$", fontsize=8)
    grains = rows[0]["grains"]
    for style, row in zip(curve_styles(len(FLOWS)), (row for row in rows if row["grains"] == grains), strict=True):
        alpha, fraction = row["restitution"], row["packing_fraction"]
        plane.plot(1 - alpha, fraction, color="black", marker=style["marker"], markersize=6, markerfacecolor="white")
        power = np.array(row["structure_factor"])
        strain = (np.arange(power.size) + 0.5) * row["strain"] / power.size
        label = rf"$\alpha={alpha:g},\ \nu={fraction:g}$"
        course.plot(strain, power, **{**style, "markersize": 3, "linewidth": 1}, label=label)
        grown = power[0] * np.exp(2 * row["predicted_growth_rate"][0] * (strain - strain[0]))
        shown = grown < 1e5
        course.plot(strain[shown], grown[shown], color=style.get("color"), linewidth=0.8, linestyle="--")
    course.set_yscale("log")
    course.set_ylim(1e-3, 1e5)
    course.set_xlabel(r"strain $\dot\gamma t$", fontsize=8)
    course.set_ylabel(r"structure factor $S(0,2\pi/L)$", fontsize=8)
    course.legend(fontsize=7, frameon=False, loc="lower center", ncols=2)
    for axes, name in ((plane, "a"), (course, "b")):
        axes.tick_params(labelsize=7)
        axes.set_title(f"({name})", fontsize=8, loc="left")
    return figure
