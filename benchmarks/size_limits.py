"""What are pressure, shear stress and temperatures of a large system, and how are they approached?

Reads the flows of ``python -m benchmarks size_study`` with ν ≤ 0.7 and N ≥ 400 and fits three laws of two parameters to
each average by weighted least squares: x∞ − a N^(−1/3), which long waves of velocity with an energy ∝ k^(−4/3) give in
two dimensions, x∞ − a N^(−1/2), which k^(−1) gives, and a + b ln N, which has no limit and which k^(−2) gives. χ² over
all flows says which laws the averages allow. The interval of a limit spans the 95 % intervals of the two laws that
have one.

    python -m benchmarks size_limits   # a second
"""

import json
from collections.abc import Callable

import numpy as np
from scipy.stats import chi2

from benchmarks.least_squares import weighted_fit
from benchmarks.output import RESULTS, Output, rounded

AVERAGES = ("pressure", "shear_stress", "granular_temperature", "local_granular_temperature")
LAWS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "N^(-1/3)": lambda grains: grains ** (-1 / 3),
    "N^(-1/2)": lambda grains: grains**-0.5,
    "ln N": np.log,
}
WITH_LIMIT = ("N^(-1/3)", "N^(-1/2)")
LARGEST_FRACTION, LEAST_GRAINS = 0.7, 400


def fitted(grains: np.ndarray, values: np.ndarray, errors: np.ndarray, law: str) -> tuple[float, float, float]:
    """The constant of a law, which is the limit where it has one, its standard error, and χ²."""
    design = np.stack([np.ones(len(grains)), LAWS[law](grains)], axis=1)
    constants, covariance, chi_squared = weighted_fit(design, values, errors)
    return constants[0], np.sqrt(covariance[0, 0]), chi_squared


def fits_of(rows: list[dict], average: str) -> dict:
    """One average of one flow: its limit by each law with a standard error, the interval of both, and χ²."""
    grains = np.array([row["grains"] for row in rows], float)
    values, errors = np.array([row[average] for row in rows]).T
    fits = {law: fitted(grains, values, errors, law) for law in LAWS}
    ends = [fits[law][0] + sign * 1.96 * fits[law][1] for law in WITH_LIMIT for sign in (-1, 1)]
    return {
        "largest": [float(grains[-1]), values[-1], errors[-1]],
        "limit": {law: list(fits[law][:2]) for law in WITH_LIMIT},
        "interval": [min(ends), max(ends)],
        "chi_squared": {law: fits[law][2] for law in LAWS},
        "freedom": len(rows) - 2,
    }


def limits(study: list[dict]) -> list[dict]:
    """A row for each loose flow of the study and each average."""
    chosen = [row for row in study if row["packing_fraction"] <= LARGEST_FRACTION and row["grains"] >= LEAST_GRAINS]
    flows = sorted({(row["restitution"], row["packing_fraction"]) for row in chosen})
    return [
        {
            "restitution": alpha,
            "packing_fraction": nu,
            "average": average,
            **fits_of([row for row in chosen if (row["restitution"], row["packing_fraction"]) == (alpha, nu)], average),
        }
        for alpha, nu in flows
        for average in AVERAGES
    ]


def law_totals(rows: list[dict]) -> list[dict]:
    """χ² of each law over all flows, with the probability of a larger one."""
    found = []
    for average in AVERAGES:
        here = [row for row in rows if row["average"] == average]
        freedom = sum(row["freedom"] for row in here)
        total = {law: sum(row["chi_squared"][law] for row in here) for law in LAWS}
        probability = {law: float(chi2.sf(x, freedom)) for law, x in total.items()}
        found.append({"average": average, "freedom": freedom, "chi_squared": total, "probability": probability})
    return found


def run(output: Output) -> None:
    """Fit, print the tables of the page on the number of grains, and write them as JSON."""
    study = json.loads((RESULTS / "size_study.json").read_text())
    rows = limits(study["flows"])
    laws = law_totals(rows)
    for law in laws:
        print(law["average"], law["freedom"], {name: round(float(x), 1) for name, x in law["chi_squared"].items()})
    for row in rows:
        each = ", ".join(f"{law}: {value:.4g} ± {error:.2g}" for law, (value, error) in row["limit"].items())
        low, high = row["interval"]
        print(f"{row['restitution']:4g} {row['packing_fraction']:4g} {row['average']}: {each}; {low:.4g} to {high:.4g}")
    head = {"study": study["hardware"]["commit"], "laws": rounded(laws, 5)}
    output.write_rows("size_limits", head, "rows", rounded(rows, 5))
