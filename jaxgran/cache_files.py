"""Files of a cache: each is written in one step and read with its checksum, and the oldest are removed."""

import hashlib
import os
import tempfile
from contextlib import suppress
from pathlib import Path

_DIGEST = 32  # bytes at the beginning of a file: the hash of what follows


def read_kept(path: Path) -> bytes | None:
    """The content of a file of a cache; None if there is none, or if it is damaged."""
    with suppress(OSError):
        text = path.read_bytes()
        if hashlib.sha256(text[_DIGEST:]).digest() == text[:_DIGEST]:
            return text[_DIGEST:]
    return None


def keep(path: Path, content: bytes, most: int) -> None:
    """Write a file of a cache, and remove the oldest of its kind beside it if they are more than ``most``.

    Raises:
      OSError: the folder cannot be made, or not be written to.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.NamedTemporaryFile(dir=path.parent, prefix=".", delete=False) as file:
        file.write(hashlib.sha256(content).digest() + content)
    os.replace(file.name, path)
    with suppress(OSError):
        kept = sorted(path.parent.glob(f"*{path.suffix}"), key=lambda one: one.stat().st_mtime, reverse=True)
        for old in kept[most:]:
            old.unlink(missing_ok=True)
