"""How well a closure fitted to a map predicts points it has not seen, and finds a restitution from their stresses.

Every point of a map of 30 is predicted by the closure that is fitted to the other 29. Errors are relative, and stand
beside the noise of the point itself, which no closure can predict. Points on the edge of the map, where the closure
extrapolates, are told apart from those inside.

    python -m benchmarks closure_study             # maps as `jaxgran map` does first, about 2 minutes on two cores
    python -m benchmarks closure_study MAP.nc      # the same of a map that there is
    python -m benchmarks closure_study --quick     # small flows, large errors, a minute
"""

from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter, PercentFormatter, StrMethodFormatter

import jaxgran as jg
from benchmarks.output import Output, rounded
from jaxgran.environment import usable_cores
from jaxgran.inference.closure import LAWS
from jaxgran.inference.cross_validation import leave_one_out
from jaxgran.maps.presets import PRESETS
from jaxgran.maps.results import open_map

SMALLER = {"grains": 64, "seeds": 1, "strain": 20.0}
NAMES = ("pressure", "shear_stress", "force_ratio")
TARGETS = {"pressure": 0.05, "force_ratio": 0.08}
STYLES = (("0.0", "o"), ("0.2", "s"), ("0.4", "^"), ("0.5", "D"), ("0.6", "v"))  # of the restitutions, in turn


def run(output: Output, dataset: Path | None = None) -> None:
    """Fit, leave out, print, and write JSON and PNG; of a dataset of a map, or of one that is made."""
    data = make_map(output.quick) if dataset is None else open_map(dataset)
    errors, closure = leave_one_out(data), jg.fit_closure(data)
    summary = {name: error_summary(errors, name) for name in NAMES} | {"restitution": restitution_summary(errors)}
    print("relative errors of points left out, in percent")
    print("               rms   inside     edge  largest  noise of a point   pulls   target")
    for key in NAMES:
        one = summary[key]
        shown = "".join(f"{100 * one[k]:9.1f}" for k in ("rms", "inside", "edge", "largest"))
        target = f"{100 * TARGETS[key]:9.0f}" if key in TARGETS else ""
        print(f"{key:12s}{shown[3:]}{100 * one['noise']:18.1f}{one['pull']:8.2f}{target}")
    print("restitution from stresses: error and quoted standard error (rms over the packing fractions)")
    for row in summary["restitution"]["by_restitution"]:
        end = "   end of the range, which no estimate leaves" if row["at_end"] else ""
        print("  α = {restitution:4.2f}   {rms:6.3f}   {quoted:6.3f}".format(**row) + end)
    print(f"  pulls, rms: {summary['restitution']['pull']:.2f}")
    made_by = {k: str(v) for k, v in data.attrs.items()}
    head = {"run": made_by, "closure": coefficients(closure), "summary": summary}
    output.write_rows("closure", rounded(head, 5), "points", rounded(rows(data, errors), 5))
    output.write_picture(draw(data, errors), "closure")


def make_map(quick: bool) -> xr.Dataset:
    """The map that the command line makes first, or a smaller one."""
    return jg.ratio_map(**PRESETS["quick"] | (SMALLER if quick else {}), workers=usable_cores())


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.nanmean(np.square(values))))


def error_summary(errors: xr.Dataset, name: str) -> dict[str, float]:
    """Root mean squares of the errors of all points, those inside and on the edge, of their noise and of the pulls."""
    error, edge = errors[f"{name}_error"].values, errors.edge.values
    return {
        "rms": rms(error),
        "inside": rms(error[~edge]),
        "edge": rms(error[edge]),
        "largest": float(np.nanmax(np.abs(error))),
        "largest_inside": float(np.nanmax(np.abs(error[~edge]))),
        "noise": rms(errors[f"{name}_noise"].values),
        "pull": rms(error / errors[f"{name}_stderr"].values),
    }


def restitution_summary(errors: xr.Dataset) -> dict:
    """Errors of the restitutions found from stresses, of each restitution, and all pulls."""
    error = errors.restitution_found - errors.restitution
    by_restitution = [
        {
            "restitution": float(alpha),
            "at_end": bool(alpha in (errors.restitution.min(), errors.restitution.max())),
            "rms": rms(error.sel(restitution=alpha).values),
            "quoted": rms(errors.restitution_stderr.sel(restitution=alpha).values),
        }
        for alpha in errors.restitution
    ]
    pulls = (error / errors.restitution_stderr).values
    inside = (errors.restitution > errors.restitution.min()) & (errors.restitution < errors.restitution.max())
    return {
        "rms": rms(error.values),
        "pull": rms(pulls),
        "pull_inside_the_range": rms(pulls[:, inside.values]),
        "by_restitution": by_restitution,
    }


