"""The function that XLA calls, and its compilation. Only this file knows XLA's binary interface.

It reads version 0.2 of the C interface of XLA's foreign functions, ``xla/ffi/api/c_api.h`` in the
folder ``jax.ffi.include_dir()``. ``jax.ffi`` registers the address of a compiled function, which
must decode this interface itself; the decoder that comes with jaxlib needs a C++ compiler.
Structures are read in words of eight bytes:

==============================  ========================================================
structure                       words
==============================  ========================================================
``XLA_FFI_CallFrame``           1 extension_start, 9 args.args, 14 rets.rets
``XLA_FFI_Buffer``              3 data, 4 rank, 5 dims
``XLA_FFI_Extension_Base``      1 type, in the lower half
``XLA_FFI_Metadata_Extension``  3 metadata
``XLA_FFI_Metadata``            3 api_version: major in the lower half, minor in the upper
==============================  ========================================================

These words are the same in versions 0.2 to 0.4, which jaxlib 0.9 to 0.11 speak. When the function
is registered, XLA calls it with a metadata extension, and asks for the version that it was written
for. XLA refuses one that it no longer supports, and then `ffi.register` raises an InputError.

A batch comes whole, with leading axes of replicas in all buffers. Threads of the operating system
take one replica after another. The thread that XLA calls is one of them, and no thread outlives the
call.
"""

import os

import numba
from llvmlite import binding as llvm
from numba import types

from jaxgran.dynamics.numba_engine.allocation import (
    arrays_of,
    doubles_at,
    inputs_at,
    integers_at,
)
from jaxgran.dynamics.numba_engine.compilation import OPTIONS, inline_njit
from jaxgran.dynamics.numba_engine.layout import (
    BLOCKS,
    CAPACITY,
    INPUT_NUMBERS,
    MASSES,
    MEMORY,
    NEW_POSITIONS,
    NEW_VELOCITIES,
    NUMBERS_GIVEN,
    POSITIONS,
    RADII,
    RECORDS,
    RESULTS,
    STATUS,
    STEPS,
    VELOCITIES,
    WORDS,
    WORDS_PER_GRAIN,
)
from jaxgran.dynamics.numba_engine.loop import advance_loop

API_MAJOR, API_MINOR = 0, 2
EXTENSION_START, ARGS, RETS = 1, 9, 14  # words of a call frame
DATA, RANK, DIMS = 3, 4, 5  # words of a buffer
_TYPE, METADATA = 1, 3  # words of an extension
API_VERSION = 3  # word of the metadata
_METADATA_EXTENSION = 1  # type of the extension that asks for the metadata

_COUNT = -1  # asks the handler for the number of replicas

# numba returns through a pointer, and passes exceptions through another; nothing here raises one.
# The job of the threads of a call: its frame, its number of replicas, and the next replica that no
# thread has taken.
_ENTRY = """
@STOP = global i64 0
@THREADS = global i64 1

define internal i64 @handle(i64 %frame, i64 %replica) {
  %result = alloca i64
  %exception = alloca ptr
  call i32 @COMPILED(ptr %result, ptr %exception, i64 %frame, i64 %replica,
                     i64 ptrtoint (ptr @STOP to i64))
  %returned = load i64, ptr %result
  ret i64 %returned
}

define internal ptr @work(ptr %job) {
  %of_count = getelementptr i64, ptr %job, i64 1
  %of_next = getelementptr i64, ptr %job, i64 2
  %frame = load i64, ptr %job
  %count = load i64, ptr %of_count
  br label %take
take:
  %replica = atomicrmw add ptr %of_next, i64 1 seq_cst
  %left = icmp slt i64 %replica, %count
  br i1 %left, label %run, label %end
run:
  call i64 @handle(i64 %frame, i64 %replica)
  br label %take
end:
  ret ptr null
}

define i64 @SYMBOL(i64 %frame) {
  %job = alloca i64, i64 3
  %count = call i64 @handle(i64 %frame, i64 COUNT)
  %of_count = getelementptr i64, ptr %job, i64 1
  %of_next = getelementptr i64, ptr %job, i64 2
  store i64 %frame, ptr %job
  store i64 %count, ptr %of_count
  store i64 0, ptr %of_next
  %threads = load i64, ptr @THREADS
  %fewer = icmp slt i64 %count, %threads
  %most = select i1 %fewer, i64 %count, i64 %threads
  %some = icmp sgt i64 %most, 1
  %others = sub i64 %most, 1
  %room = select i1 %some, i64 %others, i64 0
  %handles = alloca i64, i64 %room
  br label %start
start:
  %started = phi i64 [0, %0], [%one_more, %created]
  %enough = icmp sge i64 %started, %room
  br i1 %enough, label %join_in, label %create
create:
  %new = getelementptr i64, ptr %handles, i64 %started
  %problem = call i32 @pthread_create(ptr %new, ptr null, ptr @work, ptr %job)
  %failed = icmp ne i32 %problem, 0
  br i1 %failed, label %join_in, label %created
created:
  %one_more = add i64 %started, 1
  br label %start
join_in:
  call ptr @work(ptr %job)
  br label %wait
wait:
  %waited = phi i64 [0, %join_in], [%next, %join]
  %done = icmp sge i64 %waited, %started
  br i1 %done, label %end, label %join
join:
  %of_handle = getelementptr i64, ptr %handles, i64 %waited
  %handle = load i64, ptr %of_handle
  call i32 @pthread_join(i64 %handle, ptr null)
  %next = add i64 %waited, 1
  br label %wait
end:
  ret i64 0
}
"""
_POSIX = """
declare i32 @pthread_create(ptr, ptr, ptr, ptr)
declare i32 @pthread_join(i64, ptr)
"""
_OTHER = """
define internal i32 @pthread_create(ptr %handle, ptr %attributes, ptr %function, ptr %argument) {
  ret i32 1
}
define internal i32 @pthread_join(i64 %handle, ptr %result) { ret i32 1 }
"""
_allocate = types.ExternalFunction("malloc", types.int64(types.int64))
_release = types.ExternalFunction("free", types.void(types.int64))


