"""Are dense flows compatible with the exponents that are published for the jamming transition?

Reads the 16 flows of ``python -m benchmarks dense_rheology`` (N = 1000, 0.79 ≤ ν ≤ 0.83) and those
of ``dense_flows`` (N = 4000, from ν = 0.83 on), and fits packing fraction and friction by

    ν(I) = ν_c − k I^c − k₂ I^d,        μ(I) = μ₀ + a I^c + a₂ I^d,

with c fixed to 0.40, which is 2/β with β = 5.0 ± 0.4 (Vågberg, Olsson and Teitel, Phys. Rev. E 93,
052902, 2016), or to 0.35 (DeGiuli, Düring, Lerner and Wyart, Phys. Rev. E 91, 062206, 2015), and
with the correction to scaling d fixed to 2c or to 1; the spread over these choices is the model
error. A fit whose k is negative contradicts its law. Beside them stand the fits of one power law
with a free exponent, to all flows and without the loosest: an exponent that goes on falling is an
effective one. The exponent δ of p/T ∝ (ν_c − ν)^(−δ) is fitted with each ν_c; 2 is published
(Otsuki, Hayakawa and Luding, Prog. Theor. Phys. Suppl. 184, 110, 2010).

Least squares with the effective variance, that of the ordinate plus that of I times the squared
slope; the correlation of the errors of μ and I, which the file does not hold, is left out.

    python -m benchmarks dense_limit   # a second
"""

import json
from typing import Any, NamedTuple

import numpy as np
import scipy.optimize
from matplotlib.figure import Figure

from benchmarks.least_squares import weighted_fit
from benchmarks.output import RESULTS, Output, rounded
from jaxgran.plotting.style import (
    NU_LABEL,
    SMALL_SIZE,
    TWO_COLUMNS,
    curve_styles,
    label_log_axis,
    styled,
)

EXPONENTS = (0.40, 0.35)
LOOSEST = (0.79, 0.81, 0.82)  # smallest packing fraction of a fit with a free exponent
ROUNDS = 30  # of the effective variance
LEAST_EXPONENT, LARGEST_EXPONENT = (
    0.05,
    4.0,
)  # of a free fit; an exponent at a bound is not determined


class Fit(NamedTuple):
    """A fit of y = offset + Σ coefficient · I^exponent."""

    offset: float
    offset_error: (
        float  # standard error; times the square root of the reduced χ² where that is above one
    )
    coefficients: tuple[float, ...]  # of the powers
    reduced_chi_squared: float


def fit(
    number: np.ndarray,
    number_error: np.ndarray,
    y: np.ndarray,
    y_error: np.ndarray,
    *exponents: float,
) -> Fit:
    """Fit the offset and a coefficient for each exponent to points with errors in both
    coordinates.
    """
    design = np.stack([np.ones_like(number), *(number**p for p in exponents)], axis=1)
    slopes = np.stack([np.zeros_like(number), *(p * number ** (p - 1) for p in exponents)], axis=1)
    constants, *_ = weighted_fit(design, y, np.ones_like(y))
    for _ in range(ROUNDS):
        deviation = np.hypot(y_error, slopes @ constants * number_error)
        constants, covariance, chi_squared = weighted_fit(design, y, deviation)
    reduced = chi_squared / (len(y) - len(constants))
    return Fit(
        constants[0], np.sqrt(covariance[0, 0] * max(1.0, reduced)), tuple(constants[1:]), reduced
    )


def ratio_exponent(points: dict[str, np.ndarray], critical: float) -> tuple[float, float]:
    """δ of p/T ∝ (ν_c − ν)^(−δ) for a given ν_c, with its standard error."""
    relative = np.hypot(
        points["pressure_stderr"] / points["pressure"],
        points["granular_temperature_stderr"] / points["granular_temperature"],
    )
    design = np.stack(
        [np.ones_like(relative), -np.log(critical - points["packing_fraction"])], axis=1
    )
    logarithm = np.log(points["pressure"] / points["granular_temperature"])
    constants, covariance, chi_squared = weighted_fit(design, logarithm, relative)
    reduced = max(1.0, chi_squared / (len(relative) - 2))
    return constants[1], np.sqrt(covariance[1, 1] * reduced)


