"""A team: the lanes that advance one replica together.

On a CUDA device the lanes are the threads of a block. Each lane takes every ``lanes``-th element of
a loop, and the lanes meet at the barrier ``sync`` before one reads what another has written. The
barrier is an empty function here; ``linking`` replaces it. Sums over lanes are added in the order
of the lanes, so they have the same bits in every run.
"""

# pyright: reportCallIssue=false
# An intrinsic of numba is called without the context that it is defined with.

from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from jaxgran.dynamics.numba_engine.compilation import njit

BARRIER = "jaxgran_team_sync"


class Team(NamedTuple):
    """This lane, the number of lanes, and a whole and a real number of each lane, (lanes,)."""

    lane: Any
    lanes: Any
    whole: Any
    real: Any


@intrinsic
def sync(context):
    """Wait for all lanes."""

    def generate(context, builder, signature, arguments):
        kind = ir.FunctionType(ir.VoidType(), [])
        barrier: Any = cgutils.get_or_insert_function(builder.module, kind, BARRIER)
        if barrier.is_declaration:
            barrier.linkage = "weak"  # so that it is neither inlined nor kept when it is replaced
            for attribute in ("convergent", "noinline"):  # no lane may take another way to it
                barrier.attributes.add(attribute)
            ir.IRBuilder(barrier.append_basic_block()).ret_void()
        builder.call(barrier, [])
        return context.get_dummy_value()

    return types.none(), generate


@njit
def shared_out(team, count):
    """The indices below ``count`` that are this lane's."""
    return range(team.lane, np.uint64(count), team.lanes)


@njit
def least(team, number):
    """The least whole number of the lanes."""
    team.whole[team.lane] = number
    sync()
    result = team.whole[0]
    for n in range(team.lanes):
        result = min(result, team.whole[n])
    sync()
    return result


@njit
def before_and_total(team, number):
    """The sums of whole numbers over the lanes before this one, and over all."""
    team.whole[team.lane] = number
    sync()
    before = total = 0
    for n in range(team.lanes):
        before += team.whole[n] if n < team.lane else 0
        total += team.whole[n]
    sync()
    return before, total


@njit
def sum_of(team, number):
    """The sum of a real number over the lanes."""
    team.real[team.lane] = number
    sync()
    total = 0.0
    for n in range(team.lanes):
        total += team.real[n]
    sync()
    return total


@njit
def largest(team, number):
    """The largest real number of the lanes; infinite where one is infinite or NaN."""
    team.real[team.lane] = number
    sync()
    result, finite = team.real[0], True
    for n in range(team.lanes):
        result = max(result, team.real[n])
        finite &= team.real[n] < np.inf
    sync()
    return result if finite else np.inf
