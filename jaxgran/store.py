"""Files that are there whole or not at all, and arrays on disc that know whether they are damaged.

A file is written under a temporary name in the folder where it belongs, synced, and renamed to its place. A process
that is killed leaves the old file or the new one, never half of one.
"""

import hashlib
import json
import os
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path

import h5netcdf
import h5py
import numpy as np


class Damaged(Exception):
    """A file that cannot be read, or whose content is not what was written."""


@contextmanager
def replaced(path: Path) -> Iterator[Path]:
    """The name of a temporary file beside ``path`` that takes its place if nothing goes wrong."""
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.stem}-", suffix=path.suffix)
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        _sync(temporary)
        os.chmod(temporary, 0o666 & ~_umask())
        os.replace(temporary, path)
        _sync(path.parent)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def write_arrays(path: Path, arrays: Mapping[str, np.ndarray], about: Mapping[str, object]) -> None:
    """Write named arrays, and what JSON can hold about them, as a NetCDF file with a checksum of it all."""
    text = json.dumps(about, sort_keys=True)
    content = BytesIO()  # HDF5 says more than a sentence when a disc is full
    with h5netcdf.File(content, "w") as file:
        for name, array in arrays.items():
            dimensions = tuple(f"{name}_{axis}" for axis in range(array.ndim))
            file.dimensions.update(zip(dimensions, array.shape, strict=True))
            file.create_variable(name, dimensions, array.dtype, data=array)
        file.attrs["names"] = json.dumps(list(arrays))
        file.attrs["about"] = text
        file.attrs["checksum"] = _checksum(arrays, text)
    with replaced(path) as temporary:
        temporary.write_bytes(content.getbuffer())


def read_arrays(path: Path) -> tuple[dict[str, np.ndarray], dict[str, object]]:
    """What ``write_arrays`` wrote; raises ``Damaged`` where that is not what the file holds."""
    try:
        with h5py.File(path, "r") as file:  # h5netcdf complains a second time about what it could not open
            arrays = {name: np.asarray(file[name]) for name in json.loads(str(file.attrs["names"]))}
            text, checksum = str(file.attrs["about"]), str(file.attrs["checksum"])
        if checksum == _checksum(arrays, text):
            return arrays, json.loads(text)
    except Exception as error:  # a torn file may fail in any way
        raise Damaged(f"{path.name} cannot be read: {error}") from error
    raise Damaged(f"{path.name} is not what was written")


def _checksum(arrays: Mapping[str, np.ndarray], text: str) -> str:
    digest = hashlib.sha256(text.encode())
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        digest.update(f"{name} {array.dtype.str} {arrays[name].shape}".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()


def _sync(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
