"""From the source of the team's loop to machine code.

numba compiles the loop once to LLVM's language, and leaves it as it is: what it would do for this
processor is wrong for a device. An entry is linked to it that brings the barrier, what lanes
exchange, the mathematical functions for which every target has an instruction, and the kernel.
LLVM's backend for NVIDIA devices is part of llvmlite, on which numba depends, and the driver
assembles the PTX, so nothing else needs to be installed.
"""

import os
import subprocess
import sys
from functools import cache
from typing import Any

import numba
import numpy as np
from llvmlite import binding as llvm

from jaxgran.dynamics.numba_engine import layout
from jaxgran.dynamics.numba_engine.compilation import njit
from jaxgran.dynamics.numba_engine.team.lanes import BARRIER, EXCHANGE, VOTE, Team
from jaxgran.dynamics.numba_engine.team.loop import advance_team
from jaxgran.dynamics.numba_engine.team.memory import array_at, memory_at

BUFFERS = 10  # addresses of what a call is given and returns, without records
PROCESSOR = "sm_70"
_WORDS = 5 + BUFFERS + 1  # lane, lanes, replica, grains, blocks, the buffers, and memory
_FEATURES = "+ptx63"
_FUNCTIONS = ("sqrt", "floor", "ceil", "rint")  # of the mathematical library


def _kernel(
    lane, lanes, replica, grains, blocks, x, v, radii, masses, inputs, steps, begin, nx, nv, out, at
):
    """Advance a replica by one lane, with all arguments in words: numbers, and addresses of the
    buffers of all replicas and of the memory of this one.
    """
    memory, _ = memory_at(at, grains, lanes)
    of_grains, row = 8 * replica * grains, 8 * replica * layout.RESULTS
    team = Team(np.uint64(lane), np.uint64(lanes))
    advance_team(
        team,
        array_at(x + 2 * of_grains, (grains, 2), np.float64)[0],
        array_at(v + 2 * of_grains, (grains, 2), np.float64)[0],
        array_at(radii + of_grains, grains, np.float64)[0],
        array_at(masses + of_grains, grains, np.float64)[0],
        array_at(inputs + 8 * replica * layout.INPUT_NUMBERS, 1, layout.INPUTS)[0][0],
        array_at(steps + 8 * replica * blocks, blocks, np.float64)[0],
        array_at(begin + row, layout.RESULTS, np.float64)[0],
        array_at(nx + 2 * of_grains, (grains, 2), np.float64)[0],
        array_at(nv + 2 * of_grains, (grains, 2), np.float64)[0],
        array_at(out + row * blocks, (blocks, layout.RESULTS), np.float64)[0],
        memory,
    )
    return 0


def print_code() -> None:
    """Print the name of the kernel, and then the loop in LLVM's language before any pass."""
    config: Any = numba.config
    config.OPT = 0
    made = njit(_kernel)
    made.compile(numba.types.int64(*[numba.types.int64] * _WORDS))
    (code,), (kept,) = made.inspect_llvm().values(), made.overloads.values()
    print(kept.fndesc.mangled_name, code, sep="\n")


@cache
def numba_code() -> tuple[str, str]:
    """What ``print_code`` prints in a process of its own: numba would keep a gigabyte."""
    command = [sys.executable, "-c", f"from {__name__} import print_code; print_code()"]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    run = subprocess.run(command, capture_output=True, text=True, env=environment)
    if run.returncode:
        raise RuntimeError(f"numba does not compile the loop: {run.stderr.splitlines()[-1]}")
    name, _, code = run.stdout.partition("\n")
    return name, code


def linked(machine: llvm.TargetMachine, entry: str, *kept: str) -> llvm.ModuleRef:
    """The loop with an entry, optimised for a machine.

    Args:
      entry: a module in LLVM's language that defines the functions of ``lanes``, and calls
        ``@KERNEL``, whose arguments are the addresses of a result and an exception, and then the
        words of ``_kernel``.
      kept: names of its functions that are called from outside, beside ``layout.KERNEL``.
    """
    kernel, code = numba_code()
    module = llvm.parse_assembly(code)
    added = entry.replace("@KERNEL", f"@{kernel}")
    for function in _FUNCTIONS:
        added += _FORWARDED.replace("FUNCTION", function)
    module.triple = machine.triple
    module.data_layout = str(machine.target_data)
    other = llvm.parse_assembly(added)
    other.triple, other.data_layout = module.triple, module.data_layout
    module.link_in(other)
    for function in module.functions:
        if not function.is_declaration and function.name not in (layout.KERNEL, *kept):
            function.linkage = "internal"
    module.verify()
    options = llvm.create_pipeline_tuning_options(speed_level=3)
    passes = llvm.create_pass_builder(machine, options)
    passes.getModulePassManager().run(module, passes)
    return module


