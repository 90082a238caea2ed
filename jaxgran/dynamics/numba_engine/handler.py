"""The function that XLA calls. Only this file knows XLA's binary interface.

It reads version 0.2 of the C interface of XLA's foreign functions, ``xla/ffi/api/c_api.h`` in the
folder ``jax.ffi.include_dir()``. ``jax.ffi`` registers the address of a compiled function, which
must decode this interface itself; the decoder that comes with jaxlib needs a C++ compiler.
Structures are read in words of eight bytes:

==============================  ========================================================
structure                       words
==============================  ========================================================
``XLA_FFI_CallFrame``           0 its size, 1 extension_start, 9 args.args, 14 rets.rets
``XLA_FFI_Buffer``              3 data, 4 rank, 5 dims
``XLA_FFI_Extension_Base``      1 type, in the lower half
``XLA_FFI_Metadata_Extension``  3 metadata
``XLA_FFI_Metadata``            3 api_version: major in the lower half, minor in the upper
==============================  ========================================================

These words are the same in versions 0.2 to 0.4, which jaxlib 0.9 to 0.11 speak. When the function
is registered, XLA calls it with a metadata extension, and asks for the version that it was written
for. XLA refuses one that it no longer supports, and then `ffi.register` raises an InputError.

A batch comes whole, with leading axes of replicas in all buffers. Threads of the operating system
take one replica after another: XLA was seen to run independent calls one by one, and numba's
default pool of threads cannot be entered by two. The thread that XLA calls is one of them, and no
thread outlives the call.
"""

# pyright: reportCallIssue=false
# An intrinsic of numba is called without the context that it is defined with.

import os
from typing import Any

import numpy as np
from llvmlite import ir
from numba import carray, njit, types
from numba.core import cgutils
from numba.extending import intrinsic

from jaxgran.dynamics.numba_engine import layout
from jaxgran.dynamics.numba_engine.arrays import arrays_of
from jaxgran.dynamics.numba_engine.loop import time_loop

API_MAJOR, API_MINOR = 0, 2
EXTENSION_START, ARGS, RETS = 1, 9, 14  # words of a call frame
DATA, RANK, DIMS = 3, 4, 5  # words of a buffer
_TYPE, METADATA = 1, 3  # words of an extension
API_VERSION = 3  # word of the metadata
_METADATA_EXTENSION = 1  # type of the extension that asks for the metadata

# Words of the job of the threads of a call: a size that no call frame has, the address of the call
# frame, the next replica that no thread has taken; behind these the threads
_SIZE, _FRAME, _NEXT, _JOB_WORDS = range(4)
_JOB = -1
_POSIX = os.name == "posix"
_create_thread = types.ExternalFunction(
    "pthread_create", types.int32(types.int64, types.int64, types.int64, types.int64)
)
_join_thread = types.ExternalFunction("pthread_join", types.int32(types.int64, types.int64))


@intrinsic
def _pointer(context, address):
    def generate(context, builder, signature, arguments):
        return builder.inttoptr(arguments[0], cgutils.voidptr_t)

    return types.voidptr(types.int64), generate


@intrinsic
def _shared_words(context):
    """Address of the shared words, which are in the module of the only function that calls this."""

    def generate(context, builder, signature, arguments):
        kind = ir.ArrayType(cgutils.intp_t, layout.SHARED_WORDS)
        words: Any = cgutils.add_global_variable(builder.module, kind, "jaxgran_shared_words")
        words.initializer, words.linkage = ir.Constant(kind, None), "internal"
        return builder.ptrtoint(words, cgutils.intp_t)

    return types.int64(), generate


@intrinsic
def _fetch_and_increment(context, address):
    def generate(context, builder, signature, arguments):
        word = builder.inttoptr(arguments[0], cgutils.intp_t.as_pointer())
        return builder.atomic_rmw("add", word, cgutils.intp_t(1), "seq_cst")

    return types.int64(types.int64), generate


@njit
def _words(address, count) -> Any:
    """An array of the words at an address."""
    return carray(_pointer(address), count, np.int64)


@njit
def _lengths(buffers, k):
    """Lengths of the axes of a buffer of matrices: of all axes of replicas together, and the last
    two.
    """
    buffer = _words(_words(buffers, k + 1)[k], DIMS + 1)
    axes = _words(buffer[DIMS], buffer[RANK])
    replicas = 1
    for length in axes[:-2]:
        replicas *= length
    return replicas, axes[-2], axes[-1]


