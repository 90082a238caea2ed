"""How far Enskog's dissipation rate is from the measured one, and the theory that follows from a
law of it.

From the reference map (N = 1600 to 16,000, dt = 1e-4): the dissipation rate Γ, which is the power
of the shear in a steady flow, Enskog's Γ_E at the measured temperature tensor scaled to the local
temperature, and the lengths L = Γ_E/Γ and L′ = (Γ_E/p_E)/(Γ/p) with the contact pressure p; and the
same from the map of the paper (N = 1000, dt = 1e-5). Laws of L up to ν = 0.75, and laws of L′ and
p/p_E for all flows, are fitted to the reference map, with each restitution or packing fraction left
out in turn, and judged on the paper's map and on one of 30 other flows (N = 1600, dt = 3e-4), which
also judge the temperature and the stresses of ``corrected_shear``.

    python -m benchmarks dissipation           # four minutes on two cores
    python -m benchmarks dissipation --quick   # judged on smaller flows, one minute
"""

from collections.abc import Callable

import jax
import numpy as np
import xarray as xr
from matplotlib.figure import Figure
from scipy.optimize import least_squares

import jaxgran as jg
from benchmarks.output import RESULTS, Output, rounded
from benchmarks.reference_map import reference_points
from jaxgran.environment import usable_cores
from jaxgran.maps.presets import PRESETS
from jaxgran.maps.schema import MapData, flattened
from jaxgran.plotting.style import SMALL_SIZE, TWO_COLUMNS, curve_styles, label_log_axis, styled
from jaxgran.theory.corrected_shear import (
    MEASURED_LAWS,
    CorrelationLaws,
    corrected_shear,
    correlation_length,
    pair_factor,
)
from jaxgran.theory.steady_shear import contact_value

JUDGED = {
    "restitution": (0.12, 0.35, 0.55, 0.75, 0.93),
    "packing_fraction": (0.15, 0.35, 0.48, 0.58, 0.68, 0.775),
    "grains": 1600,
    "seeds": 1,
    "timestep": 3e-4,
}
"""A map without a restitution or a packing fraction of the fitted one."""
SMALLER = {"grains": 64}
CORRECTIONS = {
    "length": (correlation_length, "length_from_pressure"),
    "pairs": (pair_factor, "pair_factor"),
}
START = {"length": (0.2, 0.02, 1.5), "pairs": (0.3, 0.02, 1.5)}
PREDICTED = {
    "local_temperature": "granular_temperature",
    "pressure": "pressure",
    "shear_stress": "shear_stress",
}
"""What is measured, by its name here, and the field of the corrected theory that predicts it."""
corrected = jax.jit(
    jax.vmap(lambda laws, alpha, nu: corrected_shear(alpha, nu, laws=laws), (None, 0, 0))
)
DENSEST = 0.75  # packing fraction up to which laws of L are fitted
MODERATE = (
    0.3,
    0.7,
)  # packing fractions between which errors of pressure and temperature are compared
LENGTHS = (
    "alpha",
    "nu",
    "dissipation",
    "dissipation_error",
    "length_from_pressure",
    "length_from_pressure_error",
)
WITHIN = (0.05, 0.1, 0.2)  # relative errors of the theory that are counted
THEORY = ("pressure", "shear_stress", "granular_temperature")
DRAWN = (0.1, 0.3, 0.5, 0.7, 0.9)  # restitutions

Points = dict[str, np.ndarray]  # numbers of the points of a map, each (points,)


