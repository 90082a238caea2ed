"""Merge maps: parts of one map that ran apart, and maps of the same settings with other seeds."""

import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaxgran.maps.provenance import DECIDING
from jaxgran.maps.replica import Key, Replica
from jaxgran.model.checks import InputError, short_repr

if TYPE_CHECKING:
    import xarray as xr

    from jaxgran.contact.projected_methods import ProjectedMethod
    from jaxgran.maps.settings import MapSettings

_OF_PARTS = ("first_seed", "seeds", "part")  # in which the maps may differ
_SUMMED = ("wall_time_seconds", "resumed_replicas")
_EQUAL = ("precision", "code_digest", *(f"version_{name}" for name in DECIDING))


def merge_maps(
    maps: "Sequence[xr.DataTree | str | Path]",
    observe: Callable[..., Any] | None = None,
    solver: "ProjectedMethod | None" = None,
) -> "xr.DataTree":
    """One map of the replicas of several maps: of parts, of other seeds, or of both.

    The result is that of one run, bit for bit: averages, standard errors and all else are computed
      from the sums of all replicas, so the scatter between seeds of different maps is in the
      errors. Points that no map has are NaN with the status ``not_run``.

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
      >>> merged["seeds"].sizes["seed"]
      2
    """
    import jax
    from xarray import DataTree

    from jaxgran.contact.projected_methods import solver_text
    from jaxgran.maps.results import choices_of, open_map
    from jaxgran.maps.settings import MapSettings

    accepted = (str, os.PathLike, DataTree)
    if (
        not isinstance(maps, (list, tuple))
        or not maps
        or not all(isinstance(one, accepted) for one in maps)
    ):
        raise InputError(
            f"maps must be a list of at least one map or file, not {short_repr(maps)}."
        )
    names = [
        short_repr(str(one)) if isinstance(one, (str, os.PathLike)) else f"map {k}"
        for k, one in enumerate(maps)
    ]
    opened = [open_map(one) if isinstance(one, (str, os.PathLike)) else one for one in maps]
    chosen = [choices_of(one) for one in opened]
    for name, one, data in zip(names, chosen, opened, strict=True):
        _require_same(names[0], chosen[0], name, one, [*chosen[0], *one], _OF_PARTS)
        _require_same(names[0], opened[0].attrs, name, data.attrs, _EQUAL)
    numbers = sorted({one["first_seed"] + seed for one in chosen for seed in range(one["seeds"])})
    if numbers != list(range(numbers[0], numbers[-1] + 1)):
        missing = next(seed for seed in range(numbers[0], numbers[-1]) if seed not in numbers)
        raise InputError(
            f"the seeds of the maps must follow one another, and seed {missing} is missing."
        )
    if (
        chosen[0].get("error") is not None
        and len({one["seeds"] for one in chosen} | {len(numbers)}) > 1
    ):
        raise InputError(
            "maps with an `error` sample by their number of seeds, so they cannot be merged with "
            "other seeds."
        )
    merged: dict[str, Any] = {
        **chosen[0],
        "first_seed": numbers[0],
        "seeds": len(numbers),
        "observe": observe,
    }
    own = chosen[0]["solver"]  # of a user's class: its text
    text = own if isinstance(own, str) else solver_text(own)
    if (solver is not None or own is text) and (solver is None or solver_text(solver) != text):
        raise InputError(f"solver must be that of the maps, which is {text}.")
    merged["solver"] = own if solver is None else solver
    with jax.enable_x64(opened[0].attrs["precision"] == "float64"):
        settings = MapSettings(**{name: value for name, value in merged.items() if name != "part"})
        return _joined(names, chosen, opened, settings)


def _joined(
    names: list[str],
    chosen: list[dict[str, Any]],
    opened: "Sequence[xr.DataTree]",
    settings: "MapSettings",
) -> "xr.DataTree":
    """The map of all replicas."""
    from jaxgran.maps.dataset import map_dataset
    from jaxgran.maps.own_observables import identity_of
    from jaxgran.maps.sums import replicas_of

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


def _require_same(
    first: str, here: Any, name: str, there: Any, keys: Sequence[str], but: Sequence[str] = ()
) -> None:
    for key in keys:
        if key not in but and here.get(key) != there.get(key):
            values = (
                f"{short_repr(here.get(key))} in {first} and {short_repr(there.get(key))} in {name}"
            )
            raise InputError(f"maps must have the same settings, and {key} is {values}.")


def _attributes(maps: "Sequence[xr.DataTree]") -> dict[str, Any]:
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
