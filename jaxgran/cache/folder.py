"""The folder of the compilation cache: in the user's cache folder, or a temporary one if that is not writable."""

import os
import stat
import tempfile
import warnings
from functools import cache
from pathlib import Path
from typing import Any

from platformdirs import user_cache_path

from jaxgran.environment import processor_kind

_SHORTEST_COMPILATION = 0.3  # seconds; faster compilations are not cached


@cache
def use_cache() -> None:
    """Cache compiled programs on disk from now on, unless the user has chosen otherwise; once in a process.

    The functions that compile call it first. A folder of the user's in ``jax_compilation_cache_dir``, and a cache that
    ``jax_enable_compilation_cache`` turns off, are left as they are. Each kind of processor has a folder of its own,
    since several machines may share a home folder. If the user's cache folder is not writable, a temporary one is used
    and a warning names it.
    """
    import jax

    if jax.config.values["jax_compilation_cache_dir"] or not jax.config.values["jax_enable_compilation_cache"]:
        return
    if message := fallback_message():
        warnings.warn(message, stacklevel=3)
    folder = cache_folder()
    if folder is None:
        return
    jax.config.update("jax_compilation_cache_dir", str(folder / processor_kind()))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", _SHORTEST_COMPILATION)
    if os.environ.get("TF_CPP_MIN_LOG_LEVEL", "1") == "1" and jax.default_backend() == "cpu":  # JAX itself sets 1
        _silence_loader(jax.config)


def programs_folder() -> Path | None:
    """The folder where JAX caches compiled programs; None if it caches none."""
    import jax

    values = jax.config.values
    folder = values["jax_enable_compilation_cache"] and values["jax_compilation_cache_dir"]
    return Path(folder) if folder else None


def _silence_loader(config: Any) -> None:
    """Keep XLA from logging a long, harmless error for each program that it loads: it takes tuning hints for features.

    JAX sets the level of XLA's log together with that of its own, but sets back only its own.
    """
    before = config.values["jax_logging_level"]
    if before in (None, "NOTSET"):
        config.update("jax_logging_level", "CRITICAL")
        config.update("jax_logging_level", before)


def fallback_message() -> str:
    """One sentence that says why the user's cache folder is not used and what is used instead; "" if it is used."""
    folder = cache_folder()
    if folder == users_folder():
        return ""
    instead = "every run compiles anew" if folder is None else f"compiled programs are kept in {str(folder)!r}"
    return (
        f"the cache folder {str(users_folder())!r} cannot be written ({why_unwritable(users_folder())}), so {instead}; "
        "XDG_CACHE_HOME may name another."
    )


def users_folder() -> Path:
    """The folder of this package in the user's cache folder; it need not exist."""
    return user_cache_path("jaxgran")


def cache_folder() -> Path | None:
    """The user's folder, else the temporary one; None if neither is writable."""
    return _temporary_folder() if why_unwritable(users_folder()) else users_folder()


def why_unwritable(folder: Path) -> str:
    """The reason why no file can be written to a folder, which is created if missing; "" if it is writable."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return ""
    except OSError as error:
        return error.strerror or str(error)


def _temporary_folder() -> Path | None:
    """This user's folder in the temporary directory, the same in every process; None if it is not safe to use.

    Cached programs are executed later, so no other user may be able to write there.
    """
    if not hasattr(os, "getuid"):  # a system without owners of folders
        return None
    try:
        folder = Path(tempfile.gettempdir()) / f"jaxgran-{os.getuid()}"
        folder.mkdir(mode=0o700, exist_ok=True)
        status = folder.lstat()
    except OSError:
        return None
    shared = status.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
    private = stat.S_ISDIR(status.st_mode) and status.st_uid == os.getuid() and not shared
    return folder if private and not why_unwritable(folder) else None