def coefficients(closure: jg.Closure) -> dict:
    """Coefficients of each law with standard errors, and its scatter."""
    return {
        name: {
            "coefficients": np.asarray(law.coefficients).tolist(),
            "standard_errors": np.sqrt(np.diag(law.covariance)).tolist(),
            "scatter": float(law.scatter),
        }
        for name, law in ((name, getattr(closure, name)) for name in LAWS)
    }


def rows(data: xr.Dataset, errors: xr.Dataset) -> list[dict]:
    """One row a point."""
    return [
        {
            "restitution": float(alpha),
            "packing_fraction": float(nu),
            "edge": bool(errors.edge.sel(restitution=alpha, packing_fraction=nu)),
            **{name: float(data[name].sel(restitution=alpha, packing_fraction=nu)) for name in NAMES},
            **{
                str(name): float(value.sel(restitution=alpha, packing_fraction=nu))
                for name, value in errors.items()
                if name != "edge"
            },
        }
        for nu in errors.packing_fraction.values
        for alpha in errors.restitution.values
    ]


def draw(data: xr.Dataset, errors: xr.Dataset) -> Figure:
    """Predicted against measured pressure and force ratio, and under each the relative error with its expected size."""
    figure = Figure(figsize=(9.0, 6.2), layout="constrained")
    grid = figure.subplots(2, 2, sharex="col", height_ratios=(1.5, 1.0))
    for (above, below), (name, label) in zip(
        grid.T, {"pressure": r"pressure $P$ ($m\dot\gamma^2$)", "force_ratio": "force ratio"}.items(), strict=True
    ):
        ends = np.array([data[name].min() * 0.85, data[name].max() * 1.2])
        above.plot(ends, ends, color="0.6", lw=0.8, zorder=1)
        below.axhline(0, color="0.6", lw=0.8, zorder=1)
        if name in TARGETS:
            below.axhspan(-TARGETS[name], TARGETS[name], color="0.92", zorder=0)
        for k, alpha in enumerate(errors.restitution.values):
            grey, marker = STYLES[k % len(STYLES)]
            here, seen = errors.sel(restitution=alpha), data[name].sel(restitution=alpha)
            faces = ["white" if edge else grey for edge in here.edge.values]
            style = {"marker": marker, "s": 26, "edgecolors": grey, "facecolors": faces, "zorder": 3}
            above.scatter(seen, here[f"{name}_predicted"], **style)
            below.errorbar(
                seen, here[f"{name}_error"], here[f"{name}_stderr"], color=grey, ls="", elinewidth=0.8, capsize=2
            )
            below.scatter(seen, here[f"{name}_error"], **style)
            above.scatter([], [], marker=marker, s=26, color=grey, label=f"α = {alpha:g}")
        above.set(xscale="log", yscale="log", xlim=ends, ylim=ends, ylabel=f"{label}, predicted")
        below.set(xlabel=f"{label}, measured", ylabel="predicted / measured − 1")
        below.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
        ticks = [t for t in (0.5, 1, 1.5, 2, 3, 5, 10, 20, 50) if ends[0] <= t <= ends[1]]
        ticks = [t for t in ticks if t != 1.5 or ends[1] < 10]
        above.set(xticks=ticks, yticks=ticks)
        for axis in (above.xaxis, above.yaxis):
            axis.set_major_formatter(StrMethodFormatter("{x:g}"))
            axis.set_minor_formatter(NullFormatter())
        note = f"rms {100 * rms(errors[f'{name}_error'].values):.1f} %"
        noise = f"noise of a point {100 * rms(errors[f'{name}_noise'].values):.1f} %"
        above.text(0.97, 0.04, f"{note}\n{noise}", transform=above.transAxes, ha="right", va="bottom")
    grid[0, 0].legend(fontsize="small", loc="upper left")
    figure.suptitle(
        "Every point predicted from the others. Open symbols: edge of the map; bars: expected error; grey band: target",
        fontsize="medium",
    )
    return figure
