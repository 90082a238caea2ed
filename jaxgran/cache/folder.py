"""The folder of compiled programs: in the user's cache folder, or a temporary one if that is not
writable.
"""

import os
import stat
import tempfile
import warnings
from pathlib import Path

from platformdirs import user_cache_path

from jaxgran.environment import on_processor

_SHORTEST_COMPILATION = 0.3  # seconds; faster compilations are not cached


def use_cache() -> None:
    """Keep compiled programs on disk from now on, so that later processes start without compiling.

    It sets JAX's ``jax_compilation_cache_dir`` to a folder in the user's cache folder, and
    ``jax_persistent_cache_min_compile_time_secs`` to 0.3. Programs of the user are then kept, too.
    A folder that JAX has already, and a cache that ``jax_enable_compilation_cache`` turns off, are
    left as they are. If the user's cache folder is not writable, a temporary one is used and a
    warning names it. Call it before the first computation; the command line does.
    """
    from jax import config

    flags = config.values
    if flags["jax_compilation_cache_dir"] or not flags["jax_enable_compilation_cache"]:
        return
    if message := fallback_message():
        warnings.warn(message, stacklevel=2)
    if folder := cache_folder():
        config.update("jax_compilation_cache_dir", str(folder / "xla"))
        config.update("jax_persistent_cache_min_compile_time_secs", _SHORTEST_COMPILATION)
        level = flags["jax_logging_level"]
        unset = level in (None, "NOTSET") and os.environ.get("TF_CPP_MIN_LOG_LEVEL", "1") == "1"
        if unset and on_processor():
            # XLA logs a harmless error for each program that it loads, as it takes tuning hints for
            # instruction sets. JAX sets the level of its log with its own, but does not set it back
            config.update("jax_logging_level", "CRITICAL")
            config.update("jax_logging_level", level)


def programs_folder() -> Path | None:
    """The folder where JAX caches compiled programs; None if it caches none, or in a storage that
    has an address, such as gs://bucket.
    """
    from jax import config

    flags = config.values
    folder = flags["jax_enable_compilation_cache"] and flags["jax_compilation_cache_dir"]
    return Path(folder) if folder and "://" not in folder else None


def fallback_message() -> str:
    """One sentence that says why the user's cache folder is not used and what is used instead; ""
    if it is used.
    """
    users, folder = users_folder(), cache_folder()
    if folder == users:
        return ""
    kept = f"compiled programs are kept in {str(folder)!r}" if folder else "every run compiles anew"
    return (
        f"the cache folder {str(users)!r} cannot be written ({why_unwritable(users)}), so {kept}; "
        "XDG_CACHE_HOME may name another."
    )


def users_folder() -> Path:
    """The folder of this package in the user's cache folder; it need not exist, as where the user
    has no home.
    """
    try:
        return user_cache_path("jaxgran")
    except (RuntimeError, KeyError):
        return Path("~/.cache/jaxgran")


def cache_folder() -> Path | None:
    """The user's folder, else the temporary one; None if neither is writable."""
    return _temporary_folder() if why_unwritable(users_folder()) else users_folder()


def why_unwritable(folder: Path) -> str:
    """The reason why no file can be written to a folder, which is created if missing; "" if it is
    writable.
    """
    if folder.parts[:1] == ("~",):
        return "there is no home folder"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return ""
    except OSError as error:
        return error.strerror or str(error)


def _temporary_folder() -> Path | None:
    """This user's folder in the temporary directory, the same in every process; None if it is not
    safe to use.

    Cached programs are executed later, so no other user may be able to write there.
    """
    if not hasattr(os, "getuid"):  # a system without owners of folders
        return None
    folder = Path(tempfile.gettempdir()) / f"jaxgran-{os.getuid()}"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        status = folder.lstat()
    except OSError:
        return None
    private = stat.S_ISDIR(status.st_mode) and not status.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
    return folder if private and status.st_uid == os.getuid() else None
