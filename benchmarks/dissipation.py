"""How far Enskog's dissipation rate is from the measured one, and what of kinetic theory's errors follows from it.

From the map of the paper (N = 1000, dt = 1e-5): the dissipation rate Γ, which is the power of the shear in a steady
flow, Enskog's Γ_E at the measured temperature tensor scaled to the local temperature, and the lengths L = Γ_E/Γ and
L′ = (Γ_E/p_E)/(Γ/p) with the contact pressure p. Laws of L are fitted to this map up to ν = 0.75, with each packing
fraction left out in turn, and judged on the map of 30 points that ``jaxgran map`` makes first (N = 256, dt = 1e-3).

    python -m benchmarks dissipation           # about a minute on two cores
    python -m benchmarks dissipation --quick   # judged on smaller flows, half a minute
"""

from collections.abc import Callable

import jax
import numpy as np
import xarray as xr
from matplotlib.figure import Figure
from scipy.optimize import least_squares

import jaxgran as jg
from benchmarks.closure_study import make_map
from benchmarks.output import RESULTS, Output, rounded
from jaxgran.maps.schema import flattened
from jaxgran.plotting.drawing import curve_styles, label_log_axis
from jaxgran.theory.enskog import collisional_transfer
from jaxgran.theory.steady_shear import contact_value

DENSEST = 0.75  # packing fraction up to which laws of L are fitted
MODERATE = (0.3, 0.7)  # packing fractions between which errors of pressure and temperature are compared
WITHIN = (0.05, 0.1, 0.2)  # relative errors of the theory that are counted
THEORY = ("pressure", "shear_stress", "granular_temperature")
DRAWN = (0.1, 0.3, 0.5, 0.7, 0.9)  # restitutions

Points = dict[str, np.ndarray]  # numbers of the points of a map, each (points,)


def run(output: Output) -> None:
    """Compare, fit, judge, print, and write JSON and PNG."""
    data = flattened(jg.open_map(RESULTS / "paper.nc"))
    small = flattened(make_map(output.quick))
    points, judged = compared(data), compared(small)
    result = {
        "counts": counts(points),
        "errors_of_theory": errors_of_theory(points),
        "laws": laws(points, judged),
        "made_with_sums": made_with_sums(small, judged),
    }
    for name, one in result.items():
        print(name, *(f"  {key}: {rounded(x, 4)}" for key, x in one.items()), sep="\n")
    print("   ν     α        Γ/Γ_E             L′           L′√chaos   binary   chaos")
    rows = [{name: rounded(float(x[k]), 4) for name, x in points.items()} for k in range(points["alpha"].size)]
    for one in rows:
        print(
            "{nu:5.2f}{alpha:6.2f}{dissipation:8.3f} ± {dissipation_error:.3f}{length_from_pressure:9.3f} ± "
            "{length_from_pressure_error:.3f}{times_root_chaos:9.3f}{binary:9.3f}{chaos:8.3f}".format(**one)
        )
    maps = {
        name: {"grains": int(x.attrs["grains"]), "timestep": float(x.attrs["timestep"])}
        for name, x in (("map", data), ("judged_on", small))
    }
    output.write_rows("dissipation", maps | rounded(result, 4), "points", rows)
    output.write_picture(draw(points, judged, result["laws"][BEST]["coefficients"]), "dissipation")


def compared(data: xr.Dataset) -> Points:
    """Measured rates over Enskog's, lengths and temperatures at the points of a map that have the status ok.

    The errors of Γ/Γ_E and L′ are sums of the relative errors of what they are made of, which hold for any correlation
    of these: shear stress and three halves of the local temperature; friction and half of the local temperature.
    """
    ok = data.status.values == 0
    nu, alpha = (x[ok] for x in np.broadcast_arrays(data.packing_fraction.values[:, None], data.restitution.values))

    def value(name: str) -> np.ndarray:
        return data[name].values[ok]

    def relative_error(name: str) -> np.ndarray:
        return value(f"{name}_stderr") / value(name)

    granular, local = value("granular_temperature"), value("local_granular_temperature")
    tensor = value("stresses/kinetic_stress") * (granular / value("stresses/kinetic_pressure"))[:, None, None]
    there = (data, alpha, nu)
    at_granular, at_local = enskog(tensor, *there), enskog((local / granular)[:, None, None] * tensor, *there)
    isotropic, isotropic_local = (enskog(x[:, None, None] * np.eye(2), *there)["pressure"] for x in (granular, local))
    slower = (at_granular["speed"] / at_local["speed"]) ** 2
    chaos = value("theory/enskog_factor_pressure_chaos")
    if "theory/enskog_factor_pressure_local_temperature" not in data:  # then that factor is part of this one
        chaos = chaos * slower
    contact, binary = value("stresses/contact_pressure"), value("theory/enskog_factor_pressure_binary")
    dissipation = value("shear_stress") * float(data.attrs["shear_rate"]) / at_local["dissipation_rate"]
    by_pressure = contact / at_local["pressure"] / dissipation
    of_temperature = relative_error("local_granular_temperature")
    return {
        "alpha": alpha,
        "nu": nu,
        "dissipation": dissipation,
        "dissipation_error": dissipation * (relative_error("shear_stress") + 1.5 * of_temperature),
        "length_from_pressure": by_pressure,
        "length_from_pressure_error": by_pressure * (relative_error("macroscopic_friction") + of_temperature / 2),
        "times_root_chaos": by_pressure * np.sqrt(chaos),
        "binary": binary,
        "chaos": chaos,
        "chaos_granular": chaos / slower,
        "pressure_over_enskog": contact / isotropic_local,
        "pressure_over_enskog_granular": contact / isotropic,
        "local_temperature": local,
        **{f"{name}_over_theory": value(name) / value(f"theory/{name}") for name in THEORY},
        "local_temperature_over_theory": local / value("theory/granular_temperature"),
    }


