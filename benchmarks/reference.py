"""The table from which ``jg.validity`` answers, made from the reference map; and whether its
intervals hold.

The map becomes ``averages.csv`` in ``jaxgran/reference``: every average with its standard error and
the bound on its other errors, and the shape of the Gaussian process that interpolates it, by
maximum likelihood. Stresses, temperatures and dissipation rate are extrapolated to a large system
(``sampling.budget.SIZE_LAWS``), and the error of that is in the bound; force ratio and factors are
those of the map's numbers of grains. The better of two theories, whose pressure is within 10 % in
most of the plane, becomes a Chebyshev series in ``theory.csv``, and so does the corrected theory.
Then the intervals are judged: on points of the map that are left out, and on the fresh and the
large flows of ``python -m benchmarks reference_runs``. The maps of the paper and of a coarse time
step give the force ratio at other time steps.

    python -m benchmarks reference          # from benchmarks/results/reference*.nc, in two minutes
    python -m benchmarks reference --replace  # and into jaxgran/reference
"""

import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
import xarray as xr
from scipy.optimize import minimize

import jaxgran as jg
from benchmarks.dissipation import areas, rms
from benchmarks.output import RESULTS, Output
from benchmarks.reference_figure import BINARY, RIGHT, draw
from benchmarks.reference_map import PLANE, reference_points
from jaxgran.maps.schema import flattened
from jaxgran.model.choices import HALF_INTERVAL
from jaxgran.reference.surface import Shape, coordinates
from jaxgran.reference.table import (
    CORRECTED,
    FOLDER,
    LENGTH,
    MEASURED,
    RATIO,
    THEORY,
    Series,
    Table,
    excess_from_surface,
    read_table,
    theory_of,
    write_columns,
)
from jaxgran.sampling.budget import SIZE_LAWS
from jaxgran.theory.assumptions import ASSUMPTIONS
from jaxgran.theory.corrected_shear import corrected_shear
from jaxgran.theory.gaussian_moments import gaussian_moments
from jaxgran.theory.navier_stokes import garzo_dufty

ONE_CORE = True

THEORIES: dict[str, Callable] = {f.__name__: f for f in (gaussian_moments, garzo_dufty)}
TERMS = 20  # of the Chebyshev series along each coordinate
MARGIN = 0.01  # by which the series reaches beyond the map, as a share of its range
START = ((1.0, 1.0, 1.2, 0.1), (-0.5, -0.5, 0.5, 0.1))  # logarithms of a Shape
BOUNDED_BY = {"dissipation_rate": "shear_stress"}  # its power is what is dissipated
AVERAGES = ("pressure", "shear_stress", "local_granular_temperature")
OTHERS = "reference_coarse.nc", "paper.nc"  # maps of other time steps


def run(output: Output) -> None:
    """Make the table, judge its intervals, draw the figure, and write ``reference`` as JSON and
    PNG.
    """
    folder = FOLDER if output.replaces else output.folder / "reference"
    folder.mkdir(parents=True, exist_ok=True)
    data, *others = reference_points(), *(flattened(jg.open_map(RESULTS / x)) for x in OTHERS)
    made_from = {"maps": " and ".join(PLANE), "table commit": output.hardware["commit"]}
    make_table(data, others, folder, made_from)
    table = read_table(folder)
    fresh, large = (
        json.loads((RESULTS / f"reference_runs{end}.json").read_text()) for end in ("", "_large")
    )
    rows = list(judged(table, fresh["rows"]))
    head = {"table": table.head, "left_out": left_out(table), "plane": plane(table)}
    head["fresh"] = {key: fresh[key] for key in ("points", "grains", "timestep")}
    head["coverage"] = coverage(rows)
    head["large"] = {"grains": large["grains"], "rows": list(judged(table, large["rows"]))}
    head["whole_errors"] = whole_errors(table)
    print(*(f"{name}: {x}" for name, x in head.items() if name != "table"), sep="\n")
    output.write_json("reference", head | {"rows": rows})
    output.write_picture(draw(table), "reference")


# ------------------------------------------------------------------------------------------------
# table


