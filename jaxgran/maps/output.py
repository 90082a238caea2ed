"""Where a map is written: its path is checked before the run."""

import os
from collections.abc import Iterable
from pathlib import Path
from typing import get_args

from jaxgran.io.atomic import require_place
from jaxgran.model.checks import InputError
from jaxgran.model.choices import FileFormat

PICTURES = ("curves", "contours", "timestep", "size", "theory", "factors", "clusters", "errors", "rheology")
FORMATS = get_args(FileFormat)


def check_output(path: Path) -> None:
    """Raise an InputError if a dataset cannot be written to ``path``."""
    require_place(path, "output", ".nc")
    for file in _pictures(path):
        if os.path.isdir(file):
            raise InputError(f"output must be a file, and {str(file)!r} is a folder.")
    unfinished = path.with_name(f"{path.name}.unfinished")
    if unfinished.exists() and not unfinished.is_dir():
        raise InputError(f"output must leave {str(unfinished)!r} to an unfinished map, and there is a file.")


def remove_pictures(path: Path, but: Iterable[Path] = ()) -> None:
    """Remove the pictures beside a dataset that show the map there was before: all but some, in whatever format."""
    kept = {file.with_suffix("") for file in but}
    for file in _pictures(path):
        if file.with_suffix("") not in kept:
            file.unlink(missing_ok=True)


def _pictures(path: Path) -> list[Path]:
    """The files of the pictures of a dataset; not all need to exist."""
    return [path.with_name(f"{path.stem}_{name}.{ending}") for name in PICTURES for ending in FORMATS]
