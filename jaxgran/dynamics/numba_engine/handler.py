"""The function that XLA calls, and its compilation. Only this file knows XLA's binary interface.

It reads version 0.2 of the C interface of XLA's foreign functions, ``xla/ffi/api/c_api.h`` in the folder
``jax.ffi.include_dir()``. ``jax.ffi`` registers the address of a compiled function, which must decode this interface
itself; the decoder that comes with jaxlib needs a C++ compiler. Structures are read in words of eight bytes:

==============================  ========================================================
structure                       words
==============================  ========================================================
``XLA_FFI_CallFrame``           1 extension_start, 9 args.args, 14 rets.rets
``XLA_FFI_Buffer``              3 data, 5 dims
``XLA_FFI_Extension_Base``      1 type, in the lower half
``XLA_FFI_Metadata_Extension``  3 metadata
``XLA_FFI_Metadata``            3 api_version: major in the lower half, minor in the upper
==============================  ========================================================

These words are the same in versions 0.2 to 0.4, which jaxlib 0.9 to 0.11 speak. When the function is registered, XLA
calls it with a metadata extension, and asks for the version that it was written for. XLA refuses one that it no longer
supports, and then `ffi.register` raises an InputError.
"""

import numba
from llvmlite import binding as llvm
from numba import types

from jaxgran.dynamics.numba_engine.allocation import arrays_of, doubles_at, integers_at
from jaxgran.dynamics.numba_engine.compilation import OPTIONS, inline_njit
from jaxgran.dynamics.numba_engine.layout import CAPACITY, INPUTS, RESULTS, STATUS
from jaxgran.dynamics.numba_engine.loop import advance_loop

API_MAJOR, API_MINOR = 0, 2
EXTENSION_START, ARGS, RETS = 1, 9, 14  # words of a call frame
DATA, DIMS = 3, 5  # words of a buffer
_TYPE, METADATA = 1, 3  # words of an extension
API_VERSION = 3  # word of the metadata
_METADATA_EXTENSION = 1  # type of the extension that asks for the metadata

# numba returns through a pointer, and passes exceptions through another; nothing here raises one.
_ENTRY = """
@%s = global i64 0
define i64 @%s(i64 %%frame) {
  %%result = alloca i64
  %%exception = alloca ptr
  call i32 @%s(ptr %%result, ptr %%exception, i64 %%frame, i64 ptrtoint (ptr @%s to i64))
  %%returned = load i64, ptr %%result
  ret i64 %%returned
}
"""


@inline_njit
def _word(address, k):
    """Word k of the structure at an address."""
    return integers_at(address, (k + 1,))[k]


@inline_njit
def _data(buffers, k):
    return _word(_word(buffers, k), DATA)


@inline_njit
def _length(buffers, k, axis):
    return _word(_word(_word(buffers, k), DIMS), axis)


def _handler(frame, stop):
    """Call ``advance_loop`` with the buffers of a call frame; ``stop`` is the address of a word.

    Returns 0, the null pointer, which XLA reads as success.
    """
    extension = _word(frame, EXTENSION_START)
    if extension != 0 and _word(extension, _TYPE) & 0xFFFFFFFF == _METADATA_EXTENSION:
        metadata = integers_at(_word(extension, METADATA), (API_VERSION + 1,))
        metadata[API_VERSION] = API_MINOR << 32 | API_MAJOR
        return 0
    args, rets = _word(frame, ARGS), _word(frame, RETS)
    grains = _length(args, 2, 0)
    results, memory = doubles_at(_data(rets, 2), (RESULTS,)), integers_at(_data(rets, 3), (1,))
    memory[0] = _data(rets, 3) + 8  # the first free byte is behind this number
    arrays, fits = arrays_of(memory, grains)
    if not fits:  # the bounds in ``layout`` are wrong
        for n in range(RESULTS):
            results[n] = 0.0
        results[STATUS] = CAPACITY
        return 0
    advance_loop(
        doubles_at(_data(args, 0), (grains, 2)),
        doubles_at(_data(args, 1), (grains, 2)),
        doubles_at(_data(args, 2), (grains,)),
        doubles_at(_data(args, 3), (grains,)),
        doubles_at(_data(args, 4), (INPUTS,)),
        doubles_at(_data(rets, 0), (grains, 2)),
        doubles_at(_data(rets, 1), (grains, 2)),
        results,
        doubles_at(_data(rets, 4), (_length(rets, 4, 0), _length(rets, 4, 1))),
        arrays,
        integers_at(stop, (1,)),
    )
    return 0


def object_code(symbol: str, stop: str, machine: llvm.TargetMachine) -> bytes:
    """Compile the handler, and all that it calls, to an object file for a processor.

    Args:
      symbol: name of the function that XLA calls.
      stop: name of the word that stops it.
      machine: the processor.
    """
    made = numba.njit(types.int64(types.int64, types.int64), **OPTIONS)(_handler)
    (kept,) = made.overloads.values()
    (code,) = made.inspect_llvm().values()
    module = llvm.parse_assembly(code + _ENTRY % (stop, symbol, kept.fndesc.mangled_name, stop))
    module.verify()
    return machine.emit_object(module)
