"""The data of the page of a map: every average at every point, with its errors, theory and status,
and the instants.
"""

from collections import Counter
from collections.abc import Iterator
from typing import Any

import numpy as np
import xarray as xr

from jaxgran.maps.schema import FINEST, TENSOR_AXES, MapData, path_of, require_map
from jaxgran.maps.settings import DEFAULTS, options
from jaxgran.model.checks import InputError
from jaxgran.model.display import unit_text, with_error
from jaxgran.model.status import MEANINGS
from jaxgran.page.grain_data import ENCODING, MOST_GRAINS, grain_data, scale_of
from jaxgran.page.reference_map import verdicts
from jaxgran.plotting.encoding import EXCESS_LEVELS

MOST_POINTS = 2500
"""Points of a page; of a larger map a part of the restitutions and packing fractions is shown."""

_MOST_PARTS = 100  # pairs of a number of grains and a time step
_DIGITS = 7  # of a number
_LONGEST_TEXT = 200  # characters of a name or attribute
_AXES = {
    "grains": "number of grains N",
    "timestep": "time step dt (1/γ̇)",
    "packing_fraction": "packing fraction ν",
    "restitution": "restitution α",
}
_PLANE = ("packing_fraction", "restitution")
_COMPANIONS = ("_stderr", "_large_system", "_large_system_ci95")
_FIRST = ("force_ratio", "excess")  # the page opens with the second
_GROUPS = ("stresses/", "theory/", "diagnostics/")
_LEFT_OUT = ("status", "point_grains")
_NAMED = {
    name: one.kind for name, one in options("run").items() if isinstance(one.kind, tuple)
}  # choices of a run


def map_data(data: MapData) -> dict[str, Any]:
    """The numbers of a map in types of JSON, by point: number of grains, time step, packing
    fraction, restitution.

    =============  =================================================================================
    key            content
    =============  =================================================================================
    axes           the dimensions, outermost first: name, label and values; numbers of grains and
                   time steps have one value if the map has one, and none if it is not known
    observables    name, meaning and unit; values, and texts of these with their errors; and where
                   the map has them standard errors, predictions of kinetic theory, numbers of
                   effective samples, and texts of averages of a large system with 95 % intervals
    status         the status of each point; meanings of the statuses
    grains         the number of grains of each point, if it was chosen by point
    instants       grains and forces of each point, see ``grain_data``
    reference      what the reference map says of each packing fraction and restitution, see
                   ``verdicts``
    again          what the command needs that measures a point again, if the map was made by this
                   program
    about, notes   sentences: parameters of the map, and what is left out
    =============  =================================================================================

    Raises:
      InputError: (a ValueError) the data are no map, or have nothing to show.
    """
    data = require_map(data)
    data, notes = _thinned(data.sortby([name for name in _AXES if name in data.dims]))
    dims = [name for name in _AXES if name in data.dims]
    data = _with_excess(data)
    names = [str(name) for name in data.data_vars if _is_shown(data, str(name))]
    names.sort(key=lambda name: _FIRST.index(name) if name in _FIRST else len(_FIRST))
    observables = [
        one
        for name, label in _labels(names).items()
        for one in _observables(data, name, label, dims)
    ]
    if not observables:
        raise InputError("data must be a ratio map, and it has no number at its points.")
    instants, more = _instants(data, dims)
    return {
        "title": _text(data.attrs.get("title", "Map of sheared grains")),
        "axes": [
            {"name": name, "label": label, "values": _axis(data, name)}
            for name, label in _AXES.items()
        ],
        "observables": observables,
        "status": _statuses(data, dims),
        "grains": numbers(_column(data["point_grains"], data, dims))
        if "point_grains" in data
        else None,
        "meanings": MEANINGS,
        "excessLevels": list(EXCESS_LEVELS),
        "instants": instants,
        "encoding": ENCODING,
        "again": _again(data, dims),
        "reference": verdicts(data["packing_fraction"].values, data["restitution"].values),
        "about": _about(data),
        "notes": notes + more,
    }