_FORWARDED = """
declare double @llvm.FUNCTION.f64(double)
define double @FUNCTION(double %x) alwaysinline {
  %y = call double @llvm.FUNCTION.f64(double %x)
  ret double %y
}
"""
# Grains, blocks, the addresses of the buffers, and that of the memory of all replicas
_PARAMETERS = ", ".join(f"i64 %p{n}" for n in range(_WORDS - 3))
_MEMORY = f"%p{_WORDS - 4}"
_ON_DEVICE = f"""
declare void @llvm.nvvm.bar.warp.sync(i32) convergent
declare i32 @llvm.nvvm.shfl.sync.idx.i32(i32, i32, i32, i32) convergent
declare i32 @llvm.nvvm.vote.ballot.sync(i32, i1) convergent
declare i32 @llvm.nvvm.read.ptx.sreg.tid.x()
declare i32 @llvm.nvvm.read.ptx.sreg.ctaid.x()
declare i32 @KERNEL(ptr, ptr, {", ".join(["i64"] * _WORDS)}) convergent
define void @{BARRIER}() convergent alwaysinline {{
  call void @llvm.nvvm.bar.warp.sync(i32 -1)
  ret void
}}
define i64 @{EXCHANGE}(i64 %lane, i64 %word, i64 %wanted) convergent alwaysinline {{
  %from = trunc i64 %wanted to i32
  %halves = bitcast i64 %word to <2 x i32>
  %low = extractelement <2 x i32> %halves, i32 0
  %high = extractelement <2 x i32> %halves, i32 1
  %a = call i32 @llvm.nvvm.shfl.sync.idx.i32(i32 -1, i32 %low, i32 %from, i32 31)
  %b = call i32 @llvm.nvvm.shfl.sync.idx.i32(i32 -1, i32 %high, i32 %from, i32 31)
  %c = insertelement <2 x i32> %halves, i32 %a, i32 0
  %d = insertelement <2 x i32> %c, i32 %b, i32 1
  %other = bitcast <2 x i32> %d to i64
  ret i64 %other
}}
define i64 @{VOTE}(i64 %lane, i64 %agrees) convergent alwaysinline {{
  %yes = icmp ne i64 %agrees, 0
  %votes = call i32 @llvm.nvvm.vote.ballot.sync(i32 -1, i1 %yes)
  %word = zext i32 %votes to i64
  ret i64 %word
}}
define ptx_kernel void @{layout.KERNEL}({_PARAMETERS}, i64 %size) convergent {{
  %result = alloca i64
  %exception = alloca ptr
  %thread = call i32 @llvm.nvvm.read.ptx.sreg.tid.x()
  %block = call i32 @llvm.nvvm.read.ptx.sreg.ctaid.x()
  %lane = zext i32 %thread to i64
  %replica = zext i32 %block to i64
  %offset = mul i64 %replica, %size
  %memory = add i64 {_MEMORY}, %offset
  call i32 @KERNEL(ptr %result, ptr %exception, i64 %lane, i64 {layout.WARP}, i64 %replica,
    {_PARAMETERS.replace(_MEMORY, "%memory")})
  ret void
}}
"""


@cache
def ptx() -> str:
    """The kernel in PTX, for all NVIDIA devices from ``PROCESSOR`` on: grains, blocks, addresses,
    and the memory of all replicas and of one of them.
    """
    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    target = llvm.Target.from_triple("nvptx64-nvidia-cuda")
    machine = target.create_target_machine(cpu=PROCESSOR, features=_FEATURES, opt=3)
    return machine.emit_assembly(linked(machine, _ON_DEVICE))
