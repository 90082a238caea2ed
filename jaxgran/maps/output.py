"""Where a map is written: its path is checked before the run."""

import os
from collections.abc import Iterable
from pathlib import Path

from jaxgran.io.atomic import require_place
from jaxgran.model.checks import InputError

PICTURES = ("curves", "contours", "timestep", "size", "theory", "losses", "clusters", "errors", "rheology")


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
    """Remove the pictures beside a dataset, but for some: they show the map that was there before."""
    for file in set(_pictures(path)).difference(but):
        file.unlink(missing_ok=True)


def _pictures(path: Path) -> list[Path]:
    """The files of the pictures of a dataset; not all need to exist."""
    return [path.with_name(f"{path.stem}_{name}.png") for name in PICTURES]
