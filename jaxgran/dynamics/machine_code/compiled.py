"""How functions are compiled by numba, and where their machine code is kept.

numba's own cache knows the text of one file only. Here functions of several files, and the constants that they import,
are compiled together. So the machine code is kept in a folder whose name is a hash of all these files: a change in any
of them compiles anew, in a user's cache and in the tests. A cache that cannot be written costs a compilation in every
process and a warning, never a failure.
"""

import ast
import hashlib
import inspect
import math
import shutil
import tempfile
import warnings
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any

import numba
import numpy as np
from numba import njit
from platformdirs import user_cache_path

from jaxgran.contact import law

_NO_WRAPPERS = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}  # nothing here is called from Python
_KEPT = 8  # versions of the machine code in the cache
_OPTIONS: dict[str, Any] = {"error_model": "numpy", "fastmath": {"contract"}, **_NO_WRAPPERS}


def sources() -> list[Path]:
    """The files that are compiled together: this folder, and what it imports of the package."""
    here = Path(__file__).parent
    package, found, left = here.parents[1], set(), list(here.glob("*.py"))
    while left:
        path = left.pop()
        if path not in found:
            found.add(path)
            for node in ast.walk(ast.parse(path.read_bytes())):
                if isinstance(node, ast.ImportFrom) and (node.module or "").startswith(f"{package.name}."):
                    place = package.joinpath(*(node.module or "").split(".")[1:])
                    names = [place, *(place / name.name for name in node.names)]
                    left += [file for name in names if (file := name.with_suffix(".py")).is_file()]
    return sorted(found)


def cache_folder() -> Path:
    """Where the machine code of these sources is kept, below numba's own choice of a cache or the user's."""
    digest = hashlib.sha256()
    for path in sources():
        digest.update(path.read_bytes())
    base = numba.config.CACHE_DIR or user_cache_path("jaxgran") / "machine_code"  # pyright: ignore
    return Path(base) / f"jaxgran-{digest.hexdigest()[:16]}"


def _usable(folder: Path) -> bool:
    """Whether files can be written into a folder; makes it, and removes the oldest versions beside it."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        warnings.warn(
            f"the machine code is compiled anew in every process, in about 15 s: the cache folder {str(folder)!r} "
            f"cannot be written ({error.strerror}); set XDG_CACHE_HOME or NUMBA_CACHE_DIR to one that can.",
            stacklevel=2,
        )
        return False
    with suppress(OSError):
        versions = sorted(folder.parent.glob("jaxgran-*"), key=lambda path: path.stat().st_mtime, reverse=True)
        for old in versions[_KEPT:]:
            shutil.rmtree(old, ignore_errors=True)
    return True


CACHE = cache_folder()
CACHED = _usable(CACHE)


def cached(decorator: Callable[..., Any], *arguments: Any, **options: Any) -> Callable[[Callable], Any]:
    """A decorator of numba whose results are kept in ``CACHE``; numba reads the place when it decorates."""

    def decorated(function: Callable) -> Any:
        before = numba.config.CACHE_DIR  # pyright: ignore[reportAttributeAccessIssue]
        numba.config.CACHE_DIR = str(CACHE)  # pyright: ignore[reportAttributeAccessIssue]
        try:
            return decorator(*arguments, cache=CACHED, **options)(function)
        finally:
            numba.config.CACHE_DIR = before  # pyright: ignore[reportAttributeAccessIssue]

    return decorated


compiled = cached(njit, **_OPTIONS)


@compiled
def _where(condition, yes, no):
    return yes if condition else no


@compiled
def _maximum(a, b):
    return a if a > b else b


def _compiled_law(module: ModuleType) -> dict[str, Any]:
    """The functions of a module that is written for arrays of JAX, compiled for numbers from the same source."""
    names: dict[str, Any] = {**vars(module), "where": _where, "maximum": _maximum, "sqrt": math.sqrt, "ceil": np.ceil}
    functions = {
        name: f for name, f in inspect.getmembers(module, inspect.isfunction) if f.__module__ == module.__name__
    }
    for name, function in functions.items():
        names[name] = compiled(FunctionType(function.__code__, names, name))
    return {name: names[name] for name in functions}


LAW = _compiled_law(law)  # the functions of ``contact.law``
