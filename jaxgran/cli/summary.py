"""What is told of a map or a flow: one summary, from which the tables on the screen and the object
of ``--json`` follow.

This module loads neither JAX nor xarray by itself, so that the command line prints its help at
once.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from jaxgran.cli.output import Entry, in_brackets, print_table, print_text
from jaxgran.model.choices import HALF_INTERVAL
from jaxgran.model.display import counted, to_two_digits, with_error
from jaxgran.sampling.observables import unit_text

Summary = Mapping[str, Entry]

_MAIN = (  # what is printed without --all
    *("force_ratio", "shear_stress_ratio", "pressure", "shear_stress", "macroscopic_friction"),
    *("inertial_number", "granular_temperature", "local_granular_temperature"),
    *("coordination_number", "collision_rate"),
)
_LARGE = {
    "force_ratio": "force ratio",
    "pressure": "pressure",
    "shear_stress": "shear stress",
    "granular_temperature": "T",
    "local_granular_temperature": "local T",
    "macroscopic_friction": "friction τ/p",
}
_SMALLER = (
    "Smaller errors: of sampling by --strain or --seeds, of dt by --timestep, of the size by "
    "--grains, of all by --error."
)


def summary_of(data: Any) -> dict[str, Entry]:
    """The parameters of a flow or of a map, the averages, the shear-stress ratio, and what kinetic
    theory predicts, by name, as far as the data have them; lists are by packing fraction, then by
    restitution.
    """
    from jaxgran.maps.schema import flag_names, flattened, path_of, shear_stress_ratio
    from jaxgran.maps.variables import SCALARS
    from jaxgran.model.status import GIVEN_UP
    from jaxgran.sampling.enskog_factors import LENGTHS
    from jaxgran.sampling.observables import OBSERVABLES

    flat = flattened(data)
    strain = flat["sums/strain"].where(flat["sums/status"] < GIVEN_UP).sum("seed").values
    statuses = np.vectorize(flag_names(flat.status).get)(flat.status.values)
    known: dict[str, Entry] = {}
    for name in ("grains", "timestep", "packing_fraction", "restitution"):
        axis = flat[name] if name in flat else flat[f"point_{name}"]
        unit = axis.attrs.get("reduced_unit", axis.units)
        known[name] = Entry(axis.values, axis.long_name, unit)
    known |= {
        "strain": Entry(strain, "sampled strain of the seeds in the averages"),
        "engine": Entry(data.attrs["engine"], "program that advanced the flow", None),
        "solver": Entry(data.attrs["solver"], "method of the contact solve", None),
        "status": Entry(statuses, "worst status", None),
    }

    def measured(path: str, meaning: str, unit: str) -> Entry:
        error = flat.get(f"{path}_stderr")
        return Entry(flat[path].values, meaning, unit, None if error is None else error.values)

    for name, row in OBSERVABLES.items():
        if path_of(name) not in flat:
            continue
        known[name] = measured(path_of(name), row.meaning, row.unit)
        if name in SCALARS and "diagnostics/correlation_strain" in flat:
            independent = flat["diagnostics/correlation_strain"].sel(observable=name).values
            with np.errstate(divide="ignore", invalid="ignore"):
                known[name] = known[name]._replace(effective_samples=strain / independent)
        if f"{name}_large_system" in flat:
            halves = flat[f"{name}_large_system_ci95"]
            sources = halves.error_source.values.tolist()
            by_source = {x: halves.sel(error_source=x).values for x in sources}
            known[f"{name}_large_system"] = Entry(
                flat[f"{name}_large_system"].values,
                f"{row.meaning}, of a large system",
                row.unit,
                ci95=by_source.pop("total"),
                ci95_by_source=by_source,
            )
        if f"theory/{name}" in flat:
            words = f"{row.meaning}, by kinetic theory"
            known[f"theory/{name}"] = Entry(flat[f"theory/{name}"].values, words, row.unit)
    for name, words in LENGTHS.items():
        if f"theory/{name}" in flat:
            known[name] = measured(f"theory/{name}", words, "sigma")
    ratio, error = (x.values for x in shear_stress_ratio(flat))
    words = "contact shear stress over binary shear stress"
    return known | {"shear_stress_ratio": Entry(ratio, words, "1", error)}


def print_flow(data: Any, all: bool) -> None:
    """Print the averages of a flow with errors, a column for each number of grains; for one of them
    also effective sample sizes; then the averages of a large system.
    """
    from jaxgran.maps.schema import parts
    from jaxgran.sampling.observables import GROUPS

    points = [summary_of(x.isel(packing_fraction=0, restitution=0)) for x in parts(data)]
    if not any(_has_values(point) for point in points):
        return
    sizes = [f"N = {point['grains'].value}" for point in points]
    title = (
        f"Averages at {', '.join(sizes)}, dt = {points[0]['timestep'].value:g}/γ̇, "
        f"{data.attrs['activation']} activation\n"
        f"engine {data.attrs['engine']}, solver {data.attrs['solver']}"
    )
    rows: list[list[str]] = []
    for group, names in (_in_groups(GROUPS) if all else {"/": _MAIN}).items():
        rows += [] if group == "/" else [[group.capitalize()]]
        rows += [_row(name, [point[name] for point in points]) for name in names]
    if len(points) == 1:
        columns = ["observable", "value ±\nstandard error", "unit", "effective\nsamples"]
    else:
        columns = ["observable", "unit", *(f"{size} ±\nstandard error" for size in sizes)]
    print_table(title, columns, rows, numbers=False)
    _print_large_systems(data, points)


def _in_groups(groups: Mapping[str, Sequence[str]]) -> dict[str, list[str]]:
    """All averages of numbers by group, with what belongs to one behind it."""
    from jaxgran.sampling.enskog_factors import LENGTHS
    from jaxgran.sampling.observables import OBSERVABLES

    behind = {"force_ratio": ["shear_stress_ratio"], "binary_dissipation_rate": [*LENGTHS]}
    return {
        group: [
            name
            for first in names
            if not OBSERVABLES[first].tensor
            for name in (first, *behind.get(first, ()))
        ]
        for group, names in groups.items()
    }


def _row(name: str, entries: Sequence[Entry]) -> list[str]:
    """Name, values with errors, and unit of an average; of one flow also effective samples."""
    unit, words = unit_text(entries[0].unit or ""), name.replace("_", " ")
    if name == "shear_stress_ratio":
        words = "shear-stress ratio"
    values = [
        f"{float(x.value):.3g}" if x.stderr is None else with_error(float(x.value), float(x.stderr))
        for x in entries
    ]
    if len(entries) > 1:
        return [words, unit, *values]
    samples = math.nan if (x := entries[0].effective_samples) is None else float(x)
    return [words, *values, unit, "" if math.isnan(samples) else f"{samples:.3g}"]


def print_map(data: Any) -> None:
    """Print the force ratio and the pressure of every part of a map that has them, and the errors
    of the averages of a large system.
    """
    from jaxgran.maps.schema import parts

    planes = [plane for part in parts(data) if _has_values(plane := summary_of(part))]
    for plane in planes:
        grains = plane["grains"].value
        size = "the N of each point" if np.ndim(grains) else f"N = {grains}"
        title = (
            f"Force ratio by packing fraction ν and restitution α: {size}, dt = "
            f"{plane['timestep'].value:g}/γ̇, {data.attrs['activation']} activation"
        )
        ratio, pressure = plane["force_ratio"], plane["pressure_large_system"]
        _print_plane(plane, ratio.value, HALF_INTERVAL * ratio.stderr, title)
        title = f"Pressure of a large system in m/t² (t = 1/γ̇), extrapolated from {size}"
        _print_plane(plane, pressure.value, pressure.ci95, title)
    whole = summary_of(data)
    _print_success_of_theory(whole)
    _print_large_systems(data, planes if whole["force_ratio"].value.size == 1 else [whole])


def _print_success_of_theory(summary: Summary) -> None:
    """Print at how many points kinetic theory predicts the pressure within 10 %."""
    if "theory/pressure" not in summary:
        return
    with np.errstate(invalid="ignore"):
        error = summary["theory/pressure"].value / summary["pressure_large_system"].value - 1
    if known := np.isfinite(error).sum():
        right = (abs(error) <= 0.1).sum()
        words = "Kinetic theory is within 10 % of the pressure of a large system at"
        print_text(f"{words} {right} of {counted(known, 'point')}.")


def relative_error(summary: Summary, name: str) -> np.ndarray:
    """Half-width of the 95 % interval of an average of a large system over the average."""
    large = summary[f"{name}_large_system"]
    with np.errstate(invalid="ignore", divide="ignore"):
        return large.ci95 / np.abs(large.value)


def _has_values(summary: Summary) -> bool:
    return bool(np.isfinite(summary["force_ratio"].value).any())


def _print_plane(plane: Summary, values: np.ndarray, halves: np.ndarray, title: str) -> None:
    """An average of a map with half-widths of 95 % intervals in brackets; * marks a bad status."""
    bad = plane["status"].value != "ok"
    rows = []
    for nu, *line in zip(plane["packing_fraction"].value, values, halves, bad, strict=True):
        cells = [
            (in_brackets(value, half) if math.isfinite(value) else "no value") + " *" * bool(status)
            for value, half, status in zip(*line, strict=True)
        ]
        rows.append([f"{nu:g}", *cells])
    columns = ["ν", *(f"α = {x:g}" for x in plane["restitution"].value)]
    about = "In brackets: 95 % half-width of the last digits; bars of figures are standard errors."
    mark = " *: bad status." if bad.any() else ""
    print_table(f"{title}. {about}{mark}", columns, rows)


def _print_large_systems(data: Any, summaries: Iterable[Summary]) -> None:
    """Print the averages of a large system, and where their errors come from: the values of a flow,
    for each number of grains, beside kinetic theory; or the medians of a map and the largest ones.
    """
    shown = [x for x in summaries if _has_values(x)]
    for summary in shown:
        _print_large_system(summary, data.attrs.get("polydispersity"))
    if shown:
        print_text(_SMALLER)


def _print_large_system(summary: Summary, polydispersity: float | None) -> None:
    from jaxgran.maps.variables import MEASURED_FLOWS
    from jaxgran.sampling.budget import ERROR_SOURCES

    headings = {source: words for source, words in ERROR_SOURCES.items() if words is not None}
    is_point = np.size(summary["status"].value) == 1
    if is_point:
        size = f"extrapolated from N = {np.ravel(summary['grains'].value)[0]}"
        title = f"Averages of a large system {size}, ± 95 %; parts of the errors in %"
    else:
        title = (
            "Averages of a large system: correction for N, and half-widths of 95 % intervals by "
            "source, in %; median over the points, and the largest below it"
        )
    if not _are_measured(summary, polydispersity):
        title += f"\nExtrapolated: the corrections were measured at {MEASURED_FLOWS} only"
    predicted, rows = _predicted(summary) if is_point else {}, []
    for name, words in _LARGE.items():
        large = summary[f"{name}_large_system"]
        with np.errstate(invalid="ignore", divide="ignore"):
            sources = {x: _percent(large.ci95_by_source[x] / abs(large.value)) for x in headings}
        sources |= {"timestep": ("–", "–")} if name == "force_ratio" else {}
        medians, largest = zip(*sources.values(), strict=True)
        if is_point:
            value = with_error(large.value.item(), large.ci95.item())
            rows.append([words, value, predicted.get(name, ""), *medians])
            continue
        both = (
            _percent(large.value / summary[name].value - 1),
            _percent(relative_error(summary, name)),
        )
        rows += [[words, *(x[0] for x in both), *medians]]
        rows += [["  largest", *(x[1] for x in both), *largest]]
    values = ("large system", "kinetic theory") if is_point else ("correction", "total")
    print_table(title, ("average", *values, *headings.values()), rows)


def _predicted(summary: Summary) -> dict[str, str]:
    """What kinetic theory predicts for one flow, none if it is elastic; its temperature is compared
    with the local one.
    """
    pressure, shear_stress, temperature = (
        summary[f"theory/{x}"].value.item()
        for x in ("pressure", "shear_stress", "granular_temperature")
    )
    values = {
        "pressure": pressure,
        "shear_stress": shear_stress,
        "local_granular_temperature": temperature,
        "macroscopic_friction": shear_stress / pressure,
    }
    return {name: f"{value:.3g}" for name, value in values.items() if np.isfinite(value)}


def _are_measured(summary: Summary, polydispersity: float | None) -> bool:
    """Whether the laws of a large system were measured for such flows."""
    from jaxgran.sampling.budget import MEASURED_POLYDISPERSITY, MEASURED_RANGES

    within = (
        np.all((low <= summary[name].value) & (summary[name].value <= high))
        for name, (low, high) in MEASURED_RANGES.items()
    )
    return polydispersity == MEASURED_POLYDISPERSITY and bool(all(within))


def _percent(part: np.ndarray) -> tuple[str, str]:
    """The median of a part of the error over the points, and the largest one."""
    known = np.asarray(part)[np.isfinite(part)]
    if known.size == 0:
        return "", ""
    largest = known.flat[np.argmax(abs(known))]
    return to_two_digits(100 * np.median(known)), to_two_digits(100 * largest)
