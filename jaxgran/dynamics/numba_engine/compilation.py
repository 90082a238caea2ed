"""Compilation by numba, with the law of a contact and the images of the cell from their only
source.
"""

import inspect
import math
from collections.abc import Callable
from types import FunctionType, ModuleType
from typing import Any

import numba
import numpy as np

from jaxgran.contact import law
from jaxgran.model import cell

OPTIONS: dict[str, Any] = {"error_model": "numpy", "fastmath": {"contract"}}
# Into one function, since structures of arrays are passed by value, some hundred words a call; and
# since a process that compiles would call other copies of these functions than one that loads the
# cached code, which differ by rounding.
_INLINED: dict[str, Any] = {
    "forceinline": True,
    "no_cpython_wrapper": True,  # nothing here is called from Python
    "no_cfunc_wrapper": True,
    "_nrt": False,  # private; references to arrays are not counted, which makes the engine faster
}
njit: Callable[[Callable], Any] = numba.njit(**OPTIONS, **_INLINED)
# without fused operations
njit_plain: Callable[[Callable], Any] = numba.njit(**OPTIONS | {"fastmath": False}, **_INLINED)


@njit
def _where(condition, yes, no):
    return yes if condition else no


@njit
def _maximum(a, b):
    return a if a > b else b


@njit
def whole_part(number, most):
    """The whole part of a number, from 0 to ``most``, and 0 of NaN: an index must follow from a
    number by this function, since the whole part of NaN or of a huge number may be anything.
    """
    positive = number if number > 0.0 else 0.0
    return int(positive if positive < most else most)


def _compiled(module: ModuleType) -> dict[str, Any]:
    """The functions of a module that is written for arrays of JAX, compiled for numbers from the
    same source where they are called.
    """
    names: dict[str, Any] = {
        **vars(module),
        "where": _where,
        "maximum": _maximum,
        "sqrt": math.sqrt,
        "ceil": np.ceil,
        "floor": np.floor,
        "rint": np.rint,
    }
    functions = {
        name: f
        for name, f in inspect.getmembers(module, inspect.isfunction)
        if f.__module__ == module.__name__
    }
    for name, function in functions.items():
        names[name] = njit(FunctionType(function.__code__, names, name))
    return {name: names[name] for name in functions}


LAW, CELL = _compiled(law), _compiled(cell)