@njit
def _data(buffers, k, replica, numbers):
    """Address of the numbers of a replica in a buffer, of which each replica has as many."""
    return _pointer(_words(_words(buffers, k + 1)[k], DATA + 1)[DATA] + 8 * replica * numbers)


@njit
def _doubles(buffers, k, replica, shape):
    """The numbers of a replica in a buffer."""
    numbers = 1
    for length in shape:
        numbers *= length
    return carray(_data(buffers, k, replica, numbers), shape, np.float64)


@njit
def _answers_metadata(frame):
    """Whether XLA asks for the version of the interface only; it is then told."""
    extension = frame[EXTENSION_START]
    if extension == 0:
        return False
    if _words(extension, _TYPE + 1)[_TYPE] & 0xFFFFFFFF != _METADATA_EXTENSION:
        return False
    metadata = _words(_words(extension, METADATA + 1)[METADATA], API_VERSION + 1)
    metadata[API_VERSION] = API_MINOR << 32 | API_MAJOR
    return True


@njit
def _start_threads(address, frame, shared):
    """The job of a call frame, and the end of its words that are threads."""
    replicas, blocks, _ = _lengths(frame[RETS], layout.BLOCKS)
    results = _doubles(frame[RETS], layout.BLOCKS, 0, (replicas * blocks, layout.RESULTS))
    results[:] = 0.0
    results[:, layout.STATUS] = layout.CAPACITY  # of replicas for which there is no memory
    job = np.empty(_JOB_WORDS + min(shared[layout.THREADS], replicas), np.int64)
    job[_SIZE], job[_FRAME], job[_NEXT] = _JOB, address, 0
    last = _JOB_WORDS
    while _POSIX and last + 1 < job.size:
        thread = job.ctypes.data + 8 * last
        if _create_thread(thread, 0, shared[layout.HANDLER], job.ctypes.data) != 0:
            break
        last += 1
    return job, last


@njit
def _advance_replicas(job, frame, shared):
    """Advance one replica after another, until all are taken."""
    args, rets = frame[ARGS], frame[RETS]
    replicas, blocks, _ = _lengths(rets, layout.BLOCKS)
    _, room, record = _lengths(rets, layout.RECORDS)
    grains = _lengths(rets, layout.NEW_POSITIONS)[1]
    of_next = job.ctypes.data + 8 * _NEXT
    replica = _fetch_and_increment(of_next)
    while replica < replicas:
        time_loop(
            _doubles(args, layout.POSITIONS, replica, (grains, 2)),
            _doubles(args, layout.VELOCITIES, replica, (grains, 2)),
            _doubles(args, layout.RADII, replica, (grains,)),
            _doubles(args, layout.MASSES, replica, (grains,)),
            carray(
                _data(args, layout.NUMBERS_GIVEN, replica, layout.INPUT_NUMBERS), 1, layout.INPUTS
            )[0],
            _doubles(args, layout.STEPS, replica, (blocks,)),
            _doubles(args, layout.BEGIN, replica, (layout.RESULTS,)),
            _doubles(rets, layout.NEW_POSITIONS, replica, (grains, 2)),
            _doubles(rets, layout.NEW_VELOCITIES, replica, (grains, 2)),
            _doubles(rets, layout.BLOCKS, replica, (blocks, layout.RESULTS)),
            _doubles(rets, layout.RECORDS, replica, (room, record)),
            arrays_of(grains),
            shared,
        )
        replica = _fetch_and_increment(of_next)


def handler(address):
    """Advance all replicas of a call.

    XLA calls this with the address of a call frame, each thread with that of a job, and Python with
    zero, for the address of the shared words. Returns zero otherwise.
    """
    of_shared = _shared_words()
    if address == 0:
        return of_shared
    shared, frame = _words(of_shared, layout.SHARED_WORDS), _words(address, RETS + 1)
    if frame[_SIZE] == _JOB:
        job, last = _words(address, _JOB_WORDS), _JOB_WORDS
    elif _answers_metadata(frame):
        return 0
    else:
        job, last = _start_threads(address, frame, shared)
    try:  # noqa: SIM105, numba compiles no context manager
        _advance_replicas(job, _words(job[_FRAME], RETS + 1), shared)
    except Exception:  # no memory: the other threads go on, and must end before this call does
        pass
    for n in range(_JOB_WORDS, last):
        _join_thread(job[n], 0)
    return 0
