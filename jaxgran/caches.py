"""Where compiled programs are kept: the user's cache folder, or a temporary one if that cannot be written."""

import os
import stat
import tempfile
import warnings
from pathlib import Path

from platformdirs import user_cache_path

from jaxgran.environment import processor_kind

_SHORTEST_COMPILATION = 0.3  # seconds; programs that are compiled faster are not kept


def enable_cache() -> Path | None:
    """Keep compiled programs on disk, so that the next process need not compile them again.

    Call it first, best before JAX is imported. The command line does the same. The programs are in the cache folder of
    the user, which ``XDG_CACHE_HOME`` may name and ``jaxgran info`` shows. Each kind of processor has a folder of its
    own, as several machines may share a home folder. If the cache folder cannot be written, a warning names the
    temporary one in its place.

    Returns:
      The folder of this processor; None if no folder can be written.
    """
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # or XLA logs a long error about tuning hints of kept programs
    import jax

    if fallback_message():
        warnings.warn(fallback_message(), stacklevel=2)
    folder = cache_folder()
    programs = None if folder is None else folder / processor_kind()
    jax.config.update("jax_compilation_cache_dir", None if programs is None else str(programs))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", _SHORTEST_COMPILATION)
    return programs


def fallback_message() -> str:
    """Why programs are not kept in the user's cache folder, and where they are, in a sentence; "" if they are there."""
    folder = cache_folder()
    if folder == users_folder():
        return ""
    instead = "every run compiles anew" if folder is None else f"compiled programs are kept in {str(folder)!r}"
    return (
        f"the cache folder {str(users_folder())!r} cannot be written ({why_unwritable(users_folder())}), so {instead}; "
        "XDG_CACHE_HOME may name another."
    )


def users_folder() -> Path:
    """The cache folder of this package among those of the user; it need not exist."""
    return user_cache_path("jaxgran")


def cache_folder() -> Path | None:
    """The user's folder, or else the temporary one; None if neither can be written."""
    return _temporary_folder() if why_unwritable(users_folder()) else users_folder()


def why_unwritable(folder: Path) -> str:
    """Why no file can be written into a folder, which is made if it is missing; "" if one can."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return ""
    except OSError as error:
        return error.strerror or str(error)


def _temporary_folder() -> Path | None:
    """A folder of this user among the temporary files, the same in every process; None if it is not safe to use.

    Programs that are kept are run later, so no other user may be able to write there.
    """
    if not hasattr(os, "getuid"):  # a system that shows no owner of a folder
        return None
    try:
        folder = Path(tempfile.gettempdir()) / f"jaxgran-{os.getuid()}"
        folder.mkdir(mode=0o700, exist_ok=True)
        found = folder.lstat()
    except OSError:
        return None
    shared = found.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
    own = stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not shared
    return folder if own and not why_unwritable(folder) else None
