"""The engine for CUDA devices on this processor: its machine code with other barriers, one thread
of the operating system for each lane.
"""

import ctypes
import threading
from functools import cache
from typing import Any

import numpy as np
from llvmlite import binding as llvm

from jaxgran.dynamics.numba_engine import layout
from jaxgran.dynamics.numba_engine.team import linking
from jaxgran.dynamics.numba_engine.team.lanes import BARRIER, EXCHANGE, VOTE
from jaxgran.dynamics.numba_engine.team.memory import words_needed

_WORDS = 5 + linking.BUFFERS + 1
_NAMES = ", ".join(f"i64 %p{n}" for n in range(_WORDS))
_ENTRY = f"""
declare i32 @pthread_barrier_wait(ptr)
declare i32 @KERNEL(ptr, ptr, {", ".join(["i64"] * _WORDS)})
@barrier = global [64 x i8] zeroinitializer, align 16
@words = global [32 x i64] zeroinitializer, align 16
@votes = global i64 0
define ptr @team_barrier() {{
  ret ptr @barrier
}}
define void @{BARRIER}() alwaysinline {{
  WAIT
  ret void
}}
define i64 @{EXCHANGE}(i64 %lane, i64 %word, i64 %wanted) alwaysinline {{
  %own = getelementptr i64, ptr @words, i64 %lane
  %place = getelementptr i64, ptr @words, i64 %wanted
  store volatile i64 %word, ptr %own
  WAIT
  %other = load volatile i64, ptr %place
  WAIT
  ret i64 %other
}}
define i64 @{VOTE}(i64 %lane, i64 %agrees) alwaysinline {{
  %yes = icmp ne i64 %agrees, 0
  %one = zext i1 %yes to i64
  %bit = shl i64 %one, %lane
  %others = xor i64 %bit, -1
  %a = atomicrmw or ptr @votes, i64 %bit seq_cst
  WAIT
  %result = load atomic i64, ptr @votes seq_cst, align 8
  WAIT
  %b = atomicrmw and ptr @votes, i64 %others seq_cst
  ret i64 %result
}}
define void @{layout.KERNEL}({_NAMES}) {{
  %result = alloca i64
  %exception = alloca ptr
  call i32 @KERNEL(ptr %result, ptr %exception, {_NAMES})
  ret void
}}
"""
_WAIT = "call i32 @pthread_barrier_wait(ptr @barrier)"
_KEPT: list[Any] = []  # machine code


@cache
def _functions(together: bool) -> tuple[Any, Any]:
    """The kernel, with barriers between threads or without, and its barrier."""
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    target = llvm.Target.from_default_triple()
    machine = target.create_target_machine(
        cpu=llvm.get_host_cpu_name(),
        features=llvm.get_host_cpu_features().flatten(),
        opt=3,
        jit=True,
    )
    module = linking.linked(
        machine, _ENTRY.replace("WAIT", _WAIT if together else ""), "team_barrier"
    )
    engine = llvm.create_mcjit_compiler(module, machine)
    engine.finalize_object()
    _KEPT.append(engine)
    kernel = ctypes.CFUNCTYPE(None, *[ctypes.c_int64] * _WORDS)
    barrier = ctypes.CFUNCTYPE(ctypes.c_void_p)
    return (
        kernel(engine.get_function_address(layout.KERNEL)),
        barrier(engine.get_function_address("team_barrier"))(),
    )


def advance_replicas(
    replicas: int, grains: int, blocks: int, buffers: list[int], lanes: int = 1
) -> None:
    """Advance replicas one by one, from and to buffers at these addresses."""
    kernel, barrier = _functions(lanes > 1)
    memory = np.full(words_needed(grains, lanes), np.nan)
    for replica in range(replicas):

        def lane(n: int, replica: int = replica) -> None:
            kernel(n, lanes, replica, grains, blocks, *buffers, memory.ctypes.data)

        if lanes == 1:
            lane(0)
            continue
        library = ctypes.CDLL(None)
        assert library.pthread_barrier_init(ctypes.c_void_p(barrier), None, lanes) == 0
        threads = [threading.Thread(target=lane, args=(n,)) for n in range(lanes)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()


def advance(flow, solver, state, steps, begin, lanes: int = 1) -> tuple[np.ndarray, ...]:
    """Positions, velocities and blocks of one replica, as ``call_numba`` returns them."""
    inputs = layout.Inputs(
        state.side,
        flow.restitution,
        flow.timestep,
        flow.shear_rate,
        solver.tolerance,
        flow.activation,
        solver.max_steps,
    )
    steps = np.atleast_1d(np.asarray(steps, float))
    given = [
        np.ascontiguousarray(x, float)
        for x in (
            *(state.positions, state.velocities, state.grains.radii, state.grains.masses),
            *(np.array([float(x) for x in inputs]), steps, begin),
        )
    ]
    count = len(given[layout.RADII])
    out = [np.empty((count, 2)), np.empty((count, 2)), np.empty((steps.size, layout.RESULTS))]
    addresses = [x.ctypes.data for x in given + out]
    advance_replicas(1, count, steps.size, addresses, lanes)
    return tuple(out)
