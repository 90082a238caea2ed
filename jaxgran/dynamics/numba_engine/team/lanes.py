"""A team: the lanes that advance one replica together.

On a CUDA device the lanes are the threads of a warp. Each lane takes every ``lanes``-th element of
a loop, and the lanes meet at the barrier ``sync`` before one reads what another has written.
Numbers of other lanes come without memory: ``of_lane`` and ``ballot`` are what a warp can do at
once. Alone they order nothing that is in memory. These three are functions of one lane here;
``linking`` replaces them. Sums over lanes are added in the same order in every run, and have the
same bits in all lanes.
"""

# pyright: reportCallIssue=false
# An intrinsic of numba is called without the context that it is defined with.

from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from jaxgran.dynamics.numba_engine.compilation import njit, njit_plain

# Functions that a target defines: nothing; a word of this lane, and the lane whose word is wanted;
# whether this lane agrees. Each but the first is given the number of this lane first.
BARRIER, EXCHANGE, VOTE = "jaxgran_team_sync", "jaxgran_team_exchange", "jaxgran_team_vote"
_WORD = ir.IntType(64)


class Team(NamedTuple):
    """This lane, and the number of lanes, a power of two up to 32; both without a sign."""

    lane: Any
    lanes: Any


def _call(builder: ir.IRBuilder, name: str, *words: Any) -> Any:
    """Call a function of the target, which returns its second word for a team of one lane."""
    result = _WORD if words else ir.VoidType()
    kind = ir.FunctionType(result, [_WORD] * len(words))
    function: Any = cgutils.get_or_insert_function(builder.module, kind, name)
    if function.is_declaration:
        function.linkage = "weak"  # so that it is neither inlined nor kept when it is replaced
        for attribute in ("convergent", "noinline"):  # no lane may take another way to it
            function.attributes.add(attribute)
        body = ir.IRBuilder(function.append_basic_block())
        body.ret(function.args[1]) if words else body.ret_void()
    return builder.call(function, words)


@intrinsic
def sync(context):
    """Wait for all lanes."""

    def generate(context, builder, signature, arguments):
        _call(builder, BARRIER)
        return context.get_dummy_value()

    return types.none(), generate


@intrinsic
def _exchange(context, own, number, lane):
    def generate(context, builder, signature, arguments):
        kind = context.get_value_type(number)
        word = builder.bitcast(arguments[1], _WORD)
        return builder.bitcast(_call(builder, EXCHANGE, arguments[0], word, arguments[2]), kind)

    return number(types.uint64, number, types.uint64), generate


@intrinsic
def _vote(context, own, agrees):
    def generate(context, builder, signature, arguments):
        return _call(builder, VOTE, *arguments)

    return types.uint64(types.uint64, types.uint64), generate


@intrinsic
def bits_of(context, word):
    """How many bits of a word are set."""

    def generate(context, builder, signature, arguments):
        return builder.ctpop(arguments[0])

    return types.int64(types.uint64), generate


@njit_plain
def plain_sum(one, other):
    """A sum that is not fused with a product before it: lanes that add each other's numbers must
    find the same bits.
    """
    return one + other


@njit
def of_lane(team, number, lane):
    """A number, of eight bytes, of another lane; all lanes must ask, each the one that it wants."""
    return _exchange(team.lane, number, np.uint64(lane))


@njit
def ballot(team, agrees):
    """A word with the bits of the lanes that agree."""
    return _vote(team.lane, np.uint64(agrees))


@njit
def lower_lanes(team):
    """A word with the bits of the lanes before this one."""
    return (np.uint64(1) << team.lane) - np.uint64(1)


@njit
def shared_out(team, count):
    """The indices below ``count`` that are this lane's."""
    return range(team.lane, np.uint64(count), team.lanes)


@njit
def in_turns(team, count):
    """The first index of each turn, in which every lane has the index after the one of the lane
    before.
    """
    return range(np.uint64(0), np.uint64(count), team.lanes)


@njit
def own_index(team, first, count):
    """This lane's index in a turn, and whether it is below ``count``."""
    n = first + team.lane
    return n, n < np.uint64(count)


@njit
def lanes_in_turn(team, first, count):
    """How many lanes have an index below ``count`` in a turn."""
    return min(team.lanes, np.uint64(count) - first)


@njit
def place_in_list(team, wanted, count):
    """Where this lane writes into a list that has ``count`` elements, if it wants to; and how many
    it has when all lanes have written.
    """
    all_wanted = ballot(team, wanted)
    return count + bits_of(all_wanted & lower_lanes(team)), count + bits_of(all_wanted)


@njit
def _combined(team, number, combine):
    """The numbers of all lanes, combined in pairs, then in pairs of pairs: with the same bits in
    every lane, if ``combine`` does not mind the order of its two.
    """
    step = team.lanes >> np.uint64(1)
    while step > 0:
        number = combine(number, of_lane(team, number, team.lane ^ step))
        step >>= np.uint64(1)
    return number


@njit
def least(team, number):
    """The least whole number of the lanes."""
    return _combined(team, number, min)


@njit
def before_and_total(team, number):
    """The sums of whole numbers over the lanes before this one, and over all."""
    up_to, step, last = number, np.uint64(1), team.lanes - np.uint64(1)
    while step < team.lanes:
        other = of_lane(team, up_to, (team.lane + team.lanes - step) & last)
        up_to += other if team.lane >= step else 0
        step <<= np.uint64(1)
    return up_to - number, of_lane(team, up_to, last)


@njit
def sum_of(team, number):
    """The sum of a real number over the lanes."""
    return _combined(team, number, plain_sum)


@njit
def largest(team, number):
    """The largest real number of the lanes; infinite where one is infinite or NaN."""
    return _combined(team, number if number < np.inf else np.inf, max)