def run(output: Output) -> None:
    """Compare, fit, judge, print, and write JSON and PNG."""
    plane = reference_points()
    another = jg.ratio_map(**JUDGED | (SMALLER if output.quick else {}), workers=usable_cores())
    maps = {"map": plane, "paper": jg.open_map(RESULTS / "paper.nc"), "judged_on": another}
    points, paper, judged = (compared(flattened(data)) for data in maps.values())
    result = {
        "counts": counts(points),
        "counts_of_paper": counts(paper),
        "errors_of_theory": errors_of_theory(points),
        "balance": balance(plane) | {"largest_excess_of_root_chaos": root_chaos(points)},
        "laws": laws_of_length(points, judged),
        "corrected_theory": corrected_theory(points, {"paper": paper, "judged_on": judged}),
    }
    for name, values in result.items():
        print(name, *(f"  {key}: {rounded(x, 4)}" for key, x in values.items()), sep="\n")
    print("   ν     α        Γ/Γ_E             L′           L′√chaos   binary   chaos")
    rows, paper_rows, judged_rows = (
        [
            {name: rounded(float(x[k]), 4) for name, x in some.items()}
            for k in range(some["alpha"].size)
        ]
        for some in (points, paper, judged)
    )
    for row in rows:
        print(
            "{nu:5.2f}{alpha:6.2f}{dissipation:8.3f} ± "
            "{dissipation_error:.3f}{length_from_pressure:9.3f} ± "
            "{length_from_pressure_error:.3f}{times_root_chaos:9.3f}{binary:9.3f}"
            "{chaos:8.3f}".format(**row)
        )
    heads = {
        name: {"points": some["nu"].size, "timestep": float(data.attrs["timestep"])}
        | sizes_of(data)
        for (name, data), some in zip(maps.items(), (points, paper, judged), strict=True)
    }
    content = heads | rounded(result, 4) | {"judged_points": [keep(row) for row in judged_rows]}
    content |= {"paper_points": [{name: row[name] for name in LENGTHS} for row in paper_rows]}
    output.write_rows("dissipation", content, "points", rows)
    output.write_picture(draw(points, judged, fitted_laws(points)[0]), "dissipation")


def sizes_of(data: MapData) -> dict[str, int]:
    """The smallest and the largest number of grains of a map."""
    sizes = np.ravel(data.attrs.get("grains_by_point", data.attrs["grains"]))
    return {"fewest_grains": int(sizes.min()), "most_grains": int(sizes.max())}


def keep(row: dict[str, float]) -> dict[str, float]:
    """What a prediction of the flow is compared with."""
    return {
        name: row[name]
        for name in ("alpha", "nu", *PREDICTED, "length_from_pressure", "pair_factor")
    }


def of_rows(rows: list[dict[str, float]]) -> Points:
    """Points from their rows in a result."""
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}


def compared(data: xr.Dataset) -> Points:
    """Measured rates over Enskog's, lengths and temperatures at the points of a map that have the
    status ok.
    """
    ok = data.status.values == 0
    nu, alpha = (
        x[ok]
        for x in np.broadcast_arrays(data.packing_fraction.values[:, None], data.restitution.values)
    )

    def value(name: str) -> np.ndarray:
        return data[name].values[ok]

    local, length = value("local_granular_temperature"), value("theory/correlation_length")
    by_pressure, chaos = (
        value("theory/correlation_length_from_pressure"),
        value("theory/enskog_factor_pressure_chaos"),
    )
    of_temperature = value("theory/enskog_factor_pressure_local_temperature")
    stress, enskog = value("stresses/contact_stress"), value("theory/enskog_pressure")
    contact = (stress[..., 0, 0] + stress[..., 1, 1]) / 2
    return {
        "alpha": alpha,
        "nu": nu,
        "dissipation": 1 / length,
        "dissipation_error": value("theory/correlation_length_stderr") / length**2,
        "length_from_pressure": by_pressure,
        "length_from_pressure_error": value("theory/correlation_length_from_pressure_stderr"),
        "pair_factor": by_pressure / length,
        "times_root_chaos": by_pressure * np.sqrt(chaos),
        "binary": value("theory/enskog_factor_pressure_binary"),
        "chaos": chaos,
        "chaos_granular": chaos * of_temperature,
        "pressure_over_enskog": contact / enskog / of_temperature,
        "pressure_over_enskog_granular": contact / enskog,
        "local_temperature": local,
        "pressure": value("pressure"),
        "shear_stress": value("shear_stress"),
        **{f"{name}_over_theory": value(name) / value(f"theory/{name}") for name in THEORY},
        "local_temperature_over_theory": local / value("theory/granular_temperature"),
    }


