"""Checks of output paths, and named arrays in HDF5 files with a checksum.

The SHA-256 checksum follows the HDF5 content, and other readers ignore it. Content is assembled and
parsed in memory: a full disk then raises an ``OSError`` with its errno, and the HDF5 library, which
may crash on a damaged file, never sees one. Dimensions are not named, since naming them takes ten
times as long as everything else.
"""

import io
import json
import os
import tempfile
from collections.abc import Mapping
from pathlib import Path

import netCDF4  # noqa: F401 must precede h5py: if both bundle the same HDF5, netCDF4 fails when loaded second
import numpy as np

from jaxgran.files import atomic_write, other_version, with_checksum, without_checksum
from jaxgran.model.checks import InputError, short_repr

FORMAT_VERSION = 2
"""Version of the files of ``write_arrays``; a file of another one is not read."""

_LONGEST_NAME = 200  # bytes; file systems accept 255, and temporary files have longer names


class CorruptFile(Exception):
    """A file cannot be read, or its checksum does not match its content."""


def require_place(path: Path, option: str, ending: str) -> None:
    """Raise an InputError unless a file with this suffix can be written to ``path``."""
    if path.suffix != ending:
        raise InputError(
            f"{option} must be a file name that ends in {ending}, not {short_repr(str(path))}.",
            field=option,
        )
    if len(os.fsencode(path.name)) > _LONGEST_NAME:
        raise InputError(
            f"{option} must be a file name of at most {_LONGEST_NAME} bytes, not "
            f"{short_repr(path.name)}.",
            field=option,
        )
    if os.path.isdir(path):
        raise InputError(f"{option} must be a file, and {str(path)!r} is a folder.", field=option)
    if not os.path.isdir(path.parent):
        raise InputError(
            f"{option} must be in a folder that exists, and {short_repr(str(path.parent))} does "
            "not.",
            field=option,
        )
    try:
        with tempfile.TemporaryFile(dir=path.parent):
            pass
        if path.exists():
            with path.open("ab"):
                pass
    except OSError as error:
        raise InputError(
            f"{option} must be in a folder that can be written to, and {str(path)!r} cannot: "
            f"{error.strerror}.",
            field=option,
        ) from None


def write_arrays(path: Path, arrays: Mapping[str, np.ndarray], about: Mapping[str, object]) -> None:
    """Write named arrays and a JSON-compatible description as an HDF5 file with a checksum."""
    import h5py  # not at the top: workers without a checkpoint do not need it

    memory = io.BytesIO()
    with h5py.File(memory, "w") as file:
        for name, array in arrays.items():
            file.create_dataset(name, data=array)
        file.attrs["format_version"] = FORMAT_VERSION
        file.attrs["names"] = json.dumps(list(arrays))
        file.attrs["about"] = json.dumps(about, sort_keys=True)
    with atomic_write(path) as temporary:
        temporary.write_bytes(with_checksum(memory.getvalue()))


def read_arrays(path: Path) -> tuple[dict[str, np.ndarray], dict[str, object]]:
    """Read the arrays and the description written by ``write_arrays``; CorruptFile for any other
    content.

    Raises:
      InputError: (a ValueError) the file has another version of the format.
    """
    import h5py

    try:
        content = without_checksum(path.read_bytes())
    except OSError as error:
        raise CorruptFile(f"{path.name} cannot be read: {error}") from error
    if content is None:
        raise CorruptFile(f"{path.name} does not match its checksum")
    try:
        with h5py.File(io.BytesIO(content), "r") as file:
            version = file.attrs.get("format_version")
            arrays = {name: np.asarray(file[name]) for name in json.loads(str(file.attrs["names"]))}
            about = json.loads(str(file.attrs["about"]))
    except (
        OSError,
        KeyError,
        ValueError,
    ) as error:  # the checksum is right, but write_arrays did not write the file
        raise CorruptFile(f"{path.name} cannot be read: {error}") from error
    if difference := other_version(short_repr(str(path)), version, FORMAT_VERSION):
        raise InputError(difference)
    return arrays, about
