"""Where compiled programs are kept: the user's cache folder, or a temporary one if that cannot be written."""

import os
import stat
import tempfile
from pathlib import Path

from platformdirs import user_cache_path


def users_folder() -> Path:
    """The cache folder of this package among those of the user; it need not exist."""
    return user_cache_path("jaxgran")


def cache_folder() -> Path | None:
    """The user's folder, or else the temporary one; None if neither can be written."""
    return _temporary_folder() if obstacle(users_folder()) else users_folder()


def obstacle(folder: Path) -> str:
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
    return folder if own and not obstacle(folder) else None
