"""``jit`` with compiled programs on disk, so that a new process need neither trace nor compile
them.

JAX caches compiled programs too, but to look one up it must first trace and lower the function,
which takes seconds. Here the key needs no tracing: the sources of this package, versions, flags,
and the shapes of the arguments. Programs are stored inside JAX's cache folder, and only for a
single CPU device.
"""

import hashlib
import os
import pickle
import re
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache, wraps
from importlib.metadata import version
from pathlib import Path
from threading import RLock
from typing import Any

import jax
from jax import monitoring
from jax.core import Tracer
from jax.experimental.serialize_executable import deserialize_and_load, serialize

from jaxgran.cache.folder import programs_folder
from jaxgran.environment import default_device, processor_features
from jaxgran.files import file_lock, read_cached, write_cached

_MOST_PROGRAMS = 64  # of up to 4 MB each
_PACKAGES = ("jax", "jaxlib", "numpy")
_CUSTOM_CALL = re.compile(r"stablehlo\.custom_call @(\w+)")
_MIN_COMPILE_TIME = "jax_persistent_cache_min_compile_time_secs"
_FIRST_CALL = (
    RLock()
)  # several threads load or compile a program once, and change JAX's flags in turn
_SAFE_CALLS = (
    "jaxgran_advance",
    "Sharding",
)  # others need a library that JAX loads only on lowering


def persistent_jit(function: Callable, register: Callable[[], None] = lambda: None) -> Callable:
    """``jax.jit`` of a function, with its compiled programs cached on disk, after a call of
    ``use_cache``.

    Args:
      function: a function of pytrees of arrays, without static arguments. JAX's flags are read at
        the first call with arguments of given shapes.
      register: called before loading a program that calls the numba engine.
    """
    jitted = jax.jit(function)
    programs: dict[Any, Callable] = {}

    @wraps(function)
    def call(*arguments):
        leaves, structure = jax.tree.flatten(arguments)
        folder = _folder()
        if (
            folder is None
            or any(isinstance(leaf, Tracer) for leaf in leaves)
            or _has_foreign_class(structure)
        ):
            return jitted(*arguments)
        key = (structure, tuple(map(jax.typeof, leaves)))
        if key not in programs:
            path = folder / f"{_digest(function, key)}.program"
            with _FIRST_CALL:
                program = programs.get(key) or _load(path, register)
                if program is None:
                    with file_lock(path):
                        program = _load(path, register) or _compile(jitted, arguments, path)
                programs[key] = program
        return programs[key](*arguments)

    return call


def _folder() -> Path | None:
    """The folder of cached programs; None if programs are not cached."""
    folder = programs_folder()
    on_processor = default_device().platform == "cpu" and jax.device_count() == 1
    return folder / "programs" if folder and on_processor else None


def _has_foreign_class(structure: Any) -> bool:
    """Whether an argument is of a class from outside, such as a user's solver, whose source is not
    in the key.
    """
    node = structure.node_data()
    foreign = node is not None and node[0].__module__.partition(".")[0] not in (
        "builtins",
        "jaxgran",
    )
    return foreign or any(map(_has_foreign_class, structure.children()))


def _flags() -> str:
    """All flags of JAX, since a program may depend on any of them."""
    return repr(
        sorted((name, repr(x)) for name, x in jax.config.values.items() if "cache" not in name)
    )


@cache
def _origin() -> str:
    """What every program depends on: sources of this package, versions, processor, XLA flags."""
    lines = [sources_digest(), *(f"{name} {version(name)}" for name in _PACKAGES)]
    return "\n".join([*lines, processor_features(), os.environ.get("XLA_FLAGS", "")])


@cache
def sources_digest() -> str:
    """A hash of the sources of this package."""
    digest = hashlib.sha256()
    folder = Path(__file__).parents[1]
    for path in sorted(folder.rglob("*.py")):
        digest.update(str(path.relative_to(folder)).encode() + path.read_bytes())
    return digest.hexdigest()[:16]


def _digest(function: Callable, key: tuple) -> str:
    text = f"{_origin()}\n{_flags()}\n{function.__module__}.{function.__qualname__}\n{key}"
    return hashlib.sha256(text.encode()).hexdigest()[:32]


def _load(path: Path, register: Callable[[], None]) -> Callable | None:
    """A cached program; None if there is none or it cannot be loaded."""
    content = read_cached(path)
    if content is None:
        return None
    with suppress(Exception):  # whatever is wrong with the file, the function can be compiled again
        numba, *parts = pickle.loads(content)
        if numba:
            register()
        return deserialize_and_load(*parts)
    return None


def _compile(jitted: Any, arguments: tuple, path: Path) -> Callable:
    """Compile for these arguments, and cache the program if possible."""
    lowered = jitted.lower(*arguments)
    called = set(_CUSTOM_CALL.findall(lowered.as_text()))
    if not called <= set(_SAFE_CALLS):
        return lowered.compile()
    with _jax_cache_read_only() as cache_hits:
        program = lowered.compile()
    if (
        not cache_hits
    ):  # a program from JAX's cache cannot be serialised again: XLA omits part of it
        try:
            write_cached(path, pickle.dumps((bool(called), *serialize(program))), _MOST_PROGRAMS)
        except OSError as error:
            warnings.warn(
                f"compiled programs are not cached: {str(path.parent)!r} cannot be written "
                f"({error.strerror}).",
                stacklevel=3,
            )
    return program


@contextmanager
def _jax_cache_read_only() -> Iterator[list[str]]:
    """Keep JAX from writing to its own cache; the list receives an entry for each program found
    there.
    """
    hits: list[str] = []

    def listen(event: str, **_: Any) -> None:
        if event == "/jax/compilation_cache/cache_hits":
            hits.append(event)

    before = getattr(jax.config, _MIN_COMPILE_TIME)
    monitoring.register_event_listener(listen)
    jax.config.update(_MIN_COMPILE_TIME, float("inf"))
    try:
        yield hits
    finally:
        jax.config.update(_MIN_COMPILE_TIME, before)
        monitoring.unregister_event_listener(listen)