@inline_njit
def _word(address, k):
    """Word k of the structure at an address."""
    return integers_at(address, (k + 1,))[k]


@inline_njit
def _length(buffers, k, axis):
    """Length of a buffer along an axis, which is counted from the last one, 1."""
    buffer = _word(buffers, k)
    return _word(_word(buffer, DIMS), _word(buffer, RANK) - axis)


@inline_njit
def _data(buffers, k, replica, numbers):
    """Address of the numbers of a replica in a buffer, of which each replica has as many."""
    return _word(_word(buffers, k), DATA) + 8 * replica * numbers


@inline_njit
def _replicas(buffers, k):
    """Number of replicas of a buffer that has one axis for each of them."""
    count = 1
    for axis in range(2, _word(_word(buffers, k), RANK) + 1):
        count *= _length(buffers, k, axis)
    return count


def _handler(frame, replica, stop):
    """Call ``advance_loop`` with the buffers of a replica of a call frame; ``stop`` is the address
    of a word.

    Returns 0; for the replica ``_COUNT`` the number of replicas, which is 0 where XLA asks for the
    version.
    """
    extension = _word(frame, EXTENSION_START)
    if extension != 0 and _word(extension, _TYPE) & 0xFFFFFFFF == _METADATA_EXTENSION:
        metadata = integers_at(_word(extension, METADATA), (API_VERSION + 1,))
        metadata[API_VERSION] = API_MINOR << 32 | API_MAJOR
        return 0
    args, rets = _word(frame, ARGS), _word(frame, RETS)
    if replica == _COUNT:
        return _replicas(args, NUMBERS_GIVEN)
    grains = _length(args, RADII, 1)
    room, record = _length(rets, RECORDS, 2), _length(rets, RECORDS, 1)
    blocks = _length(args, STEPS, 1)
    results = doubles_at(_data(rets, BLOCKS, replica, blocks * RESULTS), (blocks, RESULTS))
    words = 1 + WORDS + WORDS_PER_GRAIN * grains
    kept = _length(rets, MEMORY, 1) > 0  # the memory outlasts the call
    block = _data(rets, MEMORY, replica, words) if kept else _allocate(8 * words)
    if block == 0:
        return _refuse(results)
    memory = integers_at(block, (1,))
    memory[0] = block + 8  # the first free byte is behind this number
    arrays, fits = arrays_of(memory, grains)
    if not fits:  # the bounds in ``layout`` are wrong
        if not kept:
            _release(block)
        return _refuse(results)
    advance_loop(
        doubles_at(_data(args, POSITIONS, replica, 2 * grains), (grains, 2)),
        doubles_at(_data(args, VELOCITIES, replica, 2 * grains), (grains, 2)),
        doubles_at(_data(args, RADII, replica, grains), (grains,)),
        doubles_at(_data(args, MASSES, replica, grains), (grains,)),
        inputs_at(_data(args, NUMBERS_GIVEN, replica, INPUT_NUMBERS), (1,))[0],
        doubles_at(_data(args, STEPS, replica, blocks), (blocks,)),
        doubles_at(_data(rets, NEW_POSITIONS, replica, 2 * grains), (grains, 2)),
        doubles_at(_data(rets, NEW_VELOCITIES, replica, 2 * grains), (grains, 2)),
        results,
        doubles_at(_data(rets, RECORDS, replica, room * record), (room, record)),
        arrays,
        integers_at(stop, (1,)),
    )
    if not kept:
        _release(block)
    return 0


@inline_njit
def _refuse(results):
    """Results of a call for which there is no memory."""
    for b in range(results.shape[0]):
        for n in range(RESULTS):
            results[b, n] = 0.0
        results[b, STATUS] = CAPACITY
    return 0


def object_code(symbol: str, stop: str, threads: str, machine: llvm.TargetMachine) -> bytes:
    """Compile the handler, and all that it calls, to an object file for a processor.

    Args:
      symbol: name of the function that XLA calls.
      stop: name of the word that stops it.
      threads: name of the word with its number of threads.
      machine: the processor.
    """
    made = numba.njit(types.int64(types.int64, types.int64, types.int64), **OPTIONS)(_handler)
    (kept,) = made.overloads.values()
    (code,) = made.inspect_llvm().values()
    entry = _ENTRY + (_POSIX if os.name == "posix" else _OTHER)
    names = {
        "SYMBOL": symbol,
        "STOP": stop,
        "THREADS": threads,
        "COUNT": _COUNT,
        "COMPILED": kept.fndesc.mangled_name,
    }
    for name, value in names.items():
        entry = entry.replace(name, str(value))
    module = llvm.parse_assembly(code + entry)
    module.verify()
    return machine.emit_object(module)
