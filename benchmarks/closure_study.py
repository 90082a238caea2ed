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

import jaxgran as jg
from benchmarks.output import Output, rounded
from jaxgran.environment import usable_cores
from jaxgran.inference.cross_validation import leave_one_out
from jaxgran.maps.presets import PRESETS
from jaxgran.maps.results import open_map

SMALLER = {"grains": 64, "seeds": 1, "strain": 20.0}
NAMES = ("pressure", "shear_stress", "force_ratio")
TARGETS = {"pressure": 0.05, "force_ratio": 0.08}


def run(output: Output, dataset: Path | None = None) -> None:
    """Fit, leave out, print, and write JSON; of a dataset of a map, or of one that is made."""
    data = make_map(output.quick) if dataset is None else open_map(dataset)
    errors = leave_one_out(data)
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
    output.write_json("closure", rounded({"run": made_by, "summary": summary}, 5))


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
