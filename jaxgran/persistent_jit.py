"""Compiled programs that are kept on disk, so that a process need not trace and compile them again.

JAX keeps what XLA has compiled. But to find it there, every process traces and lowers the program, which takes seconds.
Here the key is known before: the sources of this package, the versions, the flags, and the shapes of the arguments.
Programs are kept where JAX keeps its own, and only for a single processor device.
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
from typing import Any

import jax
from jax import monitoring
from jax.core import Tracer
from jax.experimental.serialize_executable import deserialize_and_load, serialize

from jaxgran.environment import processor_features
from jaxgran.files import file_lock, read_cached, write_cached

_MOST_KEPT = 64  # programs of up to 4 MB
_PACKAGES = ("jax", "jaxlib", "numpy")
_CALLED = re.compile(r"stablehlo\.custom_call @(\w+)")
_SHORTEST_COMPILATION = "jax_persistent_cache_min_compile_time_secs"  # of programs that JAX keeps
_SAFE_CALLS = ("jaxgran_advance", "Sharding")  # others need a library that JAX loads when it lowers a program


def persistent_jit(function: Callable, register: Callable[[], None] = lambda: None) -> Callable:
    """``jax.jit`` of a function, with its compiled programs kept on disk where JAX has a folder for its cache.

    Args:
      function: a function of pytrees of arrays, without static arguments. The flags of JAX are read when it is first
        called for some shapes.
      register: called before a program that calls the numba engine is loaded.
    """
    jitted = jax.jit(function)
    programs: dict[Any, Callable] = {}

    @wraps(function)
    def call(*arguments):
        leaves, structure = jax.tree.flatten(arguments)
        folder = _folder()
        if folder is None or any(isinstance(leaf, Tracer) for leaf in leaves) or _has_foreign_class(structure):
            return jitted(*arguments)
        key = (structure, tuple(map(jax.typeof, leaves)))
        if key not in programs:
            path = folder / f"{_digest(function, key)}.program"
            found = _loaded(path, register)
            if found is None:
                with file_lock(path):
                    found = _loaded(path, register) or _compiled(jitted, arguments, path)
            programs[key] = found
        return programs[key](*arguments)

    return call


def _folder() -> Path | None:
    """Where programs are kept; None if they are not."""
    folder = jax.config.values["jax_compilation_cache_dir"]
    single = folder and jax.default_backend() == "cpu" and jax.device_count() == 1
    return Path(folder) / "programs" if single else None


def _has_foreign_class(structure: Any) -> bool:
    """Whether an argument is of a class from outside, such as a user's solver, whose source is not in the key."""
    node = structure.node_data()
    foreign = node is not None and node[0].__module__.partition(".")[0] not in ("builtins", "jaxgran")
    return foreign or any(map(_has_foreign_class, structure.children()))


def _flags() -> str:
    """The flags of JAX, which a program may depend on."""
    return repr(sorted((name, repr(x)) for name, x in jax.config.values.items() if "cache" not in name))


@cache
def _origin() -> str:
    """What all programs depend on: the sources of this package, the versions, the processor and the flags of XLA."""
    digest = hashlib.sha256()
    folder = Path(__file__).parent
    for path in sorted(folder.rglob("*.py")):
        digest.update(str(path.relative_to(folder)).encode() + path.read_bytes())
    words = [f"{name} {version(name)}" for name in _PACKAGES]
    words += [processor_features(), os.environ.get("XLA_FLAGS", "")]
    return digest.hexdigest() + "\n".join(words)


def _digest(function: Callable, key: tuple) -> str:
    words = f"{_origin()}\n{_flags()}\n{function.__module__}.{function.__qualname__}\n{key}"
    return hashlib.sha256(words.encode()).hexdigest()[:32]


def _loaded(path: Path, register: Callable[[], None]) -> Callable | None:
    """A kept program; None if there is none, or if it cannot be loaded."""
    content = read_cached(path)
    if content is None:
        return None
    with suppress(Exception):  # whatever is wrong with it, it can be compiled again
        numba, *parts = pickle.loads(content)
        if numba:
            register()
        return deserialize_and_load(*parts)
    return None


def _compiled(jitted: Any, arguments: tuple, path: Path) -> Callable:
    """The program for these arguments, kept if possible."""
    lowered = jitted.lower(*arguments)
    called = set(_CALLED.findall(lowered.as_text()))
    if not called <= set(_SAFE_CALLS):
        return lowered.compile()
    with _not_kept_by_jax() as found_by_jax:
        program = lowered.compile()
    if not found_by_jax:  # such a program cannot be written again: XLA leaves out part of it
        try:
            write_cached(path, pickle.dumps((bool(called), *serialize(program))), _MOST_KEPT)
        except OSError as error:
            warnings.warn(
                f"compiled programs are not kept: {str(path.parent)!r} cannot be written ({error.strerror}).",
                stacklevel=3,
            )
    return program


@contextmanager
def _not_kept_by_jax() -> Iterator[list[str]]:
    """JAX does not write into its own cache; the list receives an entry if it has found the program there."""
    hits: list[str] = []

    def listen(event: str, **_: Any) -> None:
        if event == "/jax/compilation_cache/cache_hits":
            hits.append(event)

    before = jax.config.values[_SHORTEST_COMPILATION]
    monitoring.register_event_listener(listen)
    jax.config.update(_SHORTEST_COMPILATION, float("inf"))
    try:
        yield hits
    finally:
        jax.config.update(_SHORTEST_COMPILATION, before)
        monitoring.unregister_event_listener(listen)
