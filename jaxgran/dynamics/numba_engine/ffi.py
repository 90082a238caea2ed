"""Compiles the numba engine, or loads it from numba's cache, and registers it with XLA.

Numba's cache knows the version of numba, the processor, and the file of the handler, but not the
other files that it is compiled from. So the name of its folder is a hash of all of them. If the
folder cannot be written, every process compiles, with a warning.
"""

import ctypes
import hashlib
import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from importlib.metadata import version
from pathlib import Path
from threading import Lock
from typing import Any

import jax

from jaxgran.cache.folder import cache_folder, users_folder, why_unwritable
from jaxgran.dynamics.numba_engine.layout import HANDLER, SHARED_WORDS, STOP, THREADS
from jaxgran.environment import usable_threads
from jaxgran.files import file_lock, keep_newest
from jaxgran.model.checks import InputError

TARGET = "jaxgran_advance"
_SHARED: list[Any] = [[0] * SHARED_WORDS]  # those of no engine, and of the loaded one
_LOCK = Lock()
MOST_KEPT = 8  # versions in the cache
_CACHE_FOLDER = "NUMBA_CACHE_DIR"  # environment variable, honoured as numba does


def sources() -> list[Path]:
    """The files on which the machine code may depend: all of ``dynamics``, and of the folders that
    it may import.
    """
    package = Path(__file__).parents[2]
    return sorted(
        path
        for folder in ("contact", "dynamics", "model")
        for path in (package / folder).rglob("*.py")
    )


def engine_folder() -> Path:
    """The folder of numba's cache for these sources: in the cache folder, or in that of numba's
    environment variable.
    """
    digest = hashlib.sha256(os.environ.get("NUMBA_OPT", "").encode())
    for path in sources():
        digest.update(path.read_bytes())
    folder = Path(os.environ.get(_CACHE_FOLDER) or (cache_folder() or users_folder()) / "numba")
    return folder / f"jaxgran-{digest.hexdigest()[:16]}"


def register() -> None:
    """Load the numba engine, or compile it, and register it with XLA; once in a process.

    Raises:
      InputError: an environment variable keeps numba from compiling, or this jaxlib does not
        support the version of the foreign function interface that the engine reads.
    """
    with _LOCK:
        _register()


@cache
def _register() -> None:
    for name, wrong in (("NUMBA_DISABLE_JIT", "1"), ("NUMBA_NUM_THREADS", "0")):
        if os.environ.get(name, "").strip() == wrong:
            raise InputError(f"{name}={wrong} keeps numba from compiling the engine: unset it.")
    handler = compiled_handler(engine_folder())
    words = (ctypes.c_int64 * SHARED_WORDS).from_address(handler.ctypes(0))
    words[THREADS], words[HANDLER] = usable_threads(), handler.address
    try:
        jax.ffi.register_ffi_target(TARGET, jax.ffi.pycapsule(handler.address), platform="cpu")
    except jax.errors.JaxRuntimeError as error:
        raise InputError(
            f"engine must be jax with jaxlib {version('jaxlib')}, not numba: {error}"
        ) from error
    _SHARED.append(words)


def shared_words() -> Any:
    """The words that the loaded engine shares with Python, see ``layout``; others before there is
    one.
    """
    return _SHARED[-1]


def compiled_handler(folder: Path) -> Any:
    """The handler as a C callback of numba, from a folder or compiled and, if possible, kept there
    for other processes.
    """
    import numba

    from jaxgran.dynamics.numba_engine.compilation import OPTIONS
    from jaxgran.dynamics.numba_engine.handler import handler

    def compiled(cached: bool) -> Any:
        signature = numba.types.int64(numba.types.int64)
        return numba.cfunc(signature, cache=cached, **OPTIONS)(handler)

    if why := why_unwritable(folder.parent):
        warnings.warn(
            "the numba engine is compiled anew in every process, in about 15 s: the cache folder "
            f"{str(folder.parent)!r} cannot be written ({why}); set XDG_CACHE_HOME or "
            f"{_CACHE_FOLDER} to one that can.",
            stacklevel=4,
        )
        return compiled(cached=False)
    with file_lock(folder):
        config: Any = numba.config
        before, config.CACHE_DIR = config.CACHE_DIR, str(folder)
        try:
            callback = compiled(cached=True)
        finally:
            config.CACHE_DIR = before
    if not callback.cache_hits:
        keep_newest(filter(Path.is_dir, folder.parent.glob("jaxgran-*")), MOST_KEPT)
    return callback


@contextmanager
def engines_stopped() -> Iterator[None]:
    """Within this block every running call of the numba engine in this process ends, with the
    status ``failed``.
    """
    words = shared_words()
    words[STOP] = 1
    try:
        yield
    finally:
        words[STOP] = 0