def make_table(
    data: xr.Dataset, others: list[xr.Dataset], folder: Path, made_from: dict[str, Any]
) -> None:
    """Write both files of the table of a map into a folder."""
    flat = data.stack(point=("packing_fraction", "restitution"))
    finite = np.flatnonzero(np.isfinite(flat["pressure"].values))
    flat = flat.isel(point=finite)
    columns = {name: flat[name].values for name in ("restitution", "packing_fraction")}
    grains = columns["grains"] = flat["point_grains"].values
    paths = {name: name for name in (*MEASURED, RATIO)} | {
        "dissipation_rate": "stresses/dissipation_rate"
    }
    paths |= {f"pressure_{name}": f"theory/enskog_factor_pressure_{name}" for name in ASSUMPTIONS}
    paths[LENGTH] = f"theory/{LENGTH}"
    for name, path in paths.items():
        columns |= {name: flat[path].values, f"{name}_stderr": flat[f"{path}_stderr"].values}
        if name in (*MEASURED, RATIO):
            columns |= of_large_system(flat, name, path)
    for other in others:
        name = f"{RATIO}_at_{float(other.attrs['timestep']):g}"
        axes = {axis: data[axis].values for axis in ("packing_fraction", "restitution")}
        near = other[[*_columns(RATIO), f"{RATIO}_stderr"]]
        near = near.reindex(axes, method="nearest", tolerance=1e-6).stack(point=tuple(axes))
        ratio = of_large_system(near.isel(point=finite), RATIO, RATIO)
        value, stderr = ratio[RATIO], ratio[f"{RATIO}_stderr"]
        # a ratio of 1 in all blocks has no error, and so no weight on a surface
        columns |= {name: np.where(np.isfinite(stderr), value, np.nan), f"{name}_stderr": stderr}
        paths[name] = RATIO
    theory, within = best_theory(columns)
    series = chebyshev_series(theory, columns)
    about = {
        "contents": "Chebyshev series of ln(prediction) in sqrt(1 - alpha) and nu, see table.py",
        "theory": theory.__name__,
        "low": " ".join(f"{x:.12g}" for x in series.low),
        "high": " ".join(f"{x:.12g}" for x in series.high),
    }
    first, second = np.indices((TERMS, TERMS))
    terms = {"first": first, "second": second, **series.coefficients}
    terms = {name: x.ravel() for name, x in terms.items()}
    write_columns(folder / "theory.csv", about, terms, digits=9)
    head: dict[str, Any] = {
        "contents": "averages of the reference map of jaxgran in units of m, sigma and 1/shear "
        "rate, see table.py",
        "grains": f"{grains.min()} to {grains.max()}, extrapolated to a large system",
    }
    for name in ("timestep", "seeds", "polydispersity", "activation"):
        value = data.attrs[name]
        head[name] = f"{value:g}" if isinstance(value, float) else str(value)
    head |= {"map commit": data.attrs["commit"], **made_from}
    for name, share in within.items():
        about = f"share of the points, by area, with the pressure of {name} within 10 %"
        head[about] = f"{share:.3f}"
    bare = Table({}, columns, series)
    for name in paths:
        shape = fitted_shape(bare, name)
        numbers = shape.amplitude, *shape.lengths, shape.noise, shape.leave_one_out
        head[f"surface {name}"] = " ".join(f"{x:.5g}" for x in numbers)
    write_columns(folder / "averages.csv", head, columns)


def of_large_system(flat: xr.Dataset, name: str, path: str) -> dict[str, np.ndarray]:
    """An average of a large system, its standard error, and the bound of all other errors."""
    bounded = BOUNDED_BY.get(name, name)
    large, errors = (flat[x] for x in _columns(bounded))
    where = (flat[x].values for x in ("restitution", "packing_fraction"))
    grains = flat["point_grains" if "point_grains" in flat.coords else "grains"].values
    law = SIZE_LAWS["pressure" if name == RATIO else bounded]
    slope = 1 / (1 - law.missing(*where, grains))  # not that of two errors, which may both be 0
    value = large if name == RATIO else flat[path] * slope
    squares = errors**2
    others = squares.sel(error_source="total") - squares.sel(error_source="sampling")
    found = {"": value, "_stderr": flat[f"{path}_stderr"] * slope}
    found["_bound"] = np.sqrt(others) * value / large
    return {f"{name}{end}": x.values for end, x in found.items()}