def free_fit(points: dict[str, np.ndarray], ordinate: str) -> dict[str, Any]:
    """Offset and exponent of one power law of I, each with its standard error, and the reduced
    χ².
    """
    number, number_error = points["inertial_number"], points["inertial_number_stderr"]
    exact = np.zeros_like(number)
    error, sign = (
        points.get(f"{ordinate}_stderr", exact),
        -1.0 if ordinate == "packing_fraction" else 1.0,
    )
    (offset, exponent), (offset_error, exponent_error), chi_squared = fit_power_law(
        number, points[ordinate], number_error, error, sign
    )
    found = {
        "offset": [offset, offset_error],
        "exponent": [exponent, exponent_error],
        "reduced_chi_squared": chi_squared,
    }
    return rounded(found, 4)


def fit_power_law(
    x: np.ndarray, y: np.ndarray, x_error: np.ndarray, y_error: np.ndarray, sign: float
) -> tuple[tuple[float, float], tuple[float, float], float]:
    """Offset and exponent of y = offset ± coefficient · x^exponent, their standard errors, and the
    reduced χ².
    """
    scale = x.max()  # so that coefficient and offset are of similar size
    parameters, covariance, deviation = (
        np.array([y[x.argmin()], max(np.ptp(y), 1e-3), 0.5]),
        np.eye(3),
        y_error,
    )

    def law(number, offset, coefficient, exponent):
        return offset + sign * coefficient * number**exponent

    def slopes(number, _, coefficient, exponent):
        power = number**exponent
        return np.stack(
            [np.ones_like(number), sign * power, sign * coefficient * power * np.log(number)],
            axis=-1,
        )

    for _ in range(ROUNDS):
        previous, (_, coefficient, exponent) = parameters, parameters
        slope = sign * coefficient * exponent * (x / scale) ** (exponent - 1) / scale
        deviation = np.sqrt(np.maximum(y_error**2 + (slope * x_error) ** 2, 1e-18))
        bounds = [-np.inf, 0.0, LEAST_EXPONENT], [np.inf, np.inf, LARGEST_EXPONENT]
        parameters, covariance = scipy.optimize.curve_fit(
            law, x / scale, y, previous, deviation, absolute_sigma=True, bounds=bounds, jac=slopes
        )
        if np.allclose(parameters, previous, rtol=1e-6):
            break
    chi_squared = float(np.sum(((y - law(x / scale, *parameters)) / deviation) ** 2) / (len(x) - 3))
    errors = np.sqrt(np.diagonal(covariance) * max(1.0, chi_squared))
    return (
        (float(parameters[0]), float(parameters[2])),
        (float(errors[0]), float(errors[2])),
        chi_squared,
    )


def free_fits(points: dict[str, np.ndarray]) -> list[dict[str, Any]]:
    """The fits of one power law to packing fraction and friction, a row for each smallest packing
    fraction.
    """
    rows = []
    for least in LOOSEST:
        chosen = {
            name: values[points["packing_fraction"] >= least] for name, values in points.items()
        }
        laws = {
            name: free_fit(chosen, name) for name in ("packing_fraction", "macroscopic_friction")
        }
        rows.append(
            {"least_packing_fraction": least, "points": len(chosen["packing_fraction"]), **laws}
        )
    return rows


def corrected_fits(points: dict[str, np.ndarray]) -> list[dict[str, Any]]:
    """A row for each exponent and each correction to scaling."""
    number, number_error = points["inertial_number"], points["inertial_number_stderr"]
    exact = np.zeros_like(number)
    rows = []
    for exponent in EXPONENTS:
        for correction in (2 * exponent, 1.0):
            fraction = fit(
                number, number_error, points["packing_fraction"], exact, exponent, correction
            )
            friction = fit(
                number,
                number_error,
                points["macroscopic_friction"],
                points["macroscopic_friction_stderr"],
                exponent,
                correction,
            )
            found = {
                "critical_packing_fraction": list(fraction[:2]),
                "friction_at_onset": list(friction[:2]),
                "leading_coefficients": [-fraction.coefficients[0], friction.coefficients[0]],
                "reduced_chi_squared": [fraction.reduced_chi_squared, friction.reduced_chi_squared],
                "exponent_of_pressure_over_temperature": list(
                    ratio_exponent(points, fraction.offset)
                ),
            }
            rows.append({"exponent": exponent, "correction": correction, **rounded(found, 5)})
    return rows


