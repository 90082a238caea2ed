"""Atomic writes, file locks, and cache files with a checksum.

A file is written under a temporary name in its final folder, synced, and renamed. A killed process
leaves either the old file or the new one, never a part of one.
"""

import hashlib
import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

try:
    import fcntl
except ImportError:  # a system without file locks: every process writes the file
    fcntl = None

_DIGEST = 32  # bytes at the start of a cache file: the SHA-256 hash of the rest


@contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """Yield the path of a temporary file beside ``path``, which replaces ``path`` if the block
    succeeds.

    An OSError of the block names ``path``.
    """
    temporary = path.with_name(f".{path.stem}-{secrets.token_hex(8)}{path.suffix}")
    try:
        yield temporary
        _sync(temporary)
        os.replace(temporary, path)
        if os.name == "posix":  # on other systems a folder cannot be opened
            _sync(path.parent)
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
    with suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
    name = path.with_suffix(".lock")
    while True:
        try:
            lock = name.open("w")
        except OSError:  # the folder is not writable, so there will be no file to wait for
            yield
            return
        with lock:
            if fcntl is not None:
                fcntl.flock(lock, fcntl.LOCK_EX)
                if not same_file(
                    lock.fileno(), name
                ):  # its owner has removed it: lock the one that is there now
                    continue
            try:
                yield
            finally:
                with suppress(OSError):
                    name.unlink()
            return


def lock_folder(folder: Path) -> int | None:
    """Lock a folder, made if missing, until this process ends; the handle of its file ``lock``.

    On a system without locks there is no handle, and no other process is noticed.

    Raises:
      FileExistsError: a file has the name of the folder.
      BlockingIOError: another process has locked it.
    """
    while True:
        folder.mkdir(parents=True, exist_ok=True)
        if fcntl is None:
            return None
        try:
            handle = os.open(folder / "lock", os.O_RDWR | os.O_CREAT, 0o644)
        except FileNotFoundError:  # another process has just finished and removed the folder
            continue
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(handle)
            raise
        except OSError:  # a file system without locks
            return handle
        if is_lock_of(folder, handle):
            return handle
        os.close(handle)  # the lock of a removed folder: try again


def is_lock_of(folder: Path, lock: int | None) -> bool:
    """Whether a lock is that of this folder, and not of one that was removed since."""
    return lock is None or same_file(lock, folder / "lock")


def same_file(handle: int, path: Path) -> bool:
    """Whether an open file is the one that has this name now, and not one that was removed
    since.
    """
    try:
        return os.path.samestat(os.fstat(handle), path.stat())
    except OSError:
        return False


def read_cached(path: Path) -> bytes | None:
    """The content of a cache file; None if it is missing or damaged."""
    with suppress(OSError):
        content = path.read_bytes()
        if hashlib.sha256(content[_DIGEST:]).digest() == content[:_DIGEST]:
            return content[_DIGEST:]
    return None


def other_version(name: str, found: object, version: int | str) -> str:
    """A sentence if a file has another ``format_version`` than this version of jaxgran reads; "" if
    it has the same.
    """
    if found == version:
        return ""
    has = "no format_version" if found is None else f"format_version {found}"
    return f"{name} has {has}, and this version of jaxgran reads format_version {version}."


def write_cached(path: Path, content: bytes, most: int) -> None:
    """Write a cache file, then remove the oldest files with its suffix beyond the newest ``most``.

    Raises:
      OSError: the folder cannot be created or written to.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as temporary:
        temporary.write_bytes(hashlib.sha256(content).digest() + content)
    with suppress(OSError):
        newest_first = sorted(
            path.parent.glob(f"*{path.suffix}"), key=lambda x: x.stat().st_mtime, reverse=True
        )
        for old in newest_first[most:]:
            old.unlink(missing_ok=True)


def _sync(path: Path) -> None:
    """Flush a file or a folder to disk."""
    handle = os.open(path, os.O_RDWR if path.is_file() else os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