def _columns(average: str) -> tuple[str, str]:
    return f"{average}_large_system", f"{average}_large_system_ci95"


def best_theory(columns: dict[str, np.ndarray]) -> tuple[Callable, dict[str, float]]:
    """The theory whose pressure is within 10 % in most of the plane, and the share of the plane for
    each theory.
    """
    flows = columns["restitution"], columns["packing_fraction"]
    weights, within = areas(*flows), {}
    for name, theory in THEORIES.items():
        predicted = jax.vmap(lambda *flow, theory=theory: theory(*flow).pressure)(*flows)
        error = np.asarray(predicted) / columns["pressure"] - 1
        within[name] = float(np.mean(weights * (np.abs(error) < 0.1)))
    return THEORIES[max(within, key=within.__getitem__)], within


def chebyshev_series(theory: Callable, columns: dict[str, np.ndarray]) -> Series:
    """The series of the logarithms of the predictions of a theory and of the corrected one, over
    the columns' range.
    """
    alphas, nus = columns["restitution"], columns["packing_fraction"]
    low = np.array([np.sqrt(1 - alphas.max()), nus.min()])
    high = np.array([np.sqrt(1 - alphas.min()), nus.max()])
    low, high = low - MARGIN * (high - low), high + MARGIN * (high - low)
    nodes = np.cos(np.pi * (np.arange(TERMS) + 0.5) / TERMS)
    first, second = (low[k] + (nodes + 1) / 2 * (high[k] - low[k]) for k in (0, 1))
    u, v = (x.ravel() for x in np.meshgrid(first, second, indexing="ij"))
    inverse = np.linalg.inv(np.polynomial.chebyshev.chebvander(nodes, TERMS - 1))
    plain, corrected = (jax.vmap(f)(1 - u**2, v) for f in (theory, corrected_shear))
    coefficients = {}
    for name in THEORY:
        for start, averages in (("", plain), (CORRECTED, corrected)):
            values = np.log(np.asarray(getattr(averages, name))).reshape(TERMS, TERMS)
            coefficients[f"{start}{name}"] = inverse @ values @ inverse.T
    return Series(low, high, coefficients)


def fitted_shape(table: Table, name: str) -> Shape:
    """The shape of the surface of an average: the largest likelihood, with weak priors of its four
    logarithms.
    """
    surface = table.surface(name, Shape(1.0, (1.0, 1.0)))
    priors, widths = np.array([-1.0, 0.5, 0.5, 0.0]), np.array([3.0, 1.5, 1.5, 0.5])

    def with_shape(logs: np.ndarray) -> Shape:
        amplitude, first, second, noise = np.exp(np.clip(logs, -6, 6))
        return Shape(float(amplitude), (float(first), float(second)), float(noise))

    def cost(logs: np.ndarray) -> float:
        likelihood = replace(surface, shape=with_shape(logs)).log_likelihood()
        return -likelihood + float(np.sum(((logs - priors) / widths) ** 2)) / 2

    enough = {"xatol": 0.02, "fatol": 0.02}
    fits = [minimize(cost, start, method="Nelder-Mead", options=enough) for start in START]
    shape = with_shape(min(fits, key=lambda fit: fit.fun).x)
    errors, expected = replace(surface, shape=shape).left_out()
    return replace(shape, leave_one_out=max(1.0, rms(errors / expected)))


# ------------------------------------------------------------------------------------------------
# intervals


def left_out(table: Table) -> dict[str, dict[str, float]]:
    """Leave-one-out errors of every surface, and the share within 95 % intervals."""
    result = {}
    for name, surface in table.surfaces.items():
        errors, expected = surface.left_out()
        covered = np.mean(np.abs(errors) < HALF_INTERVAL * expected)
        result[name] = {"rms": round(rms(errors), 4), "covered": round(float(covered), 3)}
    return result


