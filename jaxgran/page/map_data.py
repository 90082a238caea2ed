"""The data of the page of a map, in types of JSON: all that is rounded or worded.

The scripts of the page only choose among these data and draw them.
"""

from typing import Any, get_args

import numpy as np
import xarray as xr

from jaxgran.maps.replica import AXES
from jaxgran.maps.schema import MapData
from jaxgran.model.choices import Activation
from jaxgran.model.display import counted
from jaxgran.model.status import MEANINGS
from jaxgran.page.grain_data import ENCODING, MOST_GRAINS, grain_data
from jaxgran.page.observables import COLUMNS, column, numbers, observables_of, text_line
from jaxgran.page.reference_map import verdicts
from jaxgran.plotting.plane import EXCESS_LEVELS
from jaxgran.plotting.selection import points, status_names

MOST_POINTS = 2500
"""Points of a page; of a larger map a part is shown."""

_PARAMETERS = {  # label of the list of values, and form in a heading
    "restitution": ("Restitution α", "α = {}"),
    "packing_fraction": ("Packing fraction ν", "ν = {}"),
    "grains": ("Grains N", "N = {}"),
    "timestep": ("Time step dt (1/γ̇)", "dt = {}/γ̇"),
}


def map_data(data: MapData) -> dict[str, Any]:
    """What the page of a map shows; lists by point go through number of grains, time step, packing
    fraction and restitution, the last one fastest.

    ==============  ================================================================================
    key             content
    ==============  ================================================================================
    choices         name, label and texts of each list to choose from
    x, y            1 − α and ν of the plane
    observables     label and meaning; texts of the columns of the table; and views, of itself and
                    over kinetic theory: value, error, theory. The first is the force ratio
    levels          contours of the excess of the force ratio
    headings, bad,  of each point: its parameters, whether its status is bad, and the status in
    status          words
    instants        grains and forces of each point, see ``grain_data``
    reference       what the reference map says of each point of the plane, see ``verdicts``
    ==============  ================================================================================

    Raises:
      InputError: (a ValueError) the data are no map.
    """
    whole = points(data, "force_ratio")
    shown = _thinned(whole)
    observables, flows = list(observables_of(shown)), _flows(shown)
    texts = {x: [plain(y) for y in shown[x].values] for x in _PARAMETERS if x in shown.coords}
    forms = [_PARAMETERS[name][1] for name in flows]
    statuses = status_names(shown).ravel().tolist()
    fewer = [name for name in AXES if shown.sizes[name] < whole.sizes[name]]
    parts = (f"{shown.sizes[x]} of {whole.sizes[x]} values of {x.replace('_', ' ')}" for x in fewer)
    lists = {name: (label, texts.get(name, ["–"])) for name, (label, _) in _PARAMETERS.items()}
    lists = {"observable": ("Observable", [x["label"] for x in observables]), **lists}
    return {
        "title": text_line(shown.attrs.get("title", "Map of sheared grains")),
        "about": _about(shown, texts),
        "notes": f"This page shows a part of the map: {', '.join(parts)}." if fewer else "",
        "choices": [
            {"name": name, "label": label, "texts": values}
            for name, (label, values) in lists.items()
        ],
        "x": numbers(1 - shown.restitution.values),
        "y": shown.packing_fraction.values.tolist(),
        "columns": COLUMNS,
        "observables": observables,
        "levels": EXCESS_LEVELS,
        "headings": [
            ", ".join(form.format(plain(x)) for form, x in zip(forms, flow, strict=True))
            for flow in zip(*flows.values(), strict=True)
        ],
        "bad": [status != "ok" for status in statuses],
        "status": [
            f"Status {name.replace('_', ' ')}{': ' * (name in MEANINGS)}{MEANINGS.get(name, '')}."
            for name in statuses
        ],
        "instants": _instants(shown, flows),
        "encoding": ENCODING,
        "reference": verdicts(shown.packing_fraction.values, shown.restitution.values),
    }


def _thinned(data: xr.Dataset) -> xr.Dataset:
    """At most ``MOST_POINTS`` points: every other value of the longest axis, until there are."""
    while data.force_ratio.size > MOST_POINTS:
        longest = max(AXES, key=lambda name: data.sizes[name])
        data = data.isel({longest: slice(None, None, 2)})
    return data


def _flows(data: xr.Dataset) -> dict[str, np.ndarray]:
    """The known parameters by point; N is that of the point where it was chosen by point."""
    known = {name: data[name] for name in _PARAMETERS if name in data.coords}
    known |= {"grains": data["point_grains"]} if "point_grains" in data else {}
    return {name: column(values, data) for name, values in known.items()}


def _instants(data: xr.Dataset, flows: dict[str, np.ndarray]) -> list[dict[str, Any] | None] | None:
    """Grains and forces of every point, None where a point has none or too many; None if the map
    has none.
    """
    from jaxgran.maps.states import FIELDS, instant_at, state_of  # here, as only this needs JAX

    activation: Any = data.attrs.get("activation")
    paths = {name: f"states/{name}" for name in FIELDS}
    known = {*paths.values()} <= {*data} and "timestep" in flows
    if activation not in get_args(Activation) or not known:
        return None
    states = data[list(paths.values())].stack(point=AXES)

    def instant(k: int) -> dict[str, Any] | None:
        values = states.isel(point=k)
        state = state_of({name: values[path].values for name, path in paths.items()})
        if state is None or len(state.grains.radii) > MOST_GRAINS:
            return None
        alpha, nu, step = (
            flows[name][k].item() for name in ("restitution", "packing_fraction", "timestep")
        )
        network = instant_at(state, alpha, nu, step, activation)
        return None if network is None else grain_data(network)

    return [instant(k) for k in range(states.sizes["point"])]


def _about(data: xr.Dataset, texts: dict[str, list[str]]) -> str:
    """The parameters of a map, and how to read its page."""
    known = [name for name in ("grains", "timestep") if name in texts]
    words = [_PARAMETERS[name][1].format(", ".join(texts[name])) for name in known]
    words += [f"{data.attrs['activation']} activation"] if "activation" in data.attrs else []
    words += [counted(data.attrs["seeds"], "seed")] if "seeds" in data.attrs else []
    words += ["error bars of one standard error of sampling"]
    return f"{text_line(', '.join(words))}. Choose a point by a click, or with the arrow keys."


def plain(value: float) -> str:
    """A number as it is written by hand: 0.76, 1e-5."""
    if 0 < abs(value) < 1e-3:
        return np.format_float_scientific(value, trim="-", exp_digits=1)
    return f"{value:.12g}"
