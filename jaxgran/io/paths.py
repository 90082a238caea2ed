"""Checks of the path of a file before the work that is to be written there."""

import os
import tempfile
from pathlib import Path
from typing import Any

from jaxgran.model.checks import InputError, refused, short_repr

_LONGEST_NAME = 200  # bytes; file systems accept 255, and temporary files have longer names


def as_path(name: str, value: Any) -> Path:
    """The path of a file name; InputError if it is none."""
    if not isinstance(value, (str, os.PathLike)):
        raise refused(name, value, "must be a file name")
    return Path(value)


def require_place(path: Path, option: str, ending: str) -> None:
    """Raise an InputError unless a file with this suffix can be written to ``path``."""
    name = short_repr(str(path))
    if path.suffix != ending:
        raise refused(option, str(path), f"must be a file name that ends in {ending}")
    if len(os.fsencode(path.name)) > _LONGEST_NAME:
        raise refused(option, path.name, f"must be a file name of at most {_LONGEST_NAME} bytes")
    if os.path.isdir(path):
        raise InputError(f"{option} must be a file, and {name} is a folder.", field=option)
    parent = Path(os.path.realpath(path)).parent if path.is_symlink() else path.parent
    if not os.path.isdir(parent):
        raise InputError(
            f"{option} must be in a folder that exists, and {short_repr(str(parent))} does not.",
            field=option,
        )
    try:
        with tempfile.TemporaryFile(dir=parent):
            pass
        if path.exists():
            with path.open("ab"):
                pass
    except OSError as error:
        raise InputError(
            f"{option} must be in a folder that can be written to, and {name} cannot: "
            f"{error.strerror}.",
            field=option,
        ) from None


def require_absent(path: Path, option: str) -> None:
    """Raise an InputError if there is a file that would be replaced."""
    if os.path.isfile(path):
        raise InputError(
            f"{option} {short_repr(str(path))} already exists; name another file, or pass "
            "`overwrite=True` to replace it.",
            field=option,
        )
