"""Loads the numba engine from an object file, compiles it if there is none, and registers it with
XLA.

The name of the file is a hash of all that its content depends on: the sources of its folders, the
compiler and the processor. So a change in any of them gives another file, in a user's cache and in
the tests. An object file is loaded without importing numba. If the cache cannot be written, every
process compiles, with a warning.
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

import jax
from llvmlite import binding as llvm

from jaxgran.cache.folder import cache_folder, users_folder
from jaxgran.environment import usable_threads
from jaxgran.files import file_lock, read_cached, write_cached
from jaxgran.model.checks import InputError

TARGET = "jaxgran_advance"
STOP = "jaxgran_stop"  # a word in the object file; the engine runs while it is zero
# A word in the object file: threads that advance the replicas of a call
THREADS = "jaxgran_threads"
_LOCK = Lock()
_MOST_KEPT = 8  # object files in the cache
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


def object_file() -> Path:
    """Path of the object file: in the cache folder, or in that of numba's environment variable."""
    words = [
        version("numba"),
        version("llvmlite"),
        llvm.get_host_cpu_name(),
        llvm.get_host_cpu_features().flatten(),
    ]
    digest = hashlib.sha256("\n".join([*words, os.environ.get("NUMBA_OPT", "")]).encode())
    for path in sources():
        digest.update(path.read_bytes())
    folder = Path(os.environ.get(_CACHE_FOLDER) or (cache_folder() or users_folder()) / "numba")
    return folder / f"{digest.hexdigest()[:16]}.o"


def register() -> None:
    """Load the numba engine, or compile it, and register it with XLA; once in a process.

    Raises:
      InputError: this jaxlib does not support the version of the foreign function interface that
        the engine reads.
    """
    with _LOCK:
        _register()


@cache
def _register() -> None:
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    processor, features = llvm.get_host_cpu_name(), llvm.get_host_cpu_features().flatten()
    target = llvm.Target.from_default_triple()
    machine = target.create_target_machine(cpu=processor, features=features, opt=3, jit=True)
    path = object_file()
    content = read_cached(path)
    if content is None:
        with file_lock(path):
            content = read_cached(path) or _compiled(path, machine)
    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), machine)
    engine.add_object_file(llvm.ObjectFileRef.from_data(content))
    engine.finalize_object()
    _ENGINES.append(engine)
    set_word(THREADS, usable_threads())
    try:
        jax.ffi.register_ffi_target(
            TARGET, jax.ffi.pycapsule(engine.get_function_address(TARGET)), platform="cpu"
        )
    except jax.errors.JaxRuntimeError as error:
        raise InputError(
            f"engine must be jax with jaxlib {version('jaxlib')}, not numba: {error}"
        ) from error


def _compiled(path: Path, machine: llvm.TargetMachine) -> bytes:
    """Compile the numba engine, and write the object file if possible."""
    for name, wrong in (("NUMBA_DISABLE_JIT", "1"), ("NUMBA_NUM_THREADS", "0")):
        if os.environ.get(name, "").strip() == wrong:
            raise InputError(f"{name}={wrong} keeps numba from compiling the engine: unset it.")
    from jaxgran.dynamics.numba_engine.handler import object_code

    content = object_code(TARGET, STOP, THREADS, machine)
    try:
        write_cached(path, content, _MOST_KEPT)
    except OSError as error:
        warnings.warn(
            "the numba engine is compiled anew in every process, in about 15 s: the cache folder "
            f"{str(path.parent)!r} cannot be written ({error.strerror}); set XDG_CACHE_HOME or "
            f"{_CACHE_FOLDER} to one that can.",
            stacklevel=3,
        )
    return content


@contextmanager
def stopped() -> Iterator[None]:
    """Within this block every running call of the numba engine ends, with the status ``failed``."""
    set_word(STOP, 1)
    try:
        yield
    finally:
        set_word(STOP, 0)


def set_word(name: str, value: int) -> None:
    """Set a word of the object file; without effect before it is loaded."""
    for engine in _ENGINES:
        ctypes.c_int64.from_address(engine.get_global_value_address(name)).value = value


_ENGINES: list[llvm.ExecutionEngine] = []  # they own the memory of the loaded code
