"""Where a map is written: its path is checked before the run."""

from pathlib import Path

from jaxgran.io.atomic import require_place
from jaxgran.model.checks import InputError


def check_output(path: Path) -> None:
    """Raise an InputError if a dataset cannot be written to ``path``."""
    require_place(path, "output", ".nc")
    unfinished = path.with_name(f"{path.name}.unfinished")
    if unfinished.exists() and not unfinished.is_dir():
        raise InputError(f"output must leave {str(unfinished)!r} to an unfinished map, and there is a file.")