@styled
def draw(points: dict[str, np.ndarray], free: list[dict[str, Any]]) -> Figure:
    """Friction and packing fraction against the inertial number, with one power law and two of
    published exponents.
    """
    figure = Figure(figsize=(TWO_COLUMNS, 3.1), layout="constrained")
    panels = figure.subplots(1, 2)
    flows = {
        r"$N=1000$, $\alpha=0.2$": (points["grains"] == 1000) & (points["restitution"] == 0.2),
        r"$N=1000$, $\alpha=0.5$": (points["grains"] == 1000) & (points["restitution"] == 0.5),
        r"$N=4000$, $\alpha=0.2$": points["grains"] == 4000,
    }
    number, number_error = points["inertial_number"], points["inertial_number_stderr"]
    along = np.geomspace(0.5 * number.min(), number.max(), 200)
    labels = {"macroscopic_friction": r"friction $\mu$", "packing_fraction": NU_LABEL}
    for axes, (name, label) in zip(panels, labels.items(), strict=True):
        error = points.get(f"{name}_stderr", np.zeros_like(number))
        powers = {"one power law, free": (free[0][name]["exponent"][0],)} | {
            rf"$c={c:g}$ with a correction $I$": (c, 1.0) for c in EXPONENTS
        }
        for (title, exponents), line in zip(powers.items(), ("-", "--", ":"), strict=True):
            law = fit(number, number_error, points[name], error, *exponents)
            terms = (a * along**p for a, p in zip(law.coefficients, exponents, strict=True))
            axes.plot(
                along,
                law.offset + sum(terms),
                color="0.35",
                linestyle=line,
                linewidth=1,
                label=title,
            )
        for (title, chosen), style in zip(flows.items(), curve_styles(len(flows)), strict=True):
            style |= {"linestyle": "none", "markersize": 4, "label": title}
            bars = {"xerr": number_error[chosen], "yerr": error[chosen]}
            axes.errorbar(number[chosen], points[name][chosen], **bars, elinewidth=0.8, **style)
        axes.set(xscale="log", xlabel="inertial number $I$", ylabel=label)
        label_log_axis(axes.xaxis)
    handles, names = panels[0].get_legend_handles_labels()
    figure.legend(
        handles, names, loc="outside lower center", ncols=3, fontsize=SMALL_SIZE, frameon=False
    )
    return figure


def measured() -> tuple[list[str], dict[str, np.ndarray]]:
    """Commits of the two studies, and the averages of their flows whose status is ok."""
    studies = [
        json.loads((RESULTS / f"{name}.json").read_text())
        for name in ("dense_rheology", "dense_flows")
    ]
    flows = []
    for study in studies:
        grains = study["grains"] if "grains" in study else study["plan"]["grains"]
        flows += [{**row, "grains": grains} for row in study["points"] if row["status"] == 0]
    names = [*studies[0]["points"][0], "grains"]
    return [study["hardware"]["commit"] for study in studies], {
        name: np.array([row[name] for row in flows]) for name in names
    }


def run(output: Output) -> None:
    """Fit, print a line for each fit, and write them as JSON and PNG."""
    commits, points = measured()
    rows, free = corrected_fits(points), free_fits(points)
    for row in (*free, *rows):
        print(", ".join(f"{name} {value}" for name, value in row.items()))
    onset = [
        *(row["macroscopic_friction"]["offset"][0] for row in free),
        *(row["friction_at_onset"][0] for row in rows),
    ]
    critical = free[0]["packing_fraction"]["offset"][0]
    head = {
        "studies": commits,
        "points": len(points["status"]),
        "largest_packing_fraction": float(points["packing_fraction"].max()),
        "smallest_inertial_number": float(points["inertial_number"].min()),
        "power_laws": free,
        "exponent_of_pressure_over_temperature": rounded(list(ratio_exponent(points, critical)), 5),
        "friction_at_onset_of_all_fits": [min(onset), max(onset)],
    }
    output.write_rows("dense_limit", head, "rows", rows)
    output.write_picture(draw(points, free), "dense_limit")
