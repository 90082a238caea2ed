"""Atomic writes and file locks.

A file is written under a temporary name in its final folder, synced, and renamed. A killed process
leaves either the old file or the new one, never a part of one.
"""

import os
import secrets
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

try:
    import fcntl
except ImportError:  # a system without file locks: every process writes the file
    fcntl = None


@contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """Yield the path of a temporary file beside ``path``, which replaces ``path`` if the block
    succeeds, and then has its permissions. Of a symbolic link, the file that it names is replaced.

    An OSError of the block names ``path``.
    """
    file = Path(os.path.realpath(path))
    temporary = file.with_name(f".{file.stem}-{secrets.token_hex(8)}{file.suffix}")
    try:
        yield temporary
        with temporary.open("rb+") as written:
            os.fsync(written)
        with suppress(FileNotFoundError, PermissionError):
            shutil.copymode(file, temporary)
        os.replace(temporary, file)
        if os.name == "posix":  # on other systems a folder cannot be opened
            folder = os.open(file.parent, os.O_RDONLY)
            os.fsync(folder)
            os.close(folder)
    except BaseException as error:
        temporary.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.errno and error.filename in (None, str(temporary)):
            error.filename = str(path)
        raise


@contextmanager
def file_lock(path: Path) -> Iterator[None]:
    """Let one process at a time enter the block for a file; the lock is released even if the
    process dies.
    """
    lock, handle = path.with_suffix(".lock"), None
    with suppress(OSError):  # the folder is not writable, so there will be no file to wait for
        handle = lock_file(lock, wait=True)
    try:
        yield
    finally:
        if handle is not None:
            with suppress(OSError):
                lock.unlink()
            os.close(handle)


def lock_file(path: Path, wait: bool) -> int | None:
    """Lock a file, made with its folder if missing, until the handle is closed or this process
    ends; None on a system without locks.

    Raises:
      BlockingIOError: another process has locked it, and ``wait`` is False.
      OSError: the file cannot be made.
    """
    while True:
        path.parent.mkdir(parents=True, exist_ok=True)
        if fcntl is None:
            return None
        try:
            handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        except FileNotFoundError:  # another process has just finished and removed the folder
            continue
        try:
            fcntl.flock(handle, fcntl.LOCK_EX if wait else fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(handle)
            raise
        except OSError:  # a file system without locks
            return handle
        if is_locked(path, handle):
            return handle
        os.close(handle)  # the lock of a removed file: try again


def is_locked(path: Path, handle: int | None) -> bool:
    """Whether a handle of ``lock_file`` is that of this file, and not of one that was removed
    since.
    """
    try:
        return handle is None or os.path.samestat(os.fstat(handle), path.stat())
    except OSError:
        return False


def stamp(path: Path | None) -> tuple[int, int] | None:
    """What changes when a file is replaced; None if there is none."""
    with suppress(OSError, TypeError):
        status = os.stat(path)  # type: ignore[arg-type]
        return status.st_ino, status.st_mtime_ns
    return None


def keep_newest(paths: Iterable[Path], most: int) -> None:
    """Remove the oldest of files and folders beyond so many; another process may do the same."""
    with suppress(OSError):
        for old in sorted(paths, key=lambda path: path.stat().st_mtime)[:-most]:
            if old.is_dir():
                shutil.rmtree(old, ignore_errors=True)
            else:
                old.unlink(missing_ok=True)


def other_version(name: str, stored: object, version: int | str) -> str:
    """A sentence if a file has another ``format_version`` than this version of jaxgran reads; "" if
    it has the same.
    """
    if stored == version:
        return ""
    has = "no format_version" if stored is None else f"format_version {stored}"
    return f"{name} has {has}, and this version of jaxgran reads format_version {version}."