def whole_errors(table: Table) -> dict[str, Any]:
    """Half-widths of the 95 % intervals at the points of the map, relative to the averages.

    For each average the median, the share of points within 3 %, and the largest for every packing
    fraction.
    """
    nus, result = table.columns["packing_fraction"], {}
    for name in (*AVERAGES, "dissipation_rate"):
        _, half = table.log_estimate(name, table.points)
        result[name] = {
            "median": round(float(np.median(half)), 4),
            "within_3_percent": round(float(np.mean(half < 0.03)), 3),
            "largest": {f"{nu:g}": round(float(half[nus == nu].max()), 4) for nu in np.unique(nus)},
        }
    return result


def judged(table: Table, rows: list[dict[str, Any]]) -> Iterator[dict[str, float]]:
    """For every fresh flow, ln(measured/table) of every average and the half-widths of its two
    intervals.

    The whole interval is that of ``jg.validity``. The other one leaves out the bounds: sampling and
    interpolation only. The errors of the fresh flow are added to both. What is missing at its
    number of grains is added to its averages by the law that the table was made with, so neither
    interval tests this law.
    """
    for row in rows:
        flow = row["restitution"], row["packing_fraction"]
        where = coordinates(*flow)
        comparison = dict(zip(("restitution", "packing_fraction"), flow, strict=True))
        for name in MEASURED:
            log, stderr = table.surfaces[name](where)
            bounded = BOUNDED_BY.get(name, name)
            missing = SIZE_LAWS[bounded].missing(*flow, row["grains"])
            expected = log + table.series(where)[theory_of(name)] + np.log1p(-missing)
            known = [row[f"{bounded}_{part}"] / row[bounded] for part in ("timestep", "tolerance")]
            own = np.hypot(HALF_INTERVAL * row[f"{name}_stderr"] / row[name], np.hypot(*known))
            narrow = np.hypot(HALF_INTERVAL * stderr, own)
            whole = np.hypot(narrow, np.exp(table.bounds[name](where)[0]))
            values = {"": np.log(row[name]) - expected, "_narrow": narrow, "_whole": whole}
            comparison |= {f"{name}{end}": round(float(x), 5) for end, x in values.items()}
        yield comparison


def coverage(rows: list[dict[str, float]]) -> dict[str, dict[str, float]]:
    """Share of the fresh flows within both intervals, mean and rms difference, and its rms in units
    of the standard error.
    """
    result = {}
    for name in MEASURED:
        apart, narrow, whole = (
            np.array([row[f"{name}{end}"] for row in rows]) for end in ("", "_narrow", "_whole")
        )
        numbers = {
            "covered": (np.mean(np.abs(apart) < whole), 3),
            "covered_narrow": (np.mean(np.abs(apart) < narrow), 3),
            "mean": (np.mean(apart), 4),
            "rms": (rms(apart), 4),
            "rms_in_standard_errors": (HALF_INTERVAL * rms(apart / narrow), 3),
            "median_half_width": (np.median(whole), 4),
        }
        result[name] = {key: round(float(x), digits) for key, (x, digits) in numbers.items()}
    return result


def plane(table: Table) -> dict[str, Any]:
    """Number of points, and the shares of the plane of ln(1 − α) and ν, and of its binary part,
    where the theory's pressure is within 10 %. In the binary part the force ratio is below 1.05.
    """
    x = np.linspace(*np.log(1 - np.array(table.range("restitution"))), 200)
    y = np.linspace(*table.range("packing_fraction"), 200)
    where = coordinates(*np.meshgrid(1 - np.exp(x), y))
    over, _ = table.log_estimate("pressure", where)
    inside = np.abs(np.expm1(-over)) <= RIGHT
    binary = excess_from_surface(table.surfaces[RATIO](where)[0]) < BINARY
    share, of_binary = (round(float(np.mean(part)), 3) for part in (inside, inside[binary]))
    points = len(table.columns["restitution"])
    return {"points": points, f"{RIGHT:g}": {"share": share, "share_of_binary": of_binary}}
