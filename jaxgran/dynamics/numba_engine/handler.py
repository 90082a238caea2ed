"""The numba engine as XLA calls it, through its foreign function interface, and its compilation to an object file.

A call frame and its buffers are structures of words of eight bytes, see ``xla/ffi/api/c_api.h``, whose layout is kept
from version to version. A frame is (size, extensions, interface, context, stage, arguments, results, ...); arguments
and results are (size, extensions, count, types, pointers); a buffer is (size, extensions, dtype, data, rank, dims). A
frame that comes with an extension asks for the version that is spoken.
"""

import numba
from llvmlite import binding as llvm
from numba import types

from jaxgran.dynamics.numba_engine.allocation import arrays_of, doubles, integers
from jaxgran.dynamics.numba_engine.compilation import OPTIONS, inline_njit
from jaxgran.dynamics.numba_engine.layout import CAPACITY, INPUTS, RESULTS, STATUS
from jaxgran.dynamics.numba_engine.loop import advance_loop

_EXTENSIONS, _INTERFACE, _ARGUMENTS, _RESULTS = 1, 2, 9, 14  # words of a frame
_DATA, _DIMS = 3, 5  # words of a buffer
_ENTRY = """
@%s = global i64 0
define i64 @%s(i64 %%frame) {
  %%result = alloca i64
  %%exception = alloca ptr
  call i32 @%s(ptr %%result, ptr %%exception, i64 %%frame, i64 ptrtoint (ptr @%s to i64))
  %%returned = load i64, ptr %%result
  ret i64 %%returned
}
"""  # numba returns through a pointer; nothing here raises an exception
_VERSION = 4  # word of the interface: the minor version in the upper half, and the major one, 0, in the lower


@inline_njit
def _word(address, k):
    """Word k of a structure."""
    return integers(address, (k + 1,))[k]


@inline_njit
def _data(buffers, k):
    return _word(_word(buffers, k), _DATA)


@inline_njit
def _length(buffers, k, axis):
    return _word(_word(_word(buffers, k), _DIMS), axis)


def _handler(frame, stop):
    """``advance_loop``: arguments and results are buffers of a call frame; ``stop`` is the address of a word."""
    extension = _word(frame, _EXTENSIONS)
    if extension != 0:
        metadata = integers(_word(extension, 3), (4,))
        metadata[3] = _word(_word(frame, _INTERFACE), _VERSION) >> 32 << 32
        return 0
    given, made = _word(frame, _ARGUMENTS), _word(frame, _RESULTS)
    grains = _length(given, 2, 0)
    results, memory = doubles(_data(made, 2), (RESULTS,)), integers(_data(made, 3), (1,))
    memory[0] = _data(made, 3) + 8  # what is left begins behind this number
    arrays, fits = arrays_of(memory, grains)
    if not fits:  # the bounds in ``layout`` are wrong
        for n in range(RESULTS):
            results[n] = 0.0
        results[STATUS] = CAPACITY
        return 0
    advance_loop(
        doubles(_data(given, 0), (grains, 2)),
        doubles(_data(given, 1), (grains, 2)),
        doubles(_data(given, 2), (grains,)),
        doubles(_data(given, 3), (grains,)),
        doubles(_data(given, 4), (INPUTS,)),
        doubles(_data(made, 0), (grains, 2)),
        doubles(_data(made, 1), (grains, 2)),
        results,
        doubles(_data(made, 4), (_length(made, 4, 0), _length(made, 4, 1))),
        arrays,
        integers(stop, (1,)),
    )
    return 0


def object_code(symbol: str, stop: str, machine: llvm.TargetMachine) -> bytes:
    """The handler and all that it calls as an object file for a processor, with the word that stops it."""
    made = numba.njit(types.int64(types.int64, types.int64), **OPTIONS)(_handler)
    (kept,) = made.overloads.values()
    (code,) = made.inspect_llvm().values()
    module = llvm.parse_assembly(code + _ENTRY % (stop, symbol, kept.fndesc.mangled_name, stop))
    module.verify()
    return machine.emit_object(module)