def counts(points: Points) -> dict[str, int]:
    """Numbers of points of which something is said on the pages, by the local and by the granular
    temperature.
    """
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
    """Points whose pressure, shear stress and temperatures the moments predict, and how errors of
    both are related.
    """
    names = (*(f"{name}_over_theory" for name in THEORY), "local_temperature_over_theory")
    errors: dict = {
        name: [int(np.sum(abs(1 / points[name] - 1) < share)) for share in WITHIN] for name in names
    }
    moderate = (points["nu"] >= MODERATE[0]) & (points["nu"] <= MODERATE[1])
    for name in ("pressure_over_theory", "shear_stress_over_theory"):
        x, y = (-np.log(points[key][moderate]) for key in ("local_temperature_over_theory", name))
        slope, _ = np.polyfit(x, y, 1)
        errors[f"{name}_against_local_temperature"] = {
            "correlation": np.corrcoef(x, y)[0, 1],
            "slope": slope,
        }
    return errors


# -----------------------------------------------------------------------------------------------
# laws of L

LAWS: dict[str, tuple[Callable[[Points, np.ndarray], np.ndarray], tuple[float, ...]]] = {
    "1": (lambda p, c: np.ones_like(p["nu"]), ()),
    "max(1, c G^(1/3) S)": (lambda p, c: np.maximum(1, c[0] * over_shear(p)), (0.5,)),
    "max(1, c X^k)": (lambda p, c: np.maximum(1, c[0] * dissipative_rate(p) ** c[1]), (1.1, 0.3)),
}
"""Laws of L by their formula, with G = νχ, S = γ̇σ/√(T/m), T the local temperature and
X = (1 − α) G^(1/3) S.
"""


def density(points: Points) -> np.ndarray:
    """G = νχ."""
    return points["nu"] * np.asarray(contact_value(points["nu"]))


def over_shear(points: Points) -> np.ndarray:
    """G^(1/3) γ̇σ/√(T/m) at a shear rate of one."""
    return np.cbrt(density(points)) / np.sqrt(points["local_temperature"])


def dissipative_rate(points: Points) -> np.ndarray:
    """X = (1 − α) G^(1/3) γ̇σ/√(T/m) at a shear rate of one."""
    return (1 - points["alpha"]) * over_shear(points)


def laws_of_length(points: Points, judged: Points) -> dict[str, dict]:
    """Coefficients of each law, and the rms of its error in ln L: fitted, with a packing fraction
    left out, judged.
    """
    points, judged = (only(flows, flows["nu"] <= DENSEST) for flows in (points, judged))
    result = {}
    for name, (law, start) in LAWS.items():
        coefficients = fitted(law, start, points)
        left_out = [
            misfit(
                law,
                fitted(law, start, only(points, points["nu"] != nu)),
                only(points, points["nu"] == nu),
            )
            for nu in np.unique(points["nu"])
        ]
        result[name] = {
            "coefficients": coefficients.tolist(),
            "rms": rms(misfit(law, coefficients, points)),
            "rms_left_out": rms(np.concatenate(left_out)),
            "rms_judged": rms(misfit(law, coefficients, judged)),
        }
    return result


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


# -----------------------------------------------------------------------------------------------
# corrected theory


def fitted_laws(
    points: Points,
) -> tuple[CorrelationLaws, dict[str, np.ndarray], dict[str, float]]:
    """The laws of L′ and of the pairs at contact with the least squares of their logarithms, the
    standard errors of their coefficients, and the rms of each.

    A point counts as much as the area of the plane of ln(1 − α) and ν that it stands for.
    """
    laws, stderrs, rms_of = MEASURED_LAWS, {}, {}
    roots = np.sqrt(areas(points["alpha"], points["nu"]))
    for name in CORRECTIONS:

        def weighted(
            coefficients: np.ndarray, laws: CorrelationLaws = laws, name: str = name
        ) -> np.ndarray:
            return roots * law_misfit(laws, points, name, coefficients)

        fit = least_squares(weighted, START[name], x_scale="jac", bounds=(0, np.inf))
        scatter = fit.fun @ fit.fun / (fit.fun.size - fit.x.size)
        stderrs[name] = np.sqrt(np.diag(scatter * np.linalg.inv(fit.jac.T @ fit.jac)))
        rms_of[name] = rms(fit.fun / roots)
        laws = laws._replace(**{name: fit.x})
    return laws, stderrs, rms_of


