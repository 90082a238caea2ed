"""How far Enskog's dissipation rate is from the measured one, and what a law of it mends.

From the reference map: the dissipation rate Γ over Enskog's Γ_E at the measured temperature tensor,
scaled to the local temperature; and the lengths L = Γ_E/Γ and L′ = (Γ_E/p_E)/(Γ/p) with contact
pressures. Laws of L′ and of L′/L = p/p_E, which ``corrected_shear`` takes, are fitted to all flows,
and without the densest, and laws of L up to ν = 0.75. They are judged on 30 other flows (N = 1600,
dt = 3e-4), as is the corrected theory.

    python -m benchmarks dissipation           # four minutes on two cores
    python -m benchmarks dissipation --quick   # judged on smaller flows, one minute
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
import pandas as pd
import xarray as xr
from matplotlib.figure import Figure
from scipy.optimize import least_squares

import jaxgran as jg
from benchmarks.output import RESULTS, Output, rounded
from benchmarks.reference_map import reference_points
from jaxgran.environment import usable_cores
from jaxgran.maps.schema import flattened
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
LAWS = {
    "length": (correlation_length, "length_from_pressure", (0.2, 0.02, 1.5)),
    "pairs": (pair_factor, "pair_factor", (0.3, 0.02, 1.5)),
}
"""A factor of the corrected theory, what is measured of it, and where its fit begins."""
PREDICTED = {
    "local_temperature": "granular_temperature",
    "pressure": "pressure",
    "shear_stress": "shear_stress",
}
"""What is measured, by its name here, and the field of the corrected theory that predicts it."""
WITHOUT_LAWS = MEASURED_LAWS._replace(length=np.zeros(3), pairs=np.zeros(3))
DENSEST = 0.75  # packing fraction up to which laws of L are fitted
DRAWN = (0.1, 0.3, 0.5, 0.7, 0.9)  # restitutions

corrected = jax.jit(
    jax.vmap(lambda laws, alpha, nu: corrected_shear(alpha, nu, laws=laws), (None, 0, 0))
)


def run(output: Output) -> None:
    """Compare, fit, judge, and write JSON and PNG."""
    another = JUDGED | ({"grains": 64} if output.quick else {})
    other = flattened(jg.ratio_map(**another, workers=usable_cores()))
    paper = flattened(jg.open_map(RESULTS / "paper.nc"))
    points, paper, judged = map(flows_of, (reference_points(), paper, other))
    shown = ["alpha", "nu", *PREDICTED, "length_from_pressure", "pair_factor"]
    content = {
        "judged_on": {
            "points": len(judged),
            "timestep": float(other.attrs["timestep"]),
            "most_grains": int(other.attrs["grains"]),
        },
        "counts": counts(points),
        "counts_of_paper": counts(paper),
        "largest_excess_of_root_chaos": root_chaos(points),
        "laws": laws_of_length(points, judged),
        "corrected_theory": corrected_theory(points, judged),
        "judged_points": judged[shown].to_dict("records"),
    }
    content = rounded(content, 4)
    print(*(f"{name}: {x}" for name, x in content.items() if name != "judged_points"), sep="\n")
    output.write_json("dissipation", content | {"points": rounded(points.to_dict("records"), 4)})
    output.write_picture(draw(points, judged, fitted_laws(points)[0]), "dissipation")


def flows_of(data: xr.Dataset) -> pd.DataFrame:
    """Measured rates over Enskog's, lengths and averages of the flows of a map that have the status
    ok.
    """
    length, stderr = (data[f"theory/correlation_length{end}"] for end in ("", "_stderr"))
    by_pressure = "theory/correlation_length_from_pressure"
    columns = {
        "dissipation": 1 / length,
        "dissipation_error": stderr / length**2,
        "length_from_pressure": data[by_pressure],
        "length_from_pressure_error": data[f"{by_pressure}_stderr"],
        "pair_factor": data[by_pressure] / length,
        "binary": data["theory/enskog_factor_pressure_binary"],
        "chaos": data["theory/enskog_factor_pressure_chaos"],
        "local_temperature": data.local_granular_temperature,
        "pressure": data.pressure,
        "shear_stress": data.shear_stress,
        "status": data.status,
    }
    axes = ["packing_fraction", "restitution"]
    plain = {name: x.reset_coords(drop=True) for name, x in columns.items()}
    flows = xr.Dataset(plain).to_dataframe(dim_order=axes).reset_index()
    flows = flows.rename(columns={"packing_fraction": "nu", "restitution": "alpha"})
    return flows[flows.status == 0].drop(columns="status").reset_index(drop=True)


def counts(flows: pd.DataFrame) -> dict[str, int]:
    """Flows whose collisions are binary within 1 %, and those of them without molecular chaos."""
    binary = flows[abs(flows.binary - 1) < 0.01]
    numbers = {"points": len(flows), "binary": len(binary)}
    return numbers | {"binary_without_chaos": int((binary.chaos < 0.9).sum())}


def root_chaos(flows: pd.DataFrame) -> float:
    """How far L′ √chaos is from one where collisions are binary within 1 %."""
    excess = abs(flows.length_from_pressure * np.sqrt(flows.chaos) - 1)
    return float(excess[abs(flows.binary - 1) < 0.01].max())


def rms(x: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(x))))


# Laws of L


def over_shear(flows: pd.DataFrame) -> np.ndarray:
    """G^(1/3) γ̇σ/√(T/m) with G = νχ and the local temperature T, at a shear rate of one."""
    density = flows.nu * np.asarray(contact_value(flows.nu.to_numpy()))
    return np.cbrt(density) / np.sqrt(flows.local_temperature)


LAWS_OF_LENGTH: dict[str, tuple[Callable[[pd.DataFrame, np.ndarray], Any], Sequence[float]]] = {
    "max(1, c G^(1/3) S)": (lambda f, c: np.maximum(1, c[0] * over_shear(f)), (0.5,)),
    "max(1, c X^k)": (
        lambda f, c: np.maximum(1, c[0] * ((1 - f.alpha) * over_shear(f)) ** c[1]),
        (1.1, 0.3),
    ),
}
"""Laws of L by their formula, with S = γ̇σ/√(T/m) and X = (1 − α) G^(1/3) S."""


def laws_of_length(flows: pd.DataFrame, judged: pd.DataFrame) -> dict[str, dict]:
    """Coefficients of each law with the least squares of ln L, and its rms error there and in other
    flows.
    """
    flows, judged = (some[some.nu <= DENSEST] for some in (flows, judged))
    result = {}
    for name, (law, start) in LAWS_OF_LENGTH.items():

        def misfit(coefficients: Any, some: pd.DataFrame = flows, law: Callable = law) -> Any:
            return np.log(law(some, coefficients) * some.dissipation)

        fit = least_squares(misfit, start, bounds=(1e-3, 10)).x
        errors = {"rms": rms(misfit(fit)), "rms_judged": rms(misfit(fit, judged))}
        result[name] = {"coefficients": fit.tolist(), **errors}
    return result


# The corrected theory


def fitted_laws(flows: pd.DataFrame) -> tuple[CorrelationLaws, dict[str, np.ndarray]]:
    """The laws of L′ and of the pairs at contact with the least squares of their logarithms, and
    the standard errors of their coefficients.

    A flow counts as much as the area of the plane of ln(1 − α) and ν that it stands for.
    """
    laws, stderrs = MEASURED_LAWS, {}
    roots = np.sqrt(areas(flows.alpha.to_numpy(), flows.nu.to_numpy()))
    for name, (*_, start) in LAWS.items():

        def weighted(coefficients: Any, laws: CorrelationLaws = laws, name: str = name) -> Any:
            return roots * law_misfit(laws._replace(**{name: coefficients}), flows, name)

        fit = least_squares(weighted, start, x_scale="jac", bounds=(0, np.inf))
        scatter = fit.fun @ fit.fun / (fit.fun.size - fit.x.size)
        stderrs[name] = np.sqrt(np.diag(scatter * np.linalg.inv(fit.jac.T @ fit.jac)))
        laws = laws._replace(**{name: fit.x})
    return laws, stderrs


def areas(alphas: np.ndarray, nus: np.ndarray) -> np.ndarray:
    """The area of the plane of ln(1 − α) and ν that each point of a grid stands for, over the
    mean.
    """
    area = np.ones(nus.size)
    for x in (-np.log(1 - alphas), nus):
        values, place = np.unique(x, return_inverse=True)
        area *= np.gradient(values)[place]
    return area / area.mean()


def law_misfit(laws: CorrelationLaws, flows: pd.DataFrame, name: str) -> np.ndarray:
    """Logarithm of a law over what is measured."""
    law, measured, _ = LAWS[name]
    values = law(laws, flows.alpha.to_numpy(), flows.nu.to_numpy())
    return np.log(np.asarray(values) / flows[measured].to_numpy())


def misfits(laws: CorrelationLaws, flows: pd.DataFrame) -> dict[str, np.ndarray]:
    """Logarithms of the laws over what is measured, and the same of the corrected theory."""
    shear = corrected(laws, flows.alpha.to_numpy(), flows.nu.to_numpy())
    return {name: law_misfit(laws, flows, name) for name in LAWS} | {
        name: np.log(np.asarray(getattr(shear, field)) / flows[name].to_numpy())
        for name, field in PREDICTED.items()
    }


def corrected_theory(flows: pd.DataFrame, judged: pd.DataFrame) -> dict:
    """The laws and their standard errors; rms errors of laws and theory in other flows, and of laws
    that were fitted without the densest flows in these; and errors with and without the laws.
    """
    laws, stderrs = fitted_laws(flows)
    errors = {"enskog": misfits(WITHOUT_LAWS, judged), "length_and_pairs": misfits(laws, judged)}
    elsewhere = errors["length_and_pairs"]
    densest = flows.nu == flows.nu.max()
    left_out = misfits(fitted_laws(flows[~densest])[0], flows[densest])
    return {
        "laws": {
            **{name: np.asarray(getattr(laws, name)).tolist() for name in LAWS},
            **{f"{name}_stderr": stderr.tolist() for name, stderr in stderrs.items()},
            "scatter": [rms(elsewhere[name]) for name in PREDICTED],
        },
        "rms_judged": {name: rms(elsewhere[name]) for name in LAWS},
        "rms_densest_left_out": {name: rms(error) for name, error in left_out.items()},
    } | {
        theory: {
            average: {
                "rms": rms(misfit[average]),
                "within_10_percent": int((abs(np.expm1(misfit[average])) < 0.1).sum()),
            }
            for average in PREDICTED
        }
        for theory, misfit in errors.items()
    }


@styled
def draw(flows: pd.DataFrame, judged: pd.DataFrame, laws: CorrelationLaws) -> Figure:
    """L′ against the packing fraction with its law, and predicted over measured pressure at flows
    of another map.
    """
    figure = Figure(figsize=(TWO_COLUMNS, 3.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    dense = np.linspace(flows.nu.min(), flows.nu.max(), 200)
    for alpha, style in zip(DRAWN, curve_styles(len(DRAWN)), strict=True):
        some = flows[flows.alpha == alpha]
        look = {**style, "markersize": 4, "linestyle": "none", "label": rf"$\alpha$ = {alpha:g}"}
        left.errorbar(some.nu, some.length_from_pressure, some.length_from_pressure_error, **look)
        law = np.asarray(correlation_length(laws, np.full_like(dense, alpha), dense))
        left.plot(dense, law, color=style["color"], linestyle="-", linewidth=1)
    looks = ("Enskog", WITHOUT_LAWS, "none", 0.004), ("corrected", laws, "0", -0.004)
    for label, applied, face, shift in looks:
        ratio = np.exp(misfits(applied, judged)["pressure"])
        look = {"color": "0", "markerfacecolor": face, "markersize": 4.5, "label": label}
        right.plot(judged.nu + shift, ratio, "o", **look)
    right.axhspan(0.9, 1.1, color="0.9", zorder=0, label=r"within 10 %")
    left.set_ylabel(r"correlation length $L'/\sigma$")
    right.set_ylabel("predicted / measured pressure")
    for axes, place in ((left, "upper left"), (right, "lower left")):
        axes.set(yscale="log", xlabel=r"packing fraction $\nu$")
        axes.axhline(1, color="0.6", linewidth=0.8, zorder=0)
        axes.legend(fontsize=SMALL_SIZE, frameon=False, loc=place)
        label_log_axis(axes.yaxis)
    return figure
