"""What are pressure, shear stress and temperatures of a large system, and how are they approached?

In two dimensions long waves of velocity with an energy ∝ k^(−β) make an average approach its limit
as N^(−s), s = 1 − β/2, or grow as ln N if β = 2. First each flow of ν ≤ 0.7 (``size_study`` and
``reference_map --part sizes``) with N ≥ 400 has a limit and an amplitude of its own, and all share
the exponent: χ² says which exponents the averages allow. Then these flows, dense ones and those
that the reference map has at several N share one law of the missing part of an average,

    x(N) = x∞ [1 − b (1 − α²) exp(m (ν − 0.5)) w(ν) (N/1600)^(−s)],    w = min(1, (ν_w − ν)/0.1),

where w ends the waves towards jamming. Standard errors of its constants are larger by the root of
the reduced χ², as a profile of velocity that lasts longer than a sample is not in those of the
flows. Sixteen flows of 256, 1024 and 25,600 grains were not fitted (``--part check``; the reference
map has five of them at other N), and neither were those that ``reference`` judges, of 102,400.

    python -m benchmarks size_limits  # 15 seconds
"""

import json
from collections.abc import Iterator, Sequence
from itertools import product
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from scipy.optimize import least_squares, minimize_scalar

import jaxgran as jg
from benchmarks.output import RESULTS, Output, rounded
from benchmarks.reference_map import PLANE
from jaxgran.maps.variables import NOT_RUN
from jaxgran.model.choices import HALF_INTERVAL
from jaxgran.sampling.budget import LARGE_SYSTEM, SIZE_LAWS, SizeLaw

AVERAGES = tuple(SIZE_LAWS)
SIZES = "reference_sizes_loose.nc", "reference_sizes_dense.nc"
CHECK = "reference_check_small.nc", "reference_check_large.nc"
EXPONENTS = np.arange(0.01, 1.5, 0.005)
LARGEST_FRACTION, LEAST_GRAINS = 0.7, 400
STARTS = tuple((s, 0.1, 0.5, 0.84) for s in (0.15, 0.4, 0.7))  # s, b, m, ν_w


class Flow(NamedTuple):
    """One average of one flow at several N; the source is the name of a study."""

    source: str
    restitution: float
    packing_fraction: float
    grains: np.ndarray
    values: np.ndarray
    stderrs: np.ndarray


def run(output: Output) -> None:
    """Fit, print the tables of the page on the number of grains, and write them as JSON."""
    study = json.loads((RESULTS / "size_study.json").read_text())["flows"]
    sizes = rows_of_maps("sizes", SIZES)
    reference = rows_of_maps("reference map", PLANE)
    laws, limits = {}, []
    for average in AVERAGES:
        flows = flows_of([*study, *sizes], average)
        loose = [flow for flow in flows if flow.packing_fraction <= LARGEST_FRACTION]
        shared = exponents(loose)
        law = law_of([*flows, *flows_of(reference, average, 2)], SIZE_LAWS[average].spread)
        laws[average] = {"exponents": shared, "law": law}
        limits += [{"average": average, **limit} for limit in limits_of(loose, shared["interval"])]
        print(average, rounded(laws[average], 4))
    checks = list(compared(*(jg.open_map(RESULTS / name).to_dataset() for name in CHECK)))
    for row in checks:
        print(rounded(row, 4))
    head = {"laws": rounded(laws, 5), "checks": rounded(checks, 4)}
    output.write_json("size_limits", head | {"rows": rounded(limits, 5)})


def rows_of_maps(source: str, names: Sequence[str]) -> list[dict[str, Any]]:
    """The points of some files, as rows of the study."""
    rows = []
    for name in names:
        data = jg.open_map(RESULTS / name)
        chosen = ["status", *AVERAGES, *(f"{average}_stderr" for average in AVERAGES)]
        frame = data.to_dataset()[chosen].to_dataframe().reset_index()
        frame = frame[frame.status != NOT_RUN].rename(columns={"point_grains": "grains"})
        for record in frame.to_dict("records"):
            row = {axis: record[axis] for axis in ("restitution", "packing_fraction", "grains")}
            averages = {x: [record[x], record[f"{x}_stderr"]] for x in AVERAGES}
            rows.append(row | averages | {"source": source})
    return rows


def flows_of(rows: list[dict[str, Any]], average: str, least_sizes: int = 3) -> list[Flow]:
    """The flows of some rows that have at least ``least_sizes`` values of N ≥ 400."""
    kept: dict[tuple, list] = {}
    for row in rows:
        if row["grains"] >= LEAST_GRAINS:
            key = row.get("source", "study"), row["restitution"], row["packing_fraction"]
            kept.setdefault(key, []).append([row["grains"], *row[average]])
    flows = [Flow(*key, *np.array(some, float).T) for key, some in kept.items()]
    return [flow for flow in flows if len(flow.grains) >= least_sizes]


def fitted(flow: Flow, shape: np.ndarray) -> tuple[float, float, float, float]:
    """x∞ and amplitude of x∞ − c × shape, the standard error of x∞, and χ²."""
    design = np.stack([np.ones(len(shape)), -shape], axis=1) / flow.stderrs[:, None]
    values = flow.values / flow.stderrs
    (limit, amplitude), *_ = np.linalg.lstsq(design, values, rcond=None)
    covariance = np.linalg.inv(design.T @ design)
    chi_squared = np.sum((values - design @ [limit, amplitude]) ** 2)
    return limit, amplitude, np.sqrt(covariance[0, 0]), chi_squared


