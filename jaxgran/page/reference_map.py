"""The reference map for a page: as a dataset to look into, and its verdicts at the points of any
map.
"""

from typing import Any

import numpy as np
import xarray as xr

from jaxgran.maps.replica import PLANE
from jaxgran.model.choices import HALF_INTERVAL
from jaxgran.reference.table import LENGTH, shipped_table
from jaxgran.reference.validity import COLUMNS, validity
from jaxgran.sampling.observables import OBSERVABLES
from jaxgran.theory.assumptions import ASSUMPTIONS

_PATHS = {f"pressure_{name}": f"theory/enskog_factor_pressure_{name}" for name in ASSUMPTIONS} | {
    LENGTH: f"theory/{LENGTH}"
}


def reference_dataset() -> xr.Dataset:
    """The averages of the reference map by packing fraction and restitution, with errors, and
    kinetic theory.
    """
    table = shipped_table()
    flows = [table.columns[name] for name in PLANE]
    axes, places = zip(*(np.unique(x, return_inverse=True) for x in flows), strict=True)
    variables: dict[str, tuple] = {}

    def put(name: str, values: np.ndarray, **attributes: str) -> None:
        grid = np.full([len(axis) for axis in axes], np.nan)
        grid[places] = values
        variables[name] = PLANE, grid, attributes

    for name in table.surfaces:
        path, stderr = _PATHS.get(name, name), table.columns[f"{name}_stderr"]
        meaning, unit = name.replace("_", " "), "sigma" if name == LENGTH else "1"
        if name in OBSERVABLES:
            meaning, unit = OBSERVABLES[name].meaning, OBSERVABLES[name].unit
        put(path, table.columns[name], long_name=meaning, units=unit)
        put(f"{path}_stderr", stderr)
        if f"{name}_bound" in table.columns:
            half = np.hypot(HALF_INTERVAL * stderr, table.columns[f"{name}_bound"])
            put(f"{path}_large_system", table.columns[name])
            put(f"{path}_large_system_ci95", half)
    for name, values in table.series(table.points).items():
        put(f"theory/{name}", np.exp(values))
    answer = validity(*reversed(flows))
    for name, error in answer.error.items():
        put(
            f"{name}_error_of_theory",
            error.value,
            long_name="kinetic theory over measured average, less one",
        )
        put(f"{name}_error_of_theory_ci95", error.ci95)
    timestep = float(table.head["timestep"])
    attributes = {"title": f"The reference map of jaxgran: {table.made_with}", "timestep": timestep}
    return xr.Dataset(variables, dict(zip(PLANE, axes, strict=True)), attributes)


def verdicts(packing_fractions: np.ndarray, restitutions: np.ndarray) -> dict[str, Any]:
    """What the reference map says of every flow of a plane, in types of JSON.

    ========  ==============================================================================
    key       content
    ========  ==============================================================================
    about     what the reference map is, in a sentence
    outside   what is said of a flow outside its range
    columns   names of the columns of a table
    flows     by packing fraction, then restitution: the verdict and the rows of the table;
              None outside the range
    ========  ==============================================================================
    """
    table = shipped_table()
    nus, alphas = (x.ravel() for x in np.meshgrid(packing_fractions, restitutions, indexing="ij"))
    (first, last), (loosest, densest) = table.range("restitution"), table.range("packing_fraction")
    inside = np.flatnonzero(
        (first <= alphas) & (alphas <= last) & (loosest <= nus) & (nus <= densest)
    )
    flows: list[dict[str, Any] | None] = [None] * len(nus)
    if inside.size:
        answers = validity(alphas[inside], nus[inside])
        for place, flow in enumerate(inside):
            answer = answers.at(place)
            flows[flow] = {"verdict": answer.verdict(), "rows": answer.rows()}
    return {
        "about": f"Reference map: {table.made_with}, diameters uniform in σ ± "
        f"{table.head['polydispersity']} σ; ± is half of the 95 % interval for a large system.",
        "outside": f"The reference map covers α = {first:g} to {last:g} and ν = {loosest:g} to "
        f"{densest:g}.",
        "columns": list(COLUMNS),
        "flows": flows,
    }
