"""Named arrays in a file of NumPy (npz), whose checksums are compared when it is read.

The file also lists its arrays, since a damaged directory of a zip file may hide some of them.
"""

import io
import json
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxgran.files import atomic_write

_DESCRIPTION = "description"


class CorruptFile(Exception):
    """A file cannot be read, or its checksums do not match its content."""


def write_arrays(path: Path, arrays: Mapping[str, np.ndarray], about: Mapping[str, object]) -> None:
    """Write named arrays and a JSON-compatible description, whole or not at all."""
    description = json.dumps({"names": list(arrays), "about": about}, sort_keys=True)
    memory = io.BytesIO()  # a full disk then raises an OSError with its errno
    named: dict[str, Any] = {_DESCRIPTION: np.array(description), **arrays}
    np.savez(memory, **named)
    with atomic_write(path) as temporary:
        temporary.write_bytes(memory.getvalue())


def read_arrays(path: Path) -> tuple[dict[str, np.ndarray], dict[str, object]]:
    """Read the arrays and the description written by ``write_arrays``; CorruptFile for any other
    content.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            damaged = archive.testzip()  # before NumPy trusts the shapes in the file
        if damaged is not None:
            raise CorruptFile(f"{damaged} does not match its checksum")
        with np.load(path) as file:
            description = json.loads(file[_DESCRIPTION].item())
            return {name: file[name] for name in description["names"]}, description["about"]
    except Exception as error:  # a damaged file may raise any exception
        raise CorruptFile(f"{path.name} cannot be read: {error}") from error
