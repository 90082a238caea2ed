"""The settings of a map as attributes of its file, and back; when two maps have the same ones.

The class of a user's own solver and the function of ``observe`` are not in a file, but name and
numbers of the solver and a hash of what the function computes: these are what is compared.
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import fields
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxgran.contact.projected_methods import SOLVERS, solver_name, solver_numbers, solver_text
from jaxgran.dynamics.engine import engine_named
from jaxgran.maps.own_observables import identity_of
from jaxgran.maps.replica import AXES
from jaxgran.maps.settings import DEFAULTS, MapSettings
from jaxgran.model.checks import InputError, short_repr

if TYPE_CHECKING:
    import xarray as xr

_ADDED = ("polydispersity",)  # settings that older maps do not name; they had the default


def to_attrs(settings: MapSettings) -> dict[str, Any]:
    """The settings as attributes, in types that NetCDF can store; what is None is left out.

    ``engine`` and ``solver`` of a file are what ran, so that what was asked for has other names.
    """
    numbers = solver_numbers(settings.solver)
    values = {row.name: getattr(settings, row.name) for row in fields(settings)} | {
        "equilibrate": "until steady" if settings.equilibrate is None else settings.equilibrate,
        "strain": settings.strain if settings.error is None else None,  # sums/strain has it
        "tolerance": numbers["tolerance"],
        "solver": None,
        "engine": None,
        "snapshots": int(settings.snapshots),  # NetCDF has no True and False
        "observe": identity_of(settings),
        "polydispersity": settings.polydispersity if settings.diameters is None else None,
        "engine_requested": "auto" if settings.engine is None else settings.engine.name,
        "solver_requested": solver_name(settings.solver),
        "solver_parameters": json.dumps(numbers),
        "max_steps": numbers["max_steps"],
    }
    values |= {name: _plain(values[name]) for name in AXES}
    return {
        name: list(value) if isinstance(value, tuple) else value
        for name, value in values.items()
        if value is not None
    }


def _plain(axis: tuple[float, ...]) -> Any:
    """The values of an axis, or its one."""
    return axis[0] if len(axis) == 1 else axis


def from_attrs(data: "xr.DataTree") -> dict[str, Any]:
    """The settings of a map, as arguments of ``MapSettings``.

    Engine and solver are those that were requested. A solver of a user's own class and what a user
    observes are given by their texts.

    Raises:
      InputError: (a ValueError) a setting is missing.
    """
    stored: dict[str, Any] = {str(name): value for name, value in data.attrs.items()}
    # one number where one of a list was selected
    stored |= {str(name): axis.values for name, axis in data.coords.items() if name in DEFAULTS}
    settings: dict[str, Any] = {}
    try:
        for row in fields(MapSettings):
            if row.name in stored:
                value = np.asarray(stored[row.name]).tolist()
                settings[row.name] = tuple(value) if isinstance(value, list) else value
            elif row.default is not None and row.name not in _ADDED:
                raise KeyError(row.name)
        for name in (*AXES, "grains_by_point", "diameters"):
            if name in settings:
                settings[name] = tuple(np.atleast_1d(settings[name]).tolist())
        before = settings["equilibrate"]
        return settings | {
            "equilibrate": None if before == "until steady" else before,
            "tolerance": None,  # that of the solver
            "solver": _solver_of(str(stored["solver_requested"]), str(stored["solver_parameters"])),
            "engine": engine_named(stored["engine_requested"]),
            "snapshots": bool(settings["snapshots"]),
        }
    except KeyError as missing:
        raise InputError(f"these data do not contain the {missing.args[0]} of their map.") from None


def _solver_of(name: str, numbers: str) -> Any:
    """The solver that was asked for; its text where its class is not of this package."""
    try:
        return SOLVERS[name](**json.loads(numbers)) if name in SOLVERS else f"{name} {numbers}"
    except (TypeError, json.JSONDecodeError):
        raise InputError(
            f"solver_parameters must be those of {name}, not {short_repr(numbers)}."
        ) from None


def identity(settings: MapSettings | Mapping[str, Any]) -> dict[str, Any]:
    """The settings in types of JSON, by which maps are compared: those of ``from_attrs`` too."""
    if isinstance(settings, MapSettings):
        values = {row.name: getattr(settings, row.name) for row in fields(settings)}
        values["observe"] = identity_of(settings)
    else:
        values = {row.name: settings.get(row.name, row.default) for row in fields(MapSettings)}
    values |= {name: _plain(values[name]) for name in AXES}
    solver, engine = values["solver"], values["engine"]
    values["solver"] = solver if isinstance(solver, str) else solver_text(solver)
    values["engine"] = "auto" if engine is None else engine.name
    return json.loads(json.dumps(values, default=lambda number: number.item()))


def common_identity(values: Mapping[str, Any]) -> dict[str, Any]:
    """The part of an ``identity`` that all replicas of a map have in common: all but its axes, its
    seeds and its part.

    With an ``error`` the number of seeds remains, as the sampled strain depends on it.
    """
    apart = {
        *AXES,
        "grains_by_point",
        "first_seed",
        "part",
        *(() if values["error"] else ("seeds",)),
    }
    return {name: value for name, value in values.items() if name not in apart}


def digest(values: Mapping[str, Any]) -> str:
    """A hash of values in types of JSON."""
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()[:12]


def first_difference(
    values: Mapping[str, Any], others: Mapping[str, Any]
) -> tuple[str, Any, Any] | None:
    """The first name with another value in ``others``, and both values; None if there is none."""
    for name, value in values.items():
        if others.get(name) != value:
            return name, value, others.get(name)
    return None
