"""What every command shares: exit statuses, sentences on standard error, tables on standard output, JAX as it is used.

Exit status: 0 done; 1 the file system fails; 2 a mistake in the input; 3 finished, but a point carries a bad status;
130 interrupted.
"""

import hashlib
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import NoReturn

import platformdirs
from rich.console import Console
from rich.table import Table

from jaxgran.environment import processor_features

NO_FILE, INPUT_MISTAKE, BAD_STATUS, INTERRUPTED = 1, 2, 3, 130


def configured_jax():
    """JAX in double precision, with compiled programs kept in the cache folder of the user."""
    import jax

    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_compilation_cache_dir", _compilation_cache())
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.3)
    return jax


def _compilation_cache() -> str:
    """Folder of compiled programs, one for each kind of processor: a home folder may be shared by several."""
    kind = hashlib.sha256(processor_features().encode()).hexdigest()[:12]
    return str(Path(platformdirs.user_cache_dir("jaxgran")) / kind)


def say(sentence: str) -> None:
    """Print on standard error."""
    print(sentence, file=sys.stderr)


def say_written(paths: Iterable[Path]) -> None:
    """Name the files that have been written."""
    for path in paths:
        say(f"wrote {path}")


def stop(sentence: str, status: int = INPUT_MISTAKE) -> NoReturn:
    """Say why the command ends, and end it."""
    say(f"jaxgran: {sentence}")
    raise SystemExit(status)


def with_error(value: float, error: float) -> str:
    """A value and its standard error as text."""
    return f"{value:.4g} ± {error:.2g}"


def print_table(table: Table) -> None:
    """Print a table on standard output, in full width where that is a file."""
    console = Console()
    console.print(table) if console.is_terminal else Console(width=40 + 20 * len(table.columns)).print(table)