def exponents(flows: list[Flow]) -> dict[str, Any]:
    """The best exponent that all flows share and its χ², with its 95 % interval, and χ² of growth
    as ln N.
    """

    def total(s: float) -> float:
        return sum(fitted(flow, flow.grains**-s)[3] for flow in flows)

    freedom = sum(len(flow.grains) - 2 for flow in flows)
    logarithm = sum(fitted(flow, -np.log(flow.grains))[3] for flow in flows)
    best = minimize_scalar(total, bounds=(EXPONENTS[0], EXPONENTS[-1]), method="bounded")
    scale = max(1.0, best.fun / (freedom - 1))
    allowed = EXPONENTS[np.array([total(s) for s in EXPONENTS]) < best.fun + 3.84 * scale]
    return {
        "flows": len(flows),
        "freedom": freedom,
        "chi_squared": {"ln N": logarithm},
        "best": [best.x, best.fun],
        "interval": [allowed[0], allowed[-1]],
    }


def limits_of(flows: list[Flow], interval: list[float]) -> list[dict[str, Any]]:
    """For each flow the 95 % interval of the limit, by the exponents at both ends of their
    interval.
    """
    limits = []
    for flow in flows:
        ends = [fitted(flow, flow.grains**-s) for s in interval]
        bounds = [end[0] + sign * 1.96 * end[2] for end in ends for sign in (-1, 1)]
        where = {"restitution": flow.restitution, "packing_fraction": flow.packing_fraction}
        limits.append(where | {"interval": [min(bounds), max(bounds)]})
    return limits


def compared(small: xr.Dataset, large: xr.Dataset) -> Iterator[dict[str, Any]]:
    """How flows agree with the same ones of more grains, for each average and smaller N: root mean
    squares as they are, corrected, and of sampling; the half-width (rms) of the 95 % interval, and
    the share of flows within. Both corrections follow from one law, so the difference of their
    errors counts; the excess of a force ratio has no law of its own, so that of the smaller flow
    counts in full.
    """
    for name, grains in product(LARGE_SYSTEM, small.grains.values.tolist()):
        path, own = f"{name}_large_system", small.sel(grains=grains)
        limit = large[path]
        parts = [x[f"{path}_ci95"] / limit for x in (own, large)]
        sampling = np.hypot(*(x.sel(error_source="sampling") for x in parts))
        size, common = (x.sel(error_source="size") for x in parts)
        bound = size if name == "force_ratio" else size - common
        apart, half = own[path] / limit - 1, np.hypot(sampling, bound)
        rms = {
            "as_it_is": own[name] / limit - 1,
            "corrected": apart,
            "sampling": sampling / HALF_INTERVAL,
            "half_width": half,
        }
        row = {"average": name, "grains": grains, "flows": apart.size}
        row |= {words: float(np.sqrt((x**2).mean())) for words, x in rms.items()}
        yield row | {"within": float((abs(apart) < half).mean())}


def missing_part(constants: Sequence[float], flow: Flow) -> np.ndarray:
    """The missing part of an average over its limit, at every N of a flow."""
    return SizeLaw(*constants, spread=0.0).missing(
        flow.restitution, flow.packing_fraction, flow.grains
    )


def law_of(flows: list[Flow], spread: float) -> dict[str, Any]:
    """The constants of the law that all flows share, their standard errors and correlations, and
    χ².
    """

    def residuals(constants: np.ndarray) -> np.ndarray:
        misfits = []
        for flow in flows:
            shape = (1 - missing_part(constants, flow)) / flow.stderrs
            scaled = flow.values / flow.stderrs
            misfits.append(shape * (shape @ scaled) / (shape @ shape) - scaled)
        return np.concatenate(misfits)

    lowest, highest = (0.05, 0, -3, 0.76), (1.5, 2, 10, 0.9)
    fits = [
        least_squares(residuals, start, bounds=(lowest, highest), x_scale="jac") for start in STARTS
    ]
    best = min(fits, key=lambda fit: fit.cost)
    freedom = best.fun.size - len(flows) - best.x.size
    covariance = np.linalg.pinv(best.jac.T @ best.jac) * max(1.0, 2 * best.cost / freedom)
    return {
        "flows": len(flows),
        "constants": best.x.tolist(),
        "stderrs": np.sqrt(np.diag(covariance)).tolist(),
        "chi_squared": 2 * best.cost,
        "freedom": freedom,
        "differences": sum(len(flow.grains) - 1 for flow in flows),
        "within": float(np.mean(np.concatenate([within(best.x, flow, spread) for flow in flows]))),
    }


def within(constants: np.ndarray, flow: Flow, spread: float) -> np.ndarray:
    """Whether the value at each N over that at the largest is what the law says, within 95 %
    intervals of both standard errors and of what ``sampling.budget`` adds to the law; what it adds
    at the largest N is common to both.
    """
    law, relative = SizeLaw(*constants, spread), flow.stderrs / flow.values
    missing, added = (
        x(flow.restitution, flow.packing_fraction, flow.grains) for x in (law.missing, law.error)
    )
    apart = np.log(flow.values / flow.values[-1]) - np.log1p(-missing) + np.log1p(-missing[-1])
    sampling = HALF_INTERVAL * np.hypot(relative, relative[-1])
    return (abs(apart) < np.hypot(sampling, added - added[-1]))[:-1]
