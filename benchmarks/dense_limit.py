"""Are the flows of ``dense_rheology`` compatible with the exponents that are published for the jamming transition?

Reads the 16 flows of ``python -m benchmarks dense_rheology`` (0.79 ≤ ν ≤ 0.83), and fits packing fraction and friction
by

    ν(I) = ν_c − k I^c − k₂ I^d,        μ(I) = μ₀ + a I^c + a₂ I^d,

with c fixed to 0.40, which is 2/β with β = 5.0 ± 0.4 (Vågberg, Olsson and Teitel, Phys. Rev. E 93, 052902, 2016), or to
0.35 (DeGiuli, Düring, Lerner and Wyart, Phys. Rev. E 91, 062206, 2015), and with the correction to scaling d fixed to
2c or to 1; the spread over these choices is the model error. A fit whose k is negative contradicts its law. Beside
them stands the fit of one power law with a free exponent.
The exponent δ of p/T ∝ (ν_c − ν)^(−δ) is fitted with each ν_c; 2 is published (Otsuki, Hayakawa and Luding, Prog.
Theor. Phys. Suppl. 184, 110, 2010).

Least squares with the effective variance, that of the ordinate plus that of I times the squared slope; the correlation
of the errors of μ and I, which the file does not hold, is left out.

    python -m benchmarks dense_limit   # a second
"""

import json
from typing import Any, NamedTuple

import numpy as np

from benchmarks.least_squares import weighted_fit
from benchmarks.output import RESULTS, Output, rounded

EXPONENTS = (0.40, 0.35)
ROUNDS = 30  # of the effective variance


class Fit(NamedTuple):
    """A fit of y = offset + Σ coefficient · I^exponent."""

    offset: float
    offset_error: float  # standard error; times the square root of the reduced χ² where that is above one
    leading: float  # coefficient of the first exponent
    reduced_chi_squared: float


def fit(number: np.ndarray, number_error: np.ndarray, y: np.ndarray, y_error: np.ndarray, *exponents: float) -> Fit:
    """Fit the offset and a coefficient for each exponent to points with errors in both coordinates."""
    design = np.stack([np.ones_like(number), *(number**p for p in exponents)], axis=1)
    slopes = np.stack([np.zeros_like(number), *(p * number ** (p - 1) for p in exponents)], axis=1)
    constants, *_ = weighted_fit(design, y, np.ones_like(y))
    for _ in range(ROUNDS):
        deviation = np.hypot(y_error, slopes @ constants * number_error)
        constants, covariance, chi_squared = weighted_fit(design, y, deviation)
    reduced = chi_squared / (len(y) - len(constants))
    return Fit(constants[0], np.sqrt(covariance[0, 0] * max(1.0, reduced)), constants[1], reduced)


def ratio_exponent(points: dict[str, np.ndarray], critical: float) -> tuple[float, float]:
    """δ of p/T ∝ (ν_c − ν)^(−δ) for a given ν_c, with its standard error."""
    relative = np.hypot(
        points["pressure_stderr"] / points["pressure"],
        points["granular_temperature_stderr"] / points["granular_temperature"],
    )
    design = np.stack([np.ones_like(relative), -np.log(critical - points["packing_fraction"])], axis=1)
    logarithm = np.log(points["pressure"] / points["granular_temperature"])
    constants, covariance, chi_squared = weighted_fit(design, logarithm, relative)
    reduced = max(1.0, chi_squared / (len(relative) - 2))
    return constants[1], np.sqrt(covariance[1, 1] * reduced)


def corrected_fits(points: dict[str, np.ndarray]) -> list[dict[str, Any]]:
    """A row for each exponent and each correction to scaling."""
    number, number_error = points["inertial_number"], points["inertial_number_stderr"]
    exact = np.zeros_like(number)
    rows = []
    for exponent in EXPONENTS:
        for correction in (2 * exponent, 1.0):
            fraction = fit(number, number_error, points["packing_fraction"], exact, exponent, correction)
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
                "leading_coefficients": [-fraction.leading, friction.leading],
                "reduced_chi_squared": [fraction.reduced_chi_squared, friction.reduced_chi_squared],
                "exponent_of_pressure_over_temperature": list(ratio_exponent(points, fraction.offset)),
            }
            rows.append({"exponent": exponent, "correction": correction, **rounded(found, 5)})
    return rows


def run(output: Output) -> None:
    """Fit, print a line for each fit, and write them as JSON."""
    study = json.loads((RESULTS / "dense_rheology.json").read_text())
    flows = [row for row in study["points"] if row["status"] == 0]
    points = {name: np.array([row[name] for row in flows]) for name in flows[0]}
    free = next(row for row in study["rows"] if row["mixture"] == "uniform" and row["restitution"] == "all")
    rows = corrected_fits(points)
    for row in rows:
        print(", ".join(f"{name} {value}" for name, value in row.items()))
    onset = [free["friction_at_onset"], *(row["friction_at_onset"][0] for row in rows)]
    head = {
        "study": study["hardware"]["commit"],
        "points": len(flows),
        "one_power_law": {
            "critical_packing_fraction": [free["critical_packing_fraction"], free["critical_packing_fraction_stderr"]],
            "exponent": [free["c"], free["c_stderr"]],
            "friction_at_onset": [free["friction_at_onset"], free["friction_at_onset_stderr"]],
            "exponent_of_pressure_over_temperature": rounded(
                list(ratio_exponent(points, free["critical_packing_fraction"])), 5
            ),
        },
        "friction_at_onset_of_all_fits": [min(onset), max(onset)],
    }
    output.write_rows("dense_limit", head, "rows", rows)
