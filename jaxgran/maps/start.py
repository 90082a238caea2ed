"""What a map starts from: a preset or a file, replaced by the parameters that are given and by what
these imply.
"""

import os
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jaxgran.io.paths import as_path
from jaxgran.maps.attributes import from_attrs
from jaxgran.maps.presets import PRESETS
from jaxgran.maps.provenance import made_with
from jaxgran.maps.results import open_map
from jaxgran.model.checks import InputError, refused

_REPLACED = {
    "error": ("seeds", "strain"),
    "strain": ("error",),
    "polydispersity": ("diameters",),
    "diameters": ("polydispersity",),
}
_OF_POINTS = {"grains", "timestep", "restitution", "packing_fraction", "error"}
_OF_ERROR = {"grains": "auto", "timestep": "auto", "seeds": 1}
"""What an error implies; a longer sample is cheaper than a second seed."""
_COMPARED = ("device", "precision", "commit", "code_digest")  # and all versions


def with_start(
    preset: str | None, from_map: str | os.PathLike | None, given: Mapping[str, Any]
) -> dict[str, Any]:
    """The parameters of a map: those given, on top of those of a preset or of a file.

    Raises:
      InputError: (a ValueError) there is no such preset or map, or both are given.
    """
    name = "quick" if preset is None else preset
    if not isinstance(name, str) or name not in PRESETS:
        *others, last = PRESETS
        raise refused("preset", name, f"must be {', '.join(others)} or {last}")
    if from_map is None:
        return combined(PRESETS[name], given)
    if preset is not None:
        raise InputError("`preset` and `from_map` exclude each other.", field="preset")
    return combined(_parameters_of(as_path("from_map", from_map)), given)


def combined(start: Mapping[str, Any], given: Mapping[str, Any]) -> dict[str, Any]:
    """The parameters of a preset or a file, replaced by those that are given and by what these
    imply.
    """
    replaced = {name for option in _REPLACED.keys() & given.keys() for name in _REPLACED[option]}
    kept = {name: value for name, value in start.items() if name not in replaced}
    if "grains_by_point" in kept and _OF_POINTS & given.keys():
        del kept["grains_by_point"]
        kept["grains"] = "auto"  # chosen again, for the points that are given
    if {"restitution", "packing_fraction"} & given.keys():
        kept.pop("part", None)  # it is one of other points
    implied = _OF_ERROR if "error" in given else {}
    return kept | implied | dict(given)


def _parameters_of(file: Path) -> dict[str, Any]:
    """The parameters of the map in a file; a warning names other differences that could change its
    numbers.
    """
    data, process = open_map(file), made_with()
    settings = from_attrs(data)
    compared = (x for x in process if x.startswith("version_") or x in _COMPARED)
    if different := [
        f"{name.replace('_', ' ')} {data.attrs[name]} there, {process[name]} here"
        for name in compared
        if data.attrs.get(name, process[name]) != process[name]
    ]:
        warnings.warn(f"differs from {file}: {'; '.join(different)}.", stacklevel=4)
    # the tolerance holds for another solver too
    return settings | {"tolerance": getattr(settings["solver"], "tolerance", None)}
