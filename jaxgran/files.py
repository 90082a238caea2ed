"""Files that exist whole or not at all, and those of a cache.

A file is written under a temporary name in its final folder, synced, and renamed. A process that is killed leaves the
old file or the new one, never half of one.

A file of a cache is read with its checksum, and the oldest are removed. Processes that miss the same file wait for the
first of them, and then read what it has written.
"""

import hashlib
import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

try:
    import fcntl
except ImportError:  # a system without such locks: every process writes the file
    fcntl = None

_DIGEST = 32  # bytes at the beginning of a file: the hash of what follows


@contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """The name of a temporary file to write beside ``path``; after success it replaces ``path``."""
    temporary = path.with_name(f".{path.stem}-{secrets.token_hex(8)}{path.suffix}")
    try:
        yield temporary
        _sync(temporary)
        os.replace(temporary, path)
        if os.name == "posix":  # on other systems a folder cannot be opened
            _sync(path.parent)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


@contextmanager
def file_lock(path: Path) -> Iterator[None]:
    """Wait until no other process is in this block for the same file; it leaves when it ends, however it ends."""
    with suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
    try:
        lock = path.with_suffix(".lock").open("w")
    except OSError:  # nothing can be kept there, so there is nothing to wait for
        yield
        return
    with lock:
        if fcntl is not None:
            fcntl.flock(lock, fcntl.LOCK_EX)
        try:
            yield
        finally:
            with suppress(OSError):
                path.with_suffix(".lock").unlink()


def read_cached(path: Path) -> bytes | None:
    """The content of a file of a cache; None if there is none, or if it is damaged."""
    with suppress(OSError):
        text = path.read_bytes()
        if hashlib.sha256(text[_DIGEST:]).digest() == text[:_DIGEST]:
            return text[_DIGEST:]
    return None


def write_cached(path: Path, content: bytes, most: int) -> None:
    """Write a file of a cache, and remove the oldest of its kind beside it if they are more than ``most``.

    Raises:
      OSError: the folder cannot be made, or not be written to.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as temporary:
        temporary.write_bytes(hashlib.sha256(content).digest() + content)
    with suppress(OSError):
        kept = sorted(path.parent.glob(f"*{path.suffix}"), key=lambda one: one.stat().st_mtime, reverse=True)
        for old in kept[most:]:
            old.unlink(missing_ok=True)


def _sync(path: Path) -> None:
    """Wait until a file or a folder is on the disc."""
    handle = os.open(path, os.O_RDWR if path.is_file() else os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
