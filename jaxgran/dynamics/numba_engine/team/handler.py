"""The function that XLA calls on a CUDA device: it launches the kernel on XLA's stream.

It reads the call frame as ``numba_engine.handler`` does, with the same buffers, but that of the
records, which is the memory of the loop here: XLA allocates it, and keeps it until the kernel has
ended. It runs in Python, once for a whole batch, and does not wait for the device.
"""

import ctypes
from collections.abc import Callable
from functools import cache
from math import prod
from pathlib import Path
from typing import Any

import jax

from jaxgran.dynamics.numba_engine import ffi, layout
from jaxgran.files import atomic_write, file_lock

_API, _CONTEXT, _ARGS, _RETS = 2, 3, 9, 14  # words of a call frame
_ERROR_CREATE, _STREAM_GET = 6, 10  # words of the table of XLA's functions
_METADATA_EXTENSION, _INTERNAL_ERROR = 1, 13
_MAX_REGISTERS, _REGISTERS = 0, 128  # option of the driver's compiler, and its value for a thread
_VERSION = 2 << 32  # 0.2 of the interface: the minor number in the upper half
_KEPT: list[Any] = []  # functions that XLA calls
# Called with the frame's table of functions and context, the number of replicas, and the arguments
# of the kernel: grains, blocks, and the addresses of the buffers
Launch = Callable[[int, int, int, list[int]], None]


def _words(address: int, count: int) -> Any:
    return (ctypes.c_uint64 * count).from_address(address)


def _buffer(buffers: int, k: int) -> tuple[int, list[int]]:
    """Address and shape of a buffer."""
    data, rank, axes = _words(_words(buffers, k + 1)[k], 6)[3:]
    return data, list(_words(axes, rank)) if rank else []


def call_xla(api: int, function: int, *fields: int) -> tuple[int, int | None]:
    """Call a function of XLA with a structure of these words; returns the last of them, and an
    error or None.
    """
    size = 2 + len(fields)
    arguments = (ctypes.c_uint64 * size)(8 * size, 0, *fields)
    called = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p)(_words(api, function + 1)[function])
    error = called(ctypes.addressof(arguments))
    return arguments[size - 1], error


def handler_of(launch: Launch) -> Any:
    """A C callback for XLA around a launch; what goes wrong in it becomes an error of JAX."""

    def handle(address: int) -> int | None:
        frame = _words(address, 20)
        extension = frame[1]
        if extension and _words(extension, 2)[1] & 0xFFFFFFFF == _METADATA_EXTENSION:
            _words(_words(extension, 4)[3], 4)[3] = _VERSION
            return None
        try:
            given = [_buffer(frame[_ARGS], k) for k in range(layout.BEGIN + 1)]
            results = [_buffer(frame[_RETS], k) for k in range(layout.RECORDS + 1)]
            *batch, grains = given[layout.RADII][1]
            blocks = given[layout.STEPS][1][-1]
            addresses = [data for data, _ in given + results]
            launch(frame[_API], frame[_CONTEXT], prod(batch), [grains, blocks, *addresses])
        except Exception as problem:  # none may pass through XLA
            message = ctypes.create_string_buffer(f"the numba engine on CUDA: {problem}".encode())
            words = ctypes.addressof(message), _INTERNAL_ERROR
            return call_xla(frame[_API], _ERROR_CREATE, *words)[1]
        return None

    return ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p)(handle)


def register_handler(target: str, platform: str, launch: Launch) -> None:
    """Register a launch with XLA under a name."""
    callback = handler_of(launch)
    _KEPT.append(callback)
    address = ctypes.cast(callback, ctypes.c_void_p).value
    jax.ffi.register_ffi_target(target, jax.ffi.pycapsule(address), platform=platform)


@cache
def register() -> None:
    """Load the kernel, or compile it, and register it on CUDA; once in a process."""
    kernel()
    register_handler(ffi.TARGET, "CUDA", launch_on_stream)


@cache
def driver() -> Any:
    """The library of the driver, which every machine with a CUDA device has."""
    return ctypes.CDLL("libcuda.so.1")


def has_cuda() -> bool:
    """Whether there is a CUDA driver."""
    try:
        driver()
    except OSError:
        return False
    return True


def _check(code: int) -> None:
    if code:
        raise RuntimeError(f"the CUDA driver returned the error {code}")


def kept_ptx() -> str:
    """The kernel in PTX, from the folder of the numba engine's cache, or compiled and kept there
    if it can be written.
    """
    from jaxgran.dynamics.numba_engine.team.linking import ptx

    file = Path(f"{ffi.engine_folder()}.ptx")
    try:
        with file_lock(file):
            if not file.exists():
                with atomic_write(file) as temporary:
                    temporary.write_text(ptx())
            return file.read_text()
    except OSError:
        return ptx()


def words_of_memory(grains: int) -> int:
    """Words of eight bytes in which the kernel advances a replica."""
    from jaxgran.dynamics.numba_engine.team.memory import words_needed

    return words_needed(grains, layout.WARP)


@cache
def kernel() -> ctypes.c_void_p:
    """The kernel for all devices; the driver compiles it for each, and keeps that on disk."""
    library, handle = ctypes.c_void_p(), ctypes.c_void_p()
    code = kept_ptx().encode() + b"\0"
    _check(driver().cuInit(0))
    options, values = (ctypes.c_int * 1)(_MAX_REGISTERS), (ctypes.c_void_p * 1)(_REGISTERS)
    given = code, options, values, 1, None, None, 0
    _check(driver().cuLibraryLoadData(ctypes.byref(library), *given))
    _check(driver().cuLibraryGetKernel(ctypes.byref(handle), library, layout.KERNEL.encode()))
    return handle


def launch_on_stream(api: int, context: int, replicas: int, arguments: list[int]) -> None:
    """Launch a block of ``WARP`` threads for each replica on XLA's stream."""
    address, error = call_xla(api, _STREAM_GET, context, 0)
    if error:
        raise RuntimeError("XLA gives no stream")
    numbers = [ctypes.c_int64(x) for x in (*arguments, 8 * words_of_memory(arguments[0]))]
    pointers = (ctypes.c_void_p * len(numbers))(*map(ctypes.addressof, numbers))
    stream, owner = ctypes.c_void_p(address), ctypes.c_void_p()
    _check(driver().cuStreamGetCtx(stream, ctypes.byref(owner)))
    _check(driver().cuCtxPushCurrent_v2(owner))
    try:
        grid = replicas, 1, 1, layout.WARP, 1, 1, 0
        _check(driver().cuLaunchKernel(kernel(), *grid, stream, pointers, None))
    finally:
        driver().cuCtxPopCurrent_v2(ctypes.byref(owner))
