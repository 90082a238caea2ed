"""The machine code as XLA calls it, through its foreign function interface.

A call frame and its buffers are structures of words of eight bytes, see ``xla/ffi/api/c_api.h``, whose layout is kept
from version to version. A frame is (size, extensions, interface, context, stage, arguments, results, ...); arguments
and results are (size, extensions, count, types, pointers); a buffer is (size, extensions, dtype, data, rank, dims). A
frame that comes with an extension asks for the version that is spoken.
"""

# pyright: reportCallIssue=false
# An intrinsic of numba is called without the context that it is defined with.

import ctypes
from functools import cache

import jax
from llvmlite import ir
from numba import carray, cfunc, types
from numba.extending import intrinsic

from jaxgran.dynamics.machine_code.compiled import cached, compiled
from jaxgran.dynamics.machine_code.loop import INPUTS, RESULTS, advance_loop

TARGET = "jaxgran_advance"
_EXTENSIONS, _INTERFACE, _ARGUMENTS, _RESULTS = 1, 2, 9, 14  # words of a frame
_DATA, _DIMS = 3, 5  # words of a buffer
_VERSION = 4  # word of the interface: the minor version in the upper half, and the major one, 0, in the lower


@intrinsic
def _words(context, address):
    """The address as a pointer to words of eight bytes."""

    def generate(_, builder, signature, arguments):
        return builder.inttoptr(arguments[0], ir.IntType(64).as_pointer())

    return types.CPointer(types.int64)(types.int64), generate


@intrinsic
def _doubles(context, address):
    """The address as a pointer to numbers of double precision."""

    def generate(_, builder, signature, arguments):
        return builder.inttoptr(arguments[0], ir.DoubleType().as_pointer())

    return types.CPointer(types.float64)(types.int64), generate


@compiled
def _data(buffers, k):
    return _words(_words(buffers)[k])[_DATA]


@compiled
def _length(buffers, k):
    return _words(_words(_words(buffers)[k])[_DIMS])[0]


@cached(cfunc, types.int64(types.int64))
def handler(frame):
    """``advance_loop``: arguments and results are buffers of a call frame."""
    extension = _words(frame)[_EXTENSIONS]
    if extension != 0:
        metadata = _words(_words(extension)[3])
        metadata[3] = _words(_words(frame)[_INTERFACE])[_VERSION] >> 32 << 32
        return 0
    given, made = _words(frame)[_ARGUMENTS], _words(frame)[_RESULTS]
    grains = _length(given, 2)
    advance_loop(
        carray(_doubles(_data(given, 0)), (grains, 2)),
        carray(_doubles(_data(given, 1)), (grains, 2)),
        carray(_doubles(_data(given, 2)), (grains,)),
        carray(_doubles(_data(given, 3)), (grains,)),
        carray(_doubles(_data(given, 4)), (INPUTS,)),
        carray(_doubles(_data(made, 0)), (grains, 2)),
        carray(_doubles(_data(made, 1)), (grains, 2)),
        carray(_doubles(_data(made, 2)), (RESULTS,)),
    )
    return 0


@cache
def register() -> None:
    """Compile the machine code, or take what is kept of it, and tell XLA where it is."""
    new = ctypes.pythonapi.PyCapsule_New
    new.restype, new.argtypes = ctypes.py_object, (ctypes.c_void_p, ctypes.c_char_p, ctypes.c_void_p)
    jax.ffi.register_ffi_target(TARGET, new(handler.address, None, None), platform="cpu")
