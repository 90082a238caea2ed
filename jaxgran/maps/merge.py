"""Merge maps: the union of their replicas, which are identified by α, ν, N, dt and seed."""

import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import xarray as xr

from jaxgran.contact.projected_methods import ProjectedMethod, solver_text
from jaxgran.maps.attributes import common_identity, first_difference, from_attrs, identity
from jaxgran.maps.dataset import map_dataset
from jaxgran.maps.own_observables import identity_of
from jaxgran.maps.provenance import DECIDING
from jaxgran.maps.replica import AXES, union
from jaxgran.maps.results import open_map
from jaxgran.maps.rows import replicas_of
from jaxgran.maps.settings import MapSettings
from jaxgran.model.checks import InputError, short_repr

_LEFT_OUT = (
    *(*AXES, "grains_by_point", "first_seed", "seeds", "part", "part_points"),
    *("history", "command", "replica_steps_per_second", "workers"),
)
"""Attributes of the maps that are not those of the merged one."""
_SUMMED = ("wall_time_seconds", "resumed_replicas")
_EQUAL = ("precision", "code_digest", "random_bits", *(f"version_{name}" for name in DECIDING))


def merge_maps(
    maps: Sequence[xr.DataTree | str | Path],
    observe: Callable[..., Any] | None = None,
    solver: ProjectedMethod | None = None,
) -> xr.DataTree:
    """One map of the replicas of several maps: of parts, of other seeds, or of other axes.

    Each axis of the result has the values of all maps. The result is that of a single run, bit for
    bit: averages and standard errors are computed from the sums of all replicas, so errors include
    the scatter between seeds of different maps. Of a replica that occurs twice, the first counts.
    Points that no map has are NaN with the status ``not_run``; a point may have fewer seeds than
    others.

    Args:
      maps: data of maps, as ``ratio_map`` returns them, or their files. All settings but the axes,
        ``part``, ``seeds`` and ``first_seed`` are the same, and the seeds follow one another.
      observe: the function that the maps were made with, if they were made with one, as files do
        not contain it.
      solver: the solver that the maps were made with, if it is of the user's own class, as files do
        not contain it.

    Raises:
      InputError: (a ValueError) the maps differ in a setting, a version or the precision; seeds are
        missing in between; or a map has no sums, as those that an earlier version wrote.

    Examples:
      >>> from jaxgran import ratio_map
      >>> settings = dict(packing_fraction=[0.5], grains=16, seeds=1, strain=0.4, equilibrate=0.0)
      >>> maps = [ratio_map(alpha, **settings) for alpha in ([0.8], [0.9])]
      >>> merge_maps(maps).restitution.values.tolist()
      [0.8, 0.9]
    """
    path = (str, os.PathLike)
    is_list = isinstance(maps, (list, tuple))
    if not (is_list and maps) or not all(
        isinstance(source, (*path, xr.DataTree)) for source in maps
    ):
        kinds = [type(source).__name__ for source in maps] if is_list else type(maps).__name__
        raise InputError(
            f"maps must be a list of at least one map, a DataTree, or file, not {kinds}."
        )
    names = [
        short_repr(str(source)) if isinstance(source, path) else f"map {k}"
        for k, source in enumerate(maps)
    ]
    opened = [open_map(source) if isinstance(source, path) else source for source in maps]
    chosen = [from_attrs(data) for data in opened]
    _require_same(names, chosen, opened)
    method: Any = chosen[0]["solver"] if solver is None else solver
    text = identity(chosen[0])["solver"]
    if isinstance(method, str) or solver_text(method) != text:  # a text is that of a user's class
        raise InputError(f"solver must be that of the maps, which is {text}.")
    given = {"observe": observe, "solver": method}
    with jax.enable_x64(opened[0].attrs["precision"] == "float64"):
        return _union(
            [MapSettings(**{**parameters, **given}) for parameters in chosen], chosen, opened
        )


def _require_same(
    names: Sequence[str], chosen: Sequence[dict[str, Any]], maps: Sequence[xr.DataTree]
) -> None:
    """Raise an InputError unless the replicas of all maps belong to one."""
    compared = []
    for settings, data in zip(chosen, maps, strict=True):
        of_run = {name: data.attrs.get(name) for name in _EQUAL}
        compared.append(common_identity(identity(settings)) | of_run)
        if any("grains_by_point" in parameters for parameters in chosen):
            compared[-1] |= {name: settings.get(name) for name in (*AXES, "grains_by_point")}
    for name, values in zip(names, compared, strict=True):
        if difference := first_difference(compared[0], values):
            key, *both = difference
            first, other = map(short_repr, both)
            raise InputError(
                f"maps must have the same settings, and {key} is {first} in {names[0]} and {other} "
                f"in {name}."
            )


def _union(
    parts: Sequence[MapSettings], chosen: Sequence[dict[str, Any]], maps: Sequence[xr.DataTree]
) -> xr.DataTree:
    """The map of all replicas."""
    settings = _union_of_settings(parts)
    if identity_of(settings) != chosen[0].get("observe"):
        raise InputError(
            f"observe must be the function of the maps, which is {chosen[0].get('observe')}."
        )
    tables = (replicas_of(data, part) for part, data in zip(parts, maps, strict=True))
    return map_dataset(settings, union(*tables).values(), _attributes(maps), fewer_seeds=True)


def _union_of_settings(parts: Sequence[MapSettings]) -> MapSettings:
    """The settings with all values of the axes and all seeds."""
    seeds = {seed for part in parts for seed in part.seed_numbers}
    if missing := {*range(min(seeds), max(seeds))} - seeds:
        raise InputError(
            f"the seeds of the maps must follow one another, and seed {min(missing)} is missing."
        )
    if parts[0].error is not None and parts[0].seeds != len(seeds):
        raise InputError(
            "maps with an `error` sample by their number of seeds, so they cannot be merged with "
            "other seeds."
        )
    axes: dict[str, Any] = {
        name: tuple(dict.fromkeys(value for part in parts for value in part.axes[name]))
        for name in AXES
    }
    seeds_of_all = {"first_seed": min(seeds), "seeds": len(seeds), "part": None}
    return replace(parts[0], **axes, **seeds_of_all)


def _attributes(maps: Sequence[xr.DataTree]) -> dict[str, Any]:
    """Attributes of the runs: times add up, and what differs is listed."""
    attributes: dict[str, Any] = {
        str(name): value for name, value in maps[0].attrs.items() if name not in _LEFT_OUT
    }
    for name, value in attributes.items():
        values = [data.attrs.get(name) for data in maps]
        if name in _SUMMED:
            attributes[name] = sum(filter(None, values))
        elif isinstance(value, str):
            attributes[name] = "; ".join(dict.fromkeys(map(str, values)))
    return attributes | {"command": "jaxgran.merge_maps"}
