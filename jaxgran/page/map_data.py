"""The data of the page of a map, in types of JSON: all that is rounded, interpolated or worded.

The scripts of the page only choose among these data and draw them.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
import xarray as xr

from jaxgran.maps.schema import MapData, flag_names, require_map
from jaxgran.maps.settings import DEFAULTS, options
from jaxgran.model.checks import InputError
from jaxgran.model.status import MEANINGS
from jaxgran.page.grain_data import ENCODING, MOST_GRAINS, grain_data
from jaxgran.page.observables import (
    AXES,
    COLUMNS,
    LEVELS,
    column,
    excess_lines,
    numbers,
    observables_of,
    plain,
    text_line,
    with_excess,
)
from jaxgran.page.reference_map import verdicts

MOST_POINTS = 2500
"""Points of a page; of a larger map a part is shown."""

_NAMED = {
    name: option.kind for name, option in options("run").items() if isinstance(option.kind, tuple)
}  # choices of a run


def map_data(data: MapData) -> dict[str, Any]:
    """What the page of a map shows; lists by point go through number of grains, time step, packing
    fraction and restitution, the last one fastest.

    ==============  ================================================================================
    key             content
    ==============  ================================================================================
    choices         name, label and texts of each list to choose from
    x, y            1 − α and ν of the plane
    observables     name, label, meaning; texts of the columns of the table; and views, of itself
                    and over kinetic theory: values, errors, theory, and scales with their levels
    excess          contours of the excess of each number of grains and time step
    headings, bad,  words for each point: its parameters, its status and whether that is bad, and
    status, again   the command that measures it again, empty where the file does not tell
    instants        grains and forces of each point, see ``grain_data``
    reference       what the reference map says of each point of the plane, see ``verdicts``
    ==============  ================================================================================

    Raises:
      InputError: (a ValueError) the data are no map, or have nothing to show.
    """
    whole = require_map(data)
    whole = whole.assign_coords({n: _single(whole, n) for n in AXES if n not in whole.dims})
    whole = with_excess(whole.sortby(list(AXES)))
    shown = _thinned(whole)
    observables = list(observables_of(shown))
    if not observables:
        raise InputError("data must be a ratio map, and it has no number at its points.")
    axes = {name: shown[name].values for name in AXES}
    texts = {name: [plain(value) for value in values] for name, values in axes.items()}
    statuses = _statuses(shown)
    parts = [
        f"{shown.sizes[name]} of {whole.sizes[name]} values of {name.replace('_', ' ')}"
        for name in AXES
        if shown.sizes[name] < whole.sizes[name]
    ]
    return {
        "title": text_line(shown.attrs.get("title", "Map of sheared grains")),
        "about": _about(shown, texts),
        "notes": f"This page shows a part of the map: {', '.join(parts)}." if parts else "",
        "choices": [
            {
                "name": "observable",
                "label": "Observable",
                "texts": [x["label"] for x in observables],
            },
            *({"name": name, "label": AXES[name], "texts": texts[name]} for name in reversed(AXES)),
            {"name": "levels", "label": "Contour levels", "texts": list(LEVELS)},
        ],
        "x": numbers(1 - axes["restitution"]),
        "y": axes["packing_fraction"].tolist(),
        "columns": COLUMNS,
        "observables": observables,
        "excess": excess_lines(shown),
        "headings": [_heading(point) for point in _points(shown)],
        "bad": [status != "ok" for status in statuses],
        "status": [
            f"Status {name.replace('_', ' ')}{': ' * (name in MEANINGS)}{MEANINGS.get(name, '')}."
            for name in statuses
        ],
        "again": _commands(shown),
        "instants": _instants(shown),
        "encoding": ENCODING,
        "reference": verdicts(axes["packing_fraction"], axes["restitution"]),
    }


def _single(data: xr.Dataset, name: str) -> list[float]:
    """The one value of a dimension that a map lacks, NaN if it is not known."""
    value = np.ravel(data.attrs.get(name, []))
    return [value[0].item() if value.size == 1 and value.dtype.kind in "iuf" else np.nan]


def _thinned(data: xr.Dataset) -> xr.Dataset:
    """The map with at most ``MOST_POINTS`` points: every other value of the longest axis, until it
    is.
    """
    sizes = {name: data.sizes[name] for name in AXES}
    if np.prod(list(sizes.values())) <= MOST_POINTS:
        return data
    return _thinned(data.isel({max(sizes, key=lambda name: sizes[name]): slice(None, None, 2)}))


def _points(data: xr.Dataset) -> Iterator[dict[str, float]]:
    """The parameters of every point; N is its own number of grains where it was chosen by point."""
    mesh = np.meshgrid(*(data[name].values for name in AXES), indexing="ij")
    columns = dict(zip(AXES, (values.ravel() for values in mesh), strict=True))
    if "point_grains" in data:
        columns["grains"] = column(data["point_grains"], data)
    for values in zip(*columns.values(), strict=True):
        yield dict(zip(AXES, values, strict=True))


def _heading(point: dict[str, float]) -> str:
    forms = {"restitution": "α = {}", "packing_fraction": "ν = {}", "grains": "N = {}"}
    known = {n: x for n, x in (forms | {"timestep": "dt = {}/γ̇"}).items() if np.isfinite(point[n])}
    return ", ".join(form.format(plain(point[name])) for name, form in known.items())


def _statuses(data: xr.Dataset) -> list[str]:
    """The name of the status of every point."""
    if "status" not in data:
        return ["ok"] * int(np.prod([data.sizes[name] for name in AXES]))
    names = flag_names(data.status) if "flag_values" in data.status.attrs else {}
    return [names.get(int(code), f"{code:g}") for code in column(data.status, data)]


def _commands(data: xr.Dataset) -> list[str]:
    """The command that measures each point again with half its standard error: four times the
    strain.

    The reader pastes it into a shell, so it contains only numbers and known names.
    """
    attrs, unknown = data.attrs, [""] * int(np.prod([data.sizes[name] for name in AXES]))
    chosen = {n: attrs.get(f"{n}_requested", attrs.get(n, kind[0])) for n, kind in _NAMED.items()}
    needed = {"seeds", "tolerance", *_NAMED} - {"engine"}
    known = all(value in _NAMED[name] for name, value in chosen.items())
    if not known or not needed <= attrs.keys() or "sums/strain" not in data:
        return unknown
    sizes = "diameters" if "diameters" in attrs else "polydispersity"
    try:
        chosen |= {"tolerance": f"{float(attrs['tolerance']):g}", "seeds": str(int(attrs["seeds"]))}
        if sizes in attrs and not np.array_equal(attrs[sizes], DEFAULTS[sizes]):
            chosen[sizes] = ",".join(repr(float(x)) for x in np.ravel(attrs[sizes]))
    except (TypeError, ValueError):
        return unknown
    fixed = {name: value for name, value in chosen.items() if value != "auto"}
    measured = column(data["sums/strain"].mean("seed").where(np.isfinite(data.force_ratio)), data)
    points = zip(_points(data), measured, strict=True)
    return [_command(point, strain, fixed) for point, strain in points]


def _command(point: dict[str, float], strain: float, fixed: dict[str, str]) -> str:
    if not np.isfinite([*point.values(), strain]).all():
        return ""
    flow = {name: plain(value) for name, value in reversed(point.items())}
    words = flow | {"strain": plain(float(f"{4 * strain:.3g}"))} | fixed | {"output": "point.nc"}
    options = (f"--{name.replace('_', '-')} {word}" for name, word in words.items())
    return f"jaxgran map {' '.join(options)}"


def _instants(data: xr.Dataset) -> list[dict[str, Any] | None] | None:
    """Grains and forces of every point, None where a point has none or too many; None if the map
    has none.
    """
    from jaxgran.maps.states import FIELDS, instant_at, state_of  # here, as only this needs JAX

    activation = data.attrs.get("activation")
    if activation not in _NAMED["activation"] or any(f"states/{x}" not in data for x in FIELDS):
        return None
    fields = {name: data[f"states/{name}"] for name in FIELDS}

    def instant(place: dict[str, int], point: dict[str, float]) -> dict[str, Any] | None:
        fields_here = {n: x.isel(place, missing_dims="ignore").values for n, x in fields.items()}
        state = state_of(fields_here)
        if state is None or len(state.grains.radii) > MOST_GRAINS or np.isnan(point["timestep"]):
            return None
        alpha, nu, step = (float(point[x]) for x in ("restitution", "packing_fraction", "timestep"))
        network = instant_at(state, alpha, nu, step, activation)
        return None if network is None else grain_data(network)

    places = np.ndindex(*(data.sizes[name] for name in AXES))
    return [
        instant(dict(zip(AXES, place, strict=True)), point)
        for place, point in zip(places, _points(data), strict=True)
    ]


def _about(data: xr.Dataset, texts: dict[str, list[str]]) -> str:
    """The parameters of a map, and how to read its page."""
    seeds, activation = data.attrs.get("seeds"), data.attrs.get("activation")
    known = {name: np.isfinite(data[name]).all() for name in ("grains", "timestep")}
    words = [
        f"N = {', '.join(texts['grains'])}" if known["grains"] else "",
        f"dt = {', '.join(texts['timestep'])}/γ̇" if known["timestep"] else "",
        f"{activation} activation" if activation else "",
        f"{seeds} seed" if seeds == 1 else f"{seeds} seeds" if seeds else "",
        "error bars of one standard error of sampling",
    ]
    excess = "The excess is the force ratio − 1. " if "excess" in data else ""
    sentence = f"{text_line(', '.join(filter(None, words)))}. {excess}"
    return f"{sentence}Choose a point by a click, or with the arrow keys."