def _thinned(data: xr.Dataset) -> tuple[xr.Dataset, list[str]]:
    """The map with at most ``MOST_POINTS`` points, and a sentence if there were more."""
    sizes = [data.sizes.get(name, 1) for name in _AXES]
    parts, points = int(np.prod(sizes[:2])), int(np.prod(sizes))
    if parts > _MOST_PARTS:
        raise InputError(
            f"a page shows at most {_MOST_PARTS} numbers of grains and time steps together, not "
            f"{parts}: select some."
        )
    if points <= MOST_POINTS:
        return data, []
    rows, columns = sizes[2:]
    most = MOST_POINTS // parts
    few_rows = max(min(rows, int(np.sqrt(most * rows / columns))), min(rows, most // columns), 1)
    few_columns = min(columns, max(most // few_rows, 1))
    for name, few in zip(_PLANE, (min(few_rows, most), few_columns), strict=True):
        data = data.isel(
            {name: np.unique(np.linspace(0, data.sizes[name] - 1, few).round().astype(int))}
        )
    shown = (
        f"{data.sizes['packing_fraction']} of {rows} packing fractions and "
        f"{data.sizes['restitution']} of {columns}"
    )
    return data, [
        f"The map has {points} points. This page shows a part of them: {shown} restitutions."
    ]


def _with_excess(data: xr.Dataset) -> xr.Dataset:
    """The map with the excess, force ratio − 1, and the errors of the force ratio as its errors."""
    if "force_ratio" not in data or "excess" in data:
        return data
    excess = (data.force_ratio - 1).assign_attrs(long_name="force ratio − 1", units="1")
    errors = {
        f"excess{end}": data[f"force_ratio{end}"] - (end == "_large_system")
        for end in _COMPANIONS
        if f"force_ratio{end}" in data
    }
    return data.assign({"excess": excess, **errors})


def _is_shown(data: xr.Dataset, name: str) -> bool:
    """Whether a variable is a number at every point, and not part of another one."""
    variable = data[name]
    dims = set(variable.dims) - set(FINEST)
    belongs = any(name.endswith(end) and name.removesuffix(end) in data for end in _COMPANIONS)
    belongs |= name.startswith("theory/") and path_of(name.removeprefix("theory/")) in data
    apart = name in _LEFT_OUT or name.startswith("states/") or "flag_values" in variable.attrs
    return (
        variable.dtype.kind in "iuf"
        and dims in ({*_PLANE}, {*_PLANE, *TENSOR_AXES})
        and not (belongs or apart)
    )


def _observables(
    data: xr.Dataset, name: str, label: str, dims: list[str]
) -> Iterator[dict[str, Any]]:
    """The entry of a variable, or those of its components."""
    about = data[name].attrs
    parts = {"value": name, "error": f"{name}_stderr"}
    parts |= {"theory": f"theory/{label}"} if path_of(label) == name else {}
    large = f"{name}_large_system"
    samples = _effective_samples(data, label)
    for component, chosen in _components(data[name]).items():
        columns = {
            part: _column(data[there].isel(chosen), data, dims)
            for part, there in parts.items()
            if there in data
        }
        if samples is not None:
            columns["samples"] = _column(samples, data, dims)
        texts = {"text": _texts(columns["value"], columns.get("error"))}
        if large in data:
            pair = (
                _column(data[there].isel(chosen), data, dims) for there in (large, f"{large}_ci95")
            )
            texts["large"] = _texts(*pair)
        yield {
            "name": _text(label + component),
            "meaning": _text(about.get("long_name", label.replace("_", " ")))
            + component.replace("_", ", "),
            "unit": unit_text(_text(about.get("reduced_unit", about.get("units", "")))),
            **{part: numbers(values) for part, values in columns.items()},
            **texts,
        }


def _texts(values: np.ndarray, errors: np.ndarray | None) -> list[str]:
    """Values with errors as the command line prints them."""
    if errors is None:
        return [f"{value:.6g}" if np.isfinite(value) else "–" for value in values.tolist()]
    pairs = zip(values.tolist(), errors.tolist(), strict=True)
    return [with_error(*pair) if np.isfinite(pair[0]) else "–" for pair in pairs]


def _effective_samples(data: xr.Dataset, observable: str) -> xr.DataArray | None:
    """The number of independent samples of an observable at each point, or None where it is not
    known.
    """
    strain, correlated = data.get("sums/strain"), data.get("diagnostics/correlation_strain")
    if strain is None or correlated is None or observable not in data.get("observable", ()):
        return None
    return strain.sum("seed") / correlated.sel(observable=observable)


def _labels(names: list[str]) -> dict[str, str]:
    """Short names of variables: without their group, or with it at the end where another one has
    the same name.
    """
    split = {
        name: (name.split("/", 1) if name.startswith(_GROUPS) else ["", name]) for name in names
    }
    counts = Counter(end for _, end in split.values())
    return {
        name: f"{end}_{group}" if group and counts[end] > 1 else end
        for name, (group, end) in split.items()
    }


def _components(variable: xr.DataArray) -> dict[str, dict[str, int]]:
    """The components of a tensor by their name, or of a scalar: itself."""
    if not set(TENSOR_AXES) <= set(variable.dims):
        return {"": {}}
    sizes = [variable.sizes[axis] for axis in TENSOR_AXES]
    return {
        f"_{'xyz'[a]}{'xyz'[b]}": {"axis_a": a, "axis_b": b}
        for a, b in np.ndindex(*sizes)
        if max(a, b) < 3
    }


def _column(variable: xr.DataArray, data: xr.Dataset, dims: list[str]) -> np.ndarray:
    """The values of a variable by point, or the total of an interval; one without numbers of grains
    is repeated.
    """
    if "error_source" in variable.dims:
        variable = variable.sel(error_source="total")
    missing = {name: data[name] for name in dims if name not in variable.dims}
    return variable.expand_dims(missing).transpose(*dims).values.astype(float).ravel()


def _statuses(data: xr.Dataset, dims: list[str]) -> list[str]:
    """The name of the status of every point."""
    if "status" not in data or not set(_PLANE) <= set(data.status.dims):
        return ["ok"] * int(np.prod([data.sizes[name] for name in dims]))
    flags = np.atleast_1d(data.status.attrs.get("flag_values", [])).tolist()
    names = dict(zip(flags, str(data.status.attrs.get("flag_meanings", "")).split(), strict=False))
    codes = _column(data.status, data, dims)
    return [_text(names.get(code, f"status {code:g}")) for code in codes.tolist()]


def _instants(
    data: xr.Dataset, dims: list[str]
) -> tuple[list[dict[str, Any] | None] | None, list[str]]:
    """Grains and forces of every point, and a sentence if some are left out; None if the map has
    none.
    """
    if not any(name.startswith("states/") for name in map(str, data.data_vars)):
        return None, []
    from jaxgran.maps.states import FIELDS, instant_at, state_of  # here, as only this needs JAX

    timesteps, values = (
        _axis(data, "timestep"),
        {name: data.get(f"states/{name}") for name in FIELDS},
    )
    activation = data.attrs.get("activation")
    if (
        not timesteps
        or activation not in _NAMED["activation"]
        or any(x is None for x in values.values())
    ):
        return None, []
    found, large = [], 0
    for place in np.ndindex(*(data.sizes[name] for name in dims)):
        here = dict(zip(dims, place, strict=True))
        state = state_of({name: variable.isel(here).values for name, variable in values.items()})  # type: ignore[union-attr]
        large += state is not None and len(state.grains.radii) > MOST_GRAINS
        if state is None or len(state.grains.radii) > MOST_GRAINS:
            found.append(None)
            continue
        alpha, nu = (data[name].values[here[name]] for name in ("restitution", "packing_fraction"))
        timestep = timesteps[here.get("timestep", 0)]
        one = instant_at(state, float(alpha), float(nu), timestep, activation)
        found.append(
            None
            if one is None
            else grain_data(**one._asdict(), scale=scale_of(one.speed, one.force))
        )
    return found, [f"Instants of more than {MOST_GRAINS} grains are not drawn."] if large else []


def _again(data: xr.Dataset, dims: list[str]) -> dict[str, Any] | None:
    """Seeds, sampled strain of a seed at every point with a value, and options; None if the file
    lacks them.

    The reader pastes the command into a shell, so it contains only numbers and known names.
    """
    if (
        not {"seeds", "tolerance", *_NAMED} <= data.attrs.keys() | {"engine"}
        or "sums/strain" not in data
    ):
        return None
    chosen = {}
    for name, accepted in _NAMED.items():
        value = data.attrs.get(f"{name}_requested", data.attrs.get(name, accepted[0]))
        if value not in accepted:
            return None
        chosen[name] = value
    try:
        chosen["tolerance"] = f"{float(data.attrs['tolerance']):g}"
        sizes = "diameters" if "diameters" in data.attrs else "polydispersity"
        if sizes in data.attrs and not np.array_equal(data.attrs[sizes], DEFAULTS[sizes]):
            chosen[sizes] = ",".join(repr(float(x)) for x in np.ravel(data.attrs[sizes]))
        seeds = int(data.attrs["seeds"])
    except (TypeError, ValueError):
        return None
    words = [f"--{name} {value}" for name, value in chosen.items() if value != "auto"]
    strain = _column(
        data["sums/strain"].mean("seed").where(np.isfinite(data.force_ratio)), data, dims
    )
    return {"seeds": seeds, "options": " ".join(words), "strain": numbers(strain)}


def _about(data: xr.Dataset) -> str:
    """A sentence with the parameters that the axes do not show."""
    words = {
        "activation": "{} activation",
        "seeds": "{} seed" if data.attrs.get("seeds") == 1 else "{} seeds",
    }
    return _text(
        ", ".join(
            form.format(data.attrs[name]) for name, form in words.items() if name in data.attrs
        )
    )


def _axis(data: xr.Dataset, name: str) -> list[float]:
    """The values of a dimension; for the number of grains and the time step of a map that has one,
    its attribute.
    """
    if name in data.dims:
        return data[name].values.tolist()
    value = np.ravel(data.attrs.get(name, []))
    return [value[0].item()] if value.size == 1 and value.dtype.kind in "iuf" else []


def _text(value: Any) -> str:
    """An attribute or a name as a short line."""
    return " ".join(str(value).split())[:_LONGEST_TEXT]


def numbers(values: np.ndarray) -> list[float | None]:
    """Numbers to a few digits, or None where they are not finite."""
    return [float(f"{x:.{_DIGITS}g}") if np.isfinite(x) else None for x in values.tolist()]