def enskog(tensors: np.ndarray, data: xr.Dataset, alpha: np.ndarray, nu: np.ndarray) -> Points:
    """Enskog's contact pressure, dissipation rate and speed of approach weighted by pressure, at given tensors."""
    flow = float(data.attrs["shear_rate"]), float(data.attrs["polydispersity"])
    found = jax.vmap(lambda *here: collisional_transfer(*here, *flow))(tensors, alpha, nu)
    pressure, speed = (np.trace(np.asarray(x), axis1=1, axis2=2) / 2 for x in (found.stress, found.speed_stress))
    return {"pressure": pressure, "speed": speed / pressure, "dissipation_rate": np.asarray(found.dissipation_rate)}


def counts(points: Points) -> dict[str, int]:
    """Numbers of points of which something is said on the pages, by the local and by the granular temperature."""
    binary = abs(points["binary"] - 1) < 0.01

    def near(name: str) -> int:
        return int(np.sum(abs(points[name] - 1) < 0.05))

    return {
        "points": points["alpha"].size,
        "binary": int(binary.sum()),
        "binary_without_chaos": int(np.sum(binary & (points["chaos"] < 0.9))),
        "binary_without_chaos_granular": int(np.sum(binary & (points["chaos_granular"] < 0.9))),
        "enskog_pressure_within_5_percent": near("pressure_over_enskog"),
        "enskog_pressure_within_5_percent_granular": near("pressure_over_enskog_granular"),
    }


def errors_of_theory(points: Points) -> dict:
    """Points whose pressure, shear stress and temperatures the moments predict, and how errors of both are related."""
    names = (*(f"{name}_over_theory" for name in THEORY), "local_temperature_over_theory")
    found: dict = {name: [int(np.sum(abs(1 / points[name] - 1) < share)) for share in WITHIN] for name in names}
    moderate = (points["nu"] >= MODERATE[0]) & (points["nu"] <= MODERATE[1])
    for name in ("pressure_over_theory", "shear_stress_over_theory"):
        x, y = (-np.log(points[one][moderate]) for one in ("local_temperature_over_theory", name))
        slope, _ = np.polyfit(x, y, 1)
        found[f"{name}_against_local_temperature"] = {"correlation": np.corrcoef(x, y)[0, 1], "slope": slope}
    return found


# ----------------------------------------------------------------------------------------------- laws of L

LAWS: dict[str, tuple[Callable[[Points, np.ndarray], np.ndarray], tuple[float, ...]]] = {
    "1": (lambda p, c: np.ones_like(p["nu"]), ()),
    "max(1, c G^(1/3) S)": (lambda p, c: np.maximum(1, c[0] * over_shear(p)), (0.5,)),
    "max(1, c X^k)": (lambda p, c: np.maximum(1, c[0] * dissipative_rate(p) ** c[1]), (1.1, 0.3)),
    "1 + c (1 - α)^a G^b": (lambda p, c: 1 + c[0] * (1 - p["alpha"]) ** c[1] * density(p) ** c[2], (0.3, 2.0, 0.5)),
}
BEST = "max(1, c X^k)"
"""Laws of L by their formula, with G = νχ, S = γ̇σ/√(T/m), T the local temperature and X = (1 − α) G^(1/3) S."""


def density(points: Points) -> np.ndarray:
    """G = νχ."""
    return points["nu"] * np.asarray(contact_value(points["nu"]))


def over_shear(points: Points) -> np.ndarray:
    """G^(1/3) γ̇σ/√(T/m) at a shear rate of one."""
    return np.cbrt(density(points)) / np.sqrt(points["local_temperature"])


