"""Write and read the file of a map.

A file ends in a SHA-256 checksum of its content, which other readers of NetCDF ignore. It is
compared first, because the HDF5 library may never return from a damaged file. Files written by
other programs have no checksum.
"""

import hashlib
import os
from pathlib import Path

import xarray as xr

from jaxgran.files import atomic_write, other_version
from jaxgran.io.paths import as_path
from jaxgran.maps.schema import FORMAT_VERSION, RATIO, what_lacks
from jaxgran.model.checks import InputError, short_repr

_MARK = b"SHA-256:"  # between the dataset and its checksum
_DIGEST = hashlib.sha256().digest_size  # bytes


def write_dataset(data: xr.DataTree, path: Path) -> None:
    """Write a map as NetCDF to a temporary file in the same folder, then rename it to ``path``."""
    path.parent.mkdir(parents=True, exist_ok=True)  # it may have been removed during a long run
    no_fill = {
        node.path: {name: {"_FillValue": None} for name in node.coords} for node in data.subtree
    }  # as CF asks
    content = bytes(data.to_netcdf(engine="netcdf4", encoding=no_fill, write_inherited_coords=True))
    with atomic_write(path) as temporary:
        temporary.write_bytes(content + _MARK + hashlib.sha256(content).digest())


def open_map(path: str | Path) -> xr.DataTree:
    """The map of a file, loaded into memory: that of ``ratio_map(output=…)``, of ``jaxgran map`` or
    of ``to_netcdf``.

    Args:
      path: the file.

    Raises:
      InputError: (a ValueError) the file does not exist, cannot be read, is not a map, or has
        another version of the format.
    """
    path = as_path("path", path)
    if not os.path.isfile(path):
        raise InputError(f"there is no file {short_repr(str(path))}.")
    try:
        data = xr.load_datatree(_whole(path), engine="netcdf4")
    except Exception as error:  # an incomplete file may fail in any way
        why = " ".join(str(error).split()).replace(": '<xarray-in-memory-read>'", "").rstrip(".")
        raise InputError(
            f"{short_repr(str(path))} is not a NetCDF file that can be read: {why}."
        ) from None
    problem = what_lacks(data, *RATIO, "status")
    if problem:
        raise InputError(f"{short_repr(str(path))} is not a ratio map: {problem}.")
    if difference := other_version(
        short_repr(str(path)), data.attrs.get("format_version"), FORMAT_VERSION
    ):
        raise InputError(difference)
    return data


def _whole(path: Path) -> bytes:
    """The content of a file; a ValueError if it ends in a checksum that is not its own."""
    whole = path.read_bytes()
    content, end = whole[: -_DIGEST - len(_MARK)], whole[-_DIGEST - len(_MARK) :]
    if end.startswith(_MARK) and end.removeprefix(_MARK) != hashlib.sha256(content).digest():
        raise ValueError("it is damaged, and not what was written")
    return whole