def areas(alphas: np.ndarray, nus: np.ndarray) -> np.ndarray:
    """The area of the plane of ln(1 − α) and ν that each point of a grid stands for, over the
    mean.
    """
    area = np.ones(nus.size)
    for x in (-np.log(1 - alphas), nus):
        values, place = np.unique(x, return_inverse=True)
        area *= np.gradient(values)[place]
    return area / area.mean()


def law_misfit(
    laws: CorrelationLaws, points: Points, name: str, coefficients: np.ndarray | None = None
) -> np.ndarray:
    """Logarithm of a law over what is measured, with other coefficients where they are given."""
    law, measured = CORRECTIONS[name]
    laws = laws if coefficients is None else laws._replace(**{name: coefficients})
    return np.log(np.asarray(law(laws, points["alpha"], points["nu"])) / points[measured])


def misfits(laws: CorrelationLaws, points: Points) -> dict[str, np.ndarray]:
    """Logarithms of the laws over what is measured, and the same of the corrected theory."""
    shear = corrected(laws, points["alpha"], points["nu"])
    return {name: law_misfit(laws, points, name) for name in CORRECTIONS} | {
        name: np.log(np.asarray(getattr(shear, field)) / points[name])
        for name, field in PREDICTED.items()
    }


def corrected_theory(points: Points, others: dict[str, Points]) -> dict:
    """The laws, and errors with an inner restitution or packing fraction, or the densest, left out,
    and elsewhere.
    """
    laws, stderrs, of_fit = fitted_laws(points)
    judged = others["judged_on"]
    result: dict = {
        "laws": {
            **{name: np.asarray(getattr(laws, name)).tolist() for name in stderrs},
            **{f"{name}_stderr": stderr.tolist() for name, stderr in stderrs.items()},
            "scatter": [rms(misfits(laws, judged)[name]) for name in PREDICTED],
        },
        "rms_of_fit": of_fit,
        "rms_judged": {name: rms(misfits(laws, judged)[name]) for name in CORRECTIONS},
    }
    inner, densest = (
        {axis: np.unique(points[axis])[1:-1] for axis in ("alpha", "nu")},
        points["nu"].max(),
    )
    for kind, axis, values in (
        ("alpha_left_out", "alpha", inner["alpha"]),
        ("nu_left_out", "nu", inner["nu"]),
        ("densest_left_out", "nu", [densest]),
    ):
        left_out = [
            misfits(
                fitted_laws(only(points, points[axis] != x))[0], only(points, points[axis] == x)
            )
            for x in values
        ]
        result[f"rms_{kind}"] = {
            name: rms(np.concatenate([misfit[name] for misfit in left_out])) for name in left_out[0]
        }
    none = np.zeros(3)
    variants = {
        "enskog": laws._replace(length=none, pairs=none),
        "length": laws._replace(pairs=none),
        "length_and_dense_pairs": laws._replace(pairs=np.asarray(laws.pairs) * [0, 1, 1]),
        "length_and_pairs": laws,
    }
    for name, some in {"fitted_map": points, **others}.items():
        within = {"all": some["nu"] > 0, "to_0.75": some["nu"] <= DENSEST, "core": in_core(some)}
        errors = {key: misfits(variant, some) for key, variant in variants.items()}
        result[name] = {
            part: {"points": int(chosen.sum())}
            | {
                key: {
                    quantity: summary(error[quantity][chosen])
                    for quantity in PREDICTED
                    if quantity in error
                }
                for key, error in errors.items()
            }
            for part, chosen in within.items()
        }
    return result


