"""Merge maps: parts of one map that ran apart, and maps of the same settings with other seeds."""

import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import xarray as xr

from jaxgran.contact.projected_methods import ProjectedMethod, solver_text
from jaxgran.maps.attributes import first_difference, from_attrs, identity
from jaxgran.maps.dataset import map_dataset
from jaxgran.maps.own_observables import identity_of
from jaxgran.maps.provenance import DECIDING
from jaxgran.maps.replica import Key, Replica
from jaxgran.maps.results import open_map
from jaxgran.maps.settings import MapSettings
from jaxgran.maps.sums import replicas_of
from jaxgran.model.checks import InputError, short_repr

_OF_PARTS = ("first_seed", "seeds", "part")  # in which the maps may differ
_SUMMED = ("wall_time_seconds", "resumed_replicas")
_EQUAL = ("precision", "code_digest", *(f"version_{name}" for name in DECIDING))


def merge_maps(
    maps: Sequence[xr.DataTree | str | Path],
    observe: Callable[..., Any] | None = None,
    solver: ProjectedMethod | None = None,
) -> xr.DataTree:
    """One map of the replicas of several maps: of parts, of other seeds, or of both.

    The result is that of one run, bit for bit: averages, standard errors and all else are computed
    from the sums of all replicas, so the scatter between seeds of different maps is in the errors.
    Points that no map has are NaN with the status ``not_run``.

    Args:
      maps: data of maps, as ``ratio_map`` returns them, or their files. They have the same settings
        except ``part``, ``seeds`` and ``first_seed``, and their seeds follow one another.
      observe: the function that the maps were made with, if they were made with one, as files do
        not contain it.
      solver: the solver that the maps were made with, if it is of the user's own class, as files do
        not contain it.

    Raises:
      InputError: (a ValueError) the maps differ in a setting, a version or the precision; two have
        the same replica; seeds are missing in between; or a map has no sums, as those that an
        earlier version wrote.

    Examples:
      >>> from jaxgran import ratio_map
      >>> settings = dict(restitution=[0.9], packing_fraction=[0.5], grains=16, seeds=1)
      >>> settings |= dict(strain=0.4, equilibrate=0.0)
      >>> merged = merge_maps([ratio_map(**settings), ratio_map(**settings, first_seed=1)])
      >>> merged["sums"].sizes["seed"]
      2
    """
    path = (str, os.PathLike)
    is_list = isinstance(maps, (list, tuple)) and len(maps) > 0
    if not is_list or not all(isinstance(one, (*path, xr.DataTree)) for one in maps):
        raise InputError(
            f"maps must be a list of at least one map or file, not {short_repr(maps)}."
        )
    names = [
        short_repr(str(one)) if isinstance(one, path) else f"map {k}" for k, one in enumerate(maps)
    ]
    opened = [open_map(one) if isinstance(one, path) else one for one in maps]
    chosen = [from_attrs(one) for one in opened]
    compared = [
        identity(settings) | {name: data.attrs.get(name) for name in _EQUAL}
        for settings, data in zip(chosen, opened, strict=True)
    ]
    for name, values in zip(names, compared, strict=True):
        if difference := first_difference(compared[0], values, but=_OF_PARTS):
            key, *both = difference
            first, other = map(short_repr, both)
            raise InputError(
                f"maps must have the same settings, and {key} is {first} in {names[0]} and {other} "
                f"in {name}."
            )
    seeds = {one["first_seed"] + seed for one in chosen for seed in range(one["seeds"])}
    if missing := {*range(min(seeds), max(seeds))} - seeds:
        raise InputError(
            f"the seeds of the maps must follow one another, and seed {min(missing)} is missing."
        )
    if "error" in chosen[0] and {one["seeds"] for one in chosen} != {len(seeds)}:
        raise InputError(
            "maps with an `error` sample by their number of seeds, so they cannot be merged with "
            "other seeds."
        )
    method: Any = chosen[0]["solver"] if solver is None else solver
    text = compared[0]["solver"]
    if isinstance(method, str) or solver_text(method) != text:  # a text is that of a user's class
        raise InputError(f"solver must be that of the maps, which is {text}.")
    merged = {"first_seed": min(seeds), "seeds": len(seeds), "part": None}
    with jax.enable_x64(opened[0].attrs["precision"] == "float64"):
        settings = MapSettings(**{**chosen[0], **merged, "observe": observe, "solver": method})
        return _joined(names, chosen, opened, settings)


def _joined(
    names: list[str],
    chosen: list[dict[str, Any]],
    opened: Sequence[xr.DataTree],
    settings: MapSettings,
) -> xr.DataTree:
    """The map of all replicas."""
    if identity_of(settings) != chosen[0].get("observe"):
        raise InputError(
            f"observe must be the function of the maps, which is {chosen[0].get('observe')}."
        )
    replicas: dict[Key, Replica | None] = {}
    origin: dict[Key, str] = {}
    for name, one, data in zip(names, chosen, opened, strict=True):
        offset = one["first_seed"] - settings.first_seed
        for (point, seed), replica in replicas_of(
            data, replace(settings, seeds=one["seeds"])
        ).items():
            key = point, seed + offset
            if key in replicas:
                where = f"seed {key[1] + settings.first_seed} of point {point}"
                raise InputError(
                    f"maps must have no replica in common, and {origin[key]} and {name} have "
                    f"{where}."
                )
            replicas[key], origin[key] = replica, name
    return map_dataset(settings, replicas, _attributes(opened))


def _attributes(maps: Sequence[xr.DataTree]) -> dict[str, Any]:
    """Attributes of the runs: times add up, and what differs is listed."""
    left_out = {
        *_OF_PARTS,
        "part_points",
        "history",
        "command",
        "replica_steps_per_second",
        "workers",
    }
    attributes: dict[str, Any] = {
        str(name): value for name, value in maps[0].attrs.items() if name not in left_out
    }
    for name, value in attributes.items():
        values = [one.attrs.get(name) for one in maps]
        if name in _SUMMED:
            attributes[name] = sum(filter(None, values))
        elif isinstance(value, str):
            attributes[name] = "; ".join(dict.fromkeys(str(one) for one in values))
    return attributes | {"command": "jaxgran.merge_maps"}