def dissipative_rate(points: Points) -> np.ndarray:
    """X = (1 − α) G^(1/3) γ̇σ/√(T/m) at a shear rate of one."""
    return (1 - points["alpha"]) * over_shear(points)


def laws(points: Points, judged: Points) -> dict[str, dict]:
    """Coefficients of each law, and the rms of its error in ln L: fitted, with a packing fraction left out, judged."""
    points, judged = (only(one, one["nu"] <= DENSEST) for one in (points, judged))
    found = {}
    for name, (law, start) in LAWS.items():
        coefficients = fitted(law, start, points)
        left_out = [
            misfit(law, fitted(law, start, only(points, points["nu"] != nu)), only(points, points["nu"] == nu))
            for nu in np.unique(points["nu"])
        ]
        found[name] = {
            "coefficients": coefficients.tolist(),
            "rms": rms(misfit(law, coefficients, points)),
            "rms_left_out": rms(np.concatenate(left_out)),
            "rms_judged": rms(misfit(law, coefficients, judged)),
        }
    return found


def only(points: Points, chosen: np.ndarray) -> Points:
    return {name: x[chosen] for name, x in points.items()}


def misfit(law: Callable, coefficients: np.ndarray, points: Points) -> np.ndarray:
    """ln of the law over the measured L = Γ_E/Γ."""
    return np.log(law(points, coefficients) * points["dissipation"])


def fitted(law: Callable, start: tuple[float, ...], points: Points) -> np.ndarray:
    """The coefficients with the least squares of ln L."""
    if not start:
        return np.empty(0)
    return least_squares(lambda c: misfit(law, c, points), start, bounds=(1e-3, 10)).x


def rms(x: np.ndarray) -> float:
    return float(np.sqrt(np.mean(x**2)))


# ----------------------------------------------------------------------------------------------- checks, output


def made_with_sums(data: xr.Dataset, points: Points) -> dict[str, float]:
    """For a map with sums of dissipation: Γ over the power of the shear, and its own L′ over that of ``compared``."""
    ok = data.status.values == 0
    dissipation, shear = data["stresses/dissipation_rate"].values[ok], data.shear_stress.values[ok]
    errors = np.hypot(*(data[f"{name}_stderr"].values[ok] for name in ("stresses/dissipation_rate", "shear_stress")))
    length = data["theory/correlation_length_from_pressure"].values[ok]
    binary = data["stresses/binary_dissipation_rate"].values[ok] / dissipation
    return {
        "points": int(ok.sum()),
        "largest_excess_of_dissipation": float(np.max(abs(dissipation / shear - 1))),
        "the_same_in_standard_errors": float(np.max(abs(dissipation - shear) / errors)),
        "least_length_over_estimate": float(np.min(length / points["length_from_pressure"])),
        "largest_length_over_estimate": float(np.max(length / points["length_from_pressure"])),
        "least_share_of_binary_dissipation": float(binary.min()),
    }


def draw(points: Points, judged: Points, coefficients: list[float]) -> Figure:
    """L′ against the packing fraction, a curve for each restitution; L against X for both maps, and the law."""
    figure = Figure(figsize=(7.4, 3.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    for alpha, style in zip(DRAWN, curve_styles(len(DRAWN)), strict=True):
        some = only(points, points["alpha"] == alpha)
        look = {**style, "markersize": 4, "linewidth": 1, "label": rf"$\alpha$ = {alpha:g}"}
        left.errorbar(some["nu"], some["length_from_pressure"], some["length_from_pressure_error"], **look)
    for label, every, marker, colour in (("fitted map", points, "o", "0.6"), ("another map", judged, "s", "0")):
        some = only(every, every["nu"] <= DENSEST)
        look = {"linestyle": "none", "markersize": 3.5, "marker": marker, "color": colour, "label": label}
        right.plot(dissipative_rate(some), 1 / some["dissipation"], **look)
    x = np.geomspace(5e-4, 4, 200)
    right.plot(x, np.maximum(1, coefficients[0] * x ** coefficients[1]), "k-", linewidth=1, label="law")
    left.set(yscale="log", xlabel=r"packing fraction $\nu$", ylabel=r"correlation length $L'/\sigma$")
    xlabel = r"$X = (1-\alpha)\,G^{1/3}\,\dot\gamma\sigma/\sqrt{T_\mathrm{l}/m}$"
    right.set(xscale="log", yscale="log", xlabel=xlabel, ylabel=r"correlation length $L/\sigma$")
    for axes in (left, right):
        axes.axhline(1, color="0.6", linewidth=0.8, zorder=0)
        axes.legend(fontsize="small", frameon=False, loc="upper left")
        label_log_axis(axes.yaxis)
    label_log_axis(right.xaxis)
    return figure