def in_core(points: Points) -> np.ndarray:
    """Flows between the restitutions and packing fractions of the map that ``jaxgran map`` makes
    first.
    """
    spans = (
        (points["alpha"], PRESETS["quick"]["restitution"]),
        (points["nu"], PRESETS["quick"]["packing_fraction"]),
    )
    inside = [(x >= min(span) - 1e-9) & (x <= max(span) + 1e-9) for x, span in spans]
    return inside[0] & inside[1]


def summary(errors: np.ndarray) -> dict:
    """Rms of the logarithms of predicted over measured, and numbers of points within relative
    errors.
    """
    return {
        "rms": rms(errors),
        "within": [int(np.sum(abs(np.expm1(errors)) < share)) for share in WITHIN],
    }


# -----------------------------------------------------------------------------------------------
# checks, output


def balance(data: xr.Dataset) -> dict[str, float]:
    """Γ over the power of the shear, and the share of Γ that binary collisions would have."""
    ok = data.status.values == 0
    dissipation, shear = data["stresses/dissipation_rate"].values[ok], data.shear_stress.values[ok]
    errors = np.hypot(
        *(
            data[f"{name}_stderr"].values[ok]
            for name in ("stresses/dissipation_rate", "shear_stress")
        )
    )
    binary = data["stresses/binary_dissipation_rate"].values[ok] / dissipation
    return {
        "points": int(ok.sum()),
        "largest_excess_of_dissipation": float(np.max(abs(dissipation / shear - 1))),
        "the_same_in_standard_errors": float(np.max(abs(dissipation - shear) / errors)),
        "least_share_of_binary_dissipation": float(binary.min()),
        "share_of_binary_dissipation_within_2_percent": int(np.sum(abs(binary - 1) < 0.02)),
    }


def root_chaos(points: Points) -> float:
    """How far L′ √chaos is from one where collisions are binary within 1 %."""
    return float(np.max(abs(points["times_root_chaos"] - 1)[abs(points["binary"] - 1) < 0.01]))


@styled
def draw(points: Points, judged: Points, laws: CorrelationLaws) -> Figure:
    """L′ against the packing fraction with its law, and predicted over measured pressure at flows
    of another map.
    """
    figure = Figure(figsize=(TWO_COLUMNS, 3.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    dense = np.linspace(points["nu"].min(), points["nu"].max(), 200)
    for alpha, style in zip(DRAWN, curve_styles(len(DRAWN)), strict=True):
        some = only(points, points["alpha"] == alpha)
        look = {**style, "markersize": 4, "linestyle": "none", "label": rf"$\alpha$ = {alpha:g}"}
        left.errorbar(
            some["nu"], some["length_from_pressure"], some["length_from_pressure_error"], **look
        )
        law = np.asarray(correlation_length(laws, np.full_like(dense, alpha), dense))
        left.plot(dense, law, color=style["color"], linestyle="-", linewidth=1)
    none = laws._replace(length=np.zeros(3), pairs=np.zeros(3))
    for label, applied, face in (("Enskog", none, "none"), ("corrected", laws, "0")):
        ratio = np.exp(misfits(applied, judged)["pressure"])
        shift = 0.004 if face == "none" else -0.004
        right.plot(
            judged["nu"] + shift,
            ratio,
            "o",
            color="0",
            markerfacecolor=face,
            markersize=4.5,
            label=label,
        )
    right.axhspan(0.9, 1.1, color="0.9", zorder=0, label=r"within 10 %")
    left.set(
        yscale="log", xlabel=r"packing fraction $\nu$", ylabel=r"correlation length $L'/\sigma$"
    )
    right.set(
        yscale="log", xlabel=r"packing fraction $\nu$", ylabel="predicted / measured pressure"
    )
    for axes, place in ((left, "upper left"), (right, "lower left")):
        axes.axhline(1, color="0.6", linewidth=0.8, zorder=0)
        axes.legend(fontsize=SMALL_SIZE, frameon=False, loc=place)
        label_log_axis(axes.yaxis)
    return figure
