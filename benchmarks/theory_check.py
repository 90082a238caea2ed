"""Kinetic theory against measured stresses where it should hold: nearly elastic flows that are not dense.

Maps α from 0.8 to 0.95 and ν from 0.1 to 0.6 until force ratio and stresses have a relative standard error of 1 %, and
prints what each theory predicts over what is measured.

    python -m benchmarks theory_check           # about 10 minutes on two cores
    python -m benchmarks theory_check --quick   # four points to 5 %, about a minute
"""

from matplotlib.figure import Figure

import jaxgran as jg
from benchmarks.output import Output
from jaxgran.environment import usable_cores
from jaxgran.theory.gaussian_moments import gaussian_moments
from jaxgran.theory.navier_stokes import garzo_dufty, jenkins_richman

THEORIES = {"moments": gaussian_moments, "Garzó–Dufty": garzo_dufty, "Jenkins–Richman": jenkins_richman}
NAMES = ("pressure", "shear_stress", "granular_temperature", "collision_rate")
BAND = 5.0  # percent, drawn for the eye


def run(output: Output) -> None:
    """Map, print what each theory predicts over what is measured, and write JSON and PNG."""
    data = jg.ratio_map(
        [0.8, 0.9] if output.quick else [0.8, 0.9, 0.95],
        [0.2, 0.6] if output.quick else [0.1, 0.2, 0.4, 0.6],
        grains=128 if output.quick else 400,
        seeds=2,
        timestep="auto",
        error=0.15 if output.quick else 0.03,  # of which sampling takes a standard error of a third
        workers=usable_cores(),
    )
    rows = [
        row(data, float(nu), float(alpha), name)
        for nu in data.packing_fraction
        for alpha in data.restitution
        for name in NAMES
    ]
    print("    ν     α  observable                 measured        theory over measured: " + ", ".join(THEORIES))
    for one in rows:
        theories = "".join(f"{one[name]:9.3f}" for name in THEORIES)
        measured = f"{one['value']:9.4g} ± {one['error']:7.2g}"
        print(f"{one['nu']:5.2f}{one['alpha']:6.2f}  {one['observable']:22s}{measured}{theories}")
    worst = max(abs(one["moments"] - 1) for one in rows if one["observable"] == "pressure")
    print(f"largest error of the moments in pressure: {100 * worst:.1f} %")
    output.write_rows("theory_check", {"run": {k: str(v) for k, v in data.attrs.items()}}, "rows", rows)
    output.write_picture(draw(rows), "theory_check")


def row(data, nu: float, alpha: float, name: str) -> dict:
    """One observable of one point, and each theory's prediction over it."""
    here = data.sel(packing_fraction=nu, restitution=alpha)
    value, error = float(here[name]), float(here[f"{name}_stderr"])
    predictions = {key: float(getattr(theory(alpha, nu), name)) / value for key, theory in THEORIES.items()}
    return {"nu": nu, "alpha": alpha, "observable": name, "value": value, "error": error, **predictions}


def draw(rows: list[dict]) -> Figure:
    """Theory over measured against packing fraction, a panel for each observable and a symbol for each theory and α."""
    alphas = sorted({row["alpha"] for row in rows})
    figure = Figure(figsize=(8.0, 6.4), layout="constrained")
    for axes, name in zip(figure.subplots(2, 2, sharex=True).flat, NAMES, strict=True):
        axes.axhline(1, color="0.6")
        axes.axhspan(1 - BAND / 100, 1 + BAND / 100, color="0.92", zorder=0)
        for k, alpha in enumerate(alphas):
            for (key, line), grey in zip(
                zip(THEORIES, ("-", "--", ":"), strict=True), ("0", "0.35", "0.6"), strict=True
            ):
                some = [row for row in rows if row["observable"] == name and row["alpha"] == alpha]
                axes.errorbar(
                    [row["nu"] for row in some],
                    [row[key] for row in some],
                    [row[key] * row["error"] / row["value"] for row in some],
                    color=grey,
                    linestyle=line,
                    marker="os^"[k],
                    markersize=4,
                    capsize=2,
                    label=f"{key}, α = {alpha:g}",
                )
        axes.set_title(name.replace("_", " "))
    figure.supxlabel("packing fraction ν (grey: within 5 %)")
    figure.supylabel("theory over measured")
    figure.legend(
        *figure.axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=len(alphas), fontsize="small"
    )
    return figure
