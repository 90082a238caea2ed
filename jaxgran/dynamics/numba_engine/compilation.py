"""How functions are compiled by numba: without its runtime, and the law of a contact from its one source."""

import inspect
import math
from collections.abc import Callable
from types import FunctionType, ModuleType
from typing import Any

import numpy as np
from numba import njit

from jaxgran.contact import law

OPTIONS: dict[str, Any] = {
    "error_model": "numpy",
    "fastmath": {"contract"},
    "_nrt": False,  # no runtime of numba, which would have to be imported
    "no_cpython_wrapper": True,  # nothing here is called from Python
    "no_cfunc_wrapper": True,
}
# Arrays are handed on by value, some hundred words a call, so what runs in every step becomes part of its caller.
compiled: Callable[[Callable], Any] = njit(forceinline=True, **OPTIONS)
called: Callable[[Callable], Any] = njit(**OPTIONS)  # what runs seldom


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
