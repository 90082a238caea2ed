"""The file of a map: it is written, read and compared.

A file ends in the SHA-256 checksum of what stands before it, which other readers of NetCDF ignore. It is compared
first, as the HDF5 library can wait forever in a damaged file. Files of other programs, and older ones, have none.
"""

import hashlib
import json
import os
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from jaxgran.files import atomic_write
from jaxgran.maps.schema import RATIO, what_lacks
from jaxgran.model.checks import InputError, short_repr

if TYPE_CHECKING:
    from jaxgran.maps.settings import MapSettings

_MARK = b"SHA-256:"  # between the dataset and its checksum
_DIGEST = hashlib.sha256().digest_size  # bytes


def write_dataset(data: xr.Dataset, path: Path) -> None:
    """Write a dataset as NetCDF to a temporary file in the same folder, then rename it to ``path``."""
    path.parent.mkdir(parents=True, exist_ok=True)  # it may have been removed during a long run
    known = {name: {"_FillValue": None} for name in data.coords}  # CF: a coordinate has no missing values
    content = bytes(data.to_netcdf(engine="netcdf4", encoding=known))
    with atomic_write(path) as temporary:
        temporary.write_bytes(content + _MARK + hashlib.sha256(content).digest())


def read_dataset(path: Path, needed: tuple[str, ...] = (*RATIO, "status")) -> xr.Dataset:
    """Read a dataset of ``write_dataset``; InputError if the file is not one.

    A file is one if it has the axes of a map and the variables that are needed.
    """
    if not os.path.isfile(path):
        raise InputError(f"there is no file {short_repr(str(path))}.")
    try:
        data = xr.load_dataset(_whole(path), engine="netcdf4")
    except Exception as error:  # an incomplete file may fail in any way
        why = " ".join(str(error).split()).rstrip(".")
        raise InputError(f"{short_repr(str(path))} is not a NetCDF file that can be read: {why}.") from None
    problem = what_lacks(data, *needed)
    if problem:
        raise InputError(f"{short_repr(str(path))} is not a ratio map: {problem}.")
    return data


def _whole(path: Path) -> bytes:
    """The content of a file; a ValueError if it ends in a checksum that is not its own."""
    whole = path.read_bytes()
    content, end = whole[: -_DIGEST - len(_MARK)], whole[-_DIGEST - len(_MARK) :]
    if end.startswith(_MARK) and end.removeprefix(_MARK) != hashlib.sha256(content).digest():
        raise ValueError("it is damaged, and not what was written")
    return whole


def choices_of(data: xr.Dataset) -> dict[str, Any]:
    """The parameters of the map in a dataset, as arguments of ``MapSettings``; InputError if one is missing.

    The solver of a user's own class is given by its name and numbers, as the class is not in the file.
    """
    from jaxgran.dynamics.engine import engine_named  # here, so that figures are drawn without loading JAX
    from jaxgran.maps.settings import MapSettings

    chosen: dict[str, Any] = {}
    try:
        for field in fields(MapSettings):
            if field.name in ("solver", "engine"):
                continue
            attribute = next((name for name in (f"{field.name}_requested", field.name) if name in data.attrs), None)
            if field.name in data.coords:  # one number where one of a list was selected
                values = data[field.name].values.tolist()
                chosen[field.name] = tuple(values) if isinstance(values, list) else values
            elif attribute is not None:
                chosen[field.name] = np.asarray(data.attrs[attribute]).tolist()
            elif field.name not in (
                "strain",
                "error",
                "grains_by_point",
                "snapshots",
                "first_seed",
            ):  # not in all files
                raise KeyError(field.name)
        chosen["equilibrate"] = None if chosen["equilibrate"] == "until steady" else chosen["equilibrate"]
        chosen["snapshots"] = bool(chosen.get("snapshots"))
        chosen |= {"solver": _solver_of(data), "engine": engine_named(data.attrs["engine_requested"])}
        return chosen | {
            name: tuple(np.atleast_1d(chosen[name]).tolist())
            for name in ("restitution", "packing_fraction", "grains_by_point")
            if name in chosen
        }
    except KeyError as missing:
        raise InputError(f"this dataset does not contain the {missing.args[0]} of its map.") from None


def _solver_of(data: xr.Dataset) -> Any:
    """The solver that was asked for; name and numbers where its class is not of this package."""
    from jaxgran.contact.projected_methods import SOLVERS

    name, numbers = str(data.attrs["solver_requested"]), str(data.attrs["solver_parameters"])
    try:
        return SOLVERS[name](**json.loads(numbers)) if name in SOLVERS else f"{name} {numbers}"
    except (TypeError, json.JSONDecodeError):
        raise InputError(f"solver_parameters must be those of {name}, not {short_repr(numbers)}.") from None


def earlier_map(path: Path, settings: "MapSettings") -> tuple[xr.Dataset | None, str]:
    """The map that is in a file already, or None, and what a map of these settings would replace there, in words.

    The words are "" if it is a map of the same settings.
    """
    from jaxgran.contact.projected_methods import solver_name, solver_numbers

    try:
        data = read_dataset(path)
        chosen = choices_of(data)
    except InputError:
        return None, "what is no map of this version"
    for field in fields(settings):
        there, here = chosen.get(field.name, field.default), getattr(settings, field.name)
        if isinstance(there, str) and field.name == "solver":
            here = f"{solver_name(here)} {json.dumps(solver_numbers(here))}"
        if there != here:
            return data, f"a map with {field.name} {short_repr(there)} and not {short_repr(here)}"
    return data, ""


def is_finished(data: xr.Dataset) -> bool:
    """Whether a map has all its replicas."""
    flags = dict(zip(data.status.attrs["flag_meanings"].split(), data.status.attrs["flag_values"], strict=True))
    missing = [flags[name] for name in ("not_run", "failed") if name in flags]
    return not np.isin(data.get("status_by_seed", data.status), missing).any()


def differences(data: xr.Dataset) -> list[str]:
    """Differences between the versions, device and precision of a dataset and of this process, in words."""
    from jaxgran.maps.dataset import made_with

    here = made_with()
    names = [name for name in here if name.startswith("version_") or name in ("device", "precision", "commit")]
    return [
        f"{name.replace('_', ' ')} {data.attrs[name]} there, {here[name]} here"
        for name in names
        if name in data.attrs and data.attrs[name] != here[name]
    ]
