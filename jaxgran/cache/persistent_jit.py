"""``jit`` with compiled programs on disk, for what every command computes first.

To look a program up in its own cache, JAX must first trace and lower it, which takes longer than
loading it: with that cache alone a second ``jaxgran run`` takes 1.8 times as long. Here the key
needs no tracing: sources of this package, versions, flags, and shapes of the arguments.
"""

import hashlib
import os
import pickle
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache, wraps
from pathlib import Path
from threading import RLock
from typing import Any

import jax
from jax import monitoring
from jax.core import Tracer
from jax.experimental.serialize_executable import deserialize_and_load, serialize

from jaxgran.cache.folder import programs_folder
from jaxgran.environment import on_processor, processor, versions
from jaxgran.files import atomic_write, file_lock, keep_newest

_MOST_PROGRAMS = 64  # of up to 4 MB each
_CUSTOM_CALL = re.compile(r"stablehlo\.custom_call @(\w+)")
_KEPT_CALLS = {"jaxgran_advance", "Sharding"}  # others need what JAX loads only on lowering
_MIN_COMPILE_TIME = "jax_persistent_cache_min_compile_time_secs"
_LOCK = RLock()  # several threads load or compile a program once, and change JAX's flags in turn


def persistent_jit(function: Callable, register: Callable[[], None] = lambda: None) -> Callable:
    """``jax.jit`` of a function, with programs for a processor kept on disk after ``use_cache``.

    Args:
      function: a function of pytrees of arrays, without static arguments. JAX's flags are read at
        the first call with arguments of given shapes.
      register: called before a program is loaded that calls the numba engine.
    """
    jitted = jax.jit(function)
    programs: dict[Any, Callable] = {}

    @wraps(function)
    def call(*arguments: Any) -> Any:
        folder = programs_folder()
        leaves, structure = jax.tree.flatten(arguments)
        elsewhere = not on_processor() or jax.device_count() > 1
        traced = any(isinstance(leaf, Tracer) for leaf in leaves)
        if folder is None or elsewhere or traced or not _is_ours(structure):
            return jitted(*arguments)
        key = (structure, tuple(map(jax.typeof, leaves)))
        if key not in programs:
            path = folder / "programs" / f"{_digest(function, key)}.program"
            with _LOCK, file_lock(path):
                if key not in programs:
                    kept = _load(path, register)
                    programs[key] = kept or _compile(jitted.lower(*arguments), path)
        return programs[key](*arguments)

    return call


@cache
def sources_digest() -> str:
    """A hash of the sources of this package."""
    digest, folder = hashlib.sha256(), Path(__file__).parents[1]
    for path in sorted(folder.rglob("*.py")):
        digest.update(str(path.relative_to(folder)).encode() + path.read_bytes())
    return digest.hexdigest()[:16]


@cache
def _origin() -> str:
    """What every program depends on: sources, versions, processor, XLA's flags."""
    packages = versions(("jax", "jaxlib", "numpy")).values()
    flags = os.environ.get("XLA_FLAGS", "")
    return "\n".join([sources_digest(), *packages, processor("flags", "Features"), flags])


def _digest(function: Callable, key: tuple) -> str:
    flags = sorted((name, repr(x)) for name, x in jax.config.values.items() if "cache" not in name)
    text = f"{_origin()}\n{flags}\n{function.__module__}.{function.__qualname__}\n{key}"
    return hashlib.sha256(text.encode()).hexdigest()[:32]


def _is_ours(structure: Any) -> bool:
    """Whether no argument is of a class from outside, such as a user's solver, whose source is not
    in the key.
    """
    node = structure.node_data()
    ours = node is None or node[0].__module__.partition(".")[0] in ("builtins", "jaxgran")
    return ours and all(map(_is_ours, structure.children()))


def _load(path: Path, register: Callable[[], None]) -> Callable | None:
    """A program on disk; None if there is none, or it is damaged."""
    with suppress(Exception):  # whatever is wrong with the file, the function can be compiled again
        stored = path.read_bytes()
        content = stored[32:]
        if hashlib.sha256(content).digest() == stored[:32]:
            calls, *parts = pickle.loads(content)
            if calls:
                register()
            return deserialize_and_load(*parts)
    return None


def _compile(lowered: Any, path: Path) -> Callable:
    """Compile, and keep the program unless it calls another library."""
    calls = {*_CUSTOM_CALL.findall(lowered.as_text())}
    if not calls <= _KEPT_CALLS:
        return lowered.compile()
    with _without_writing_to_jax_cache() as hits:
        program = lowered.compile()
    if hits:  # a program from JAX's cache cannot be serialised again: XLA omits part of it
        return program
    content = pickle.dumps((bool(calls), *serialize(program)))
    with suppress(OSError), atomic_write(path) as temporary:
        temporary.write_bytes(hashlib.sha256(content).digest() + content)
    keep_newest(path.parent.glob("[!.]*.program"), _MOST_PROGRAMS)
    return program


@contextmanager
def _without_writing_to_jax_cache() -> Iterator[list[str]]:
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
