"""The contacts of one step, solved by a team: ``numba_engine.collisions`` with the contacts sorted
by colour.

Contacts of one colour share no grain, so the lanes relax them at once, and a sweep passes over the
colours one by one. Isolated pairs have a closed form. All other contacts are solved together, to
the residual that is permitted for all of them.
"""

# pyright: reportCallIssue=false

import math

import numpy as np
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from jaxgran.dynamics.numba_engine.cluster_solver import (
    RELAXATION,
    SWEEPS,
    add_impulse,
    descend,
    error_of,
    is_jammed,
    relax,
    status_of,
    take_contact,
)
from jaxgran.dynamics.numba_engine.collisions import strike_grain
from jaxgran.dynamics.numba_engine.compilation import LAW, njit
from jaxgran.dynamics.numba_engine.layout import (
    APPROACH,
    EPSILON,
    FIRST,
    IMPULSE,
    NX,
    NY,
    OK,
    SECOND,
)
from jaxgran.dynamics.numba_engine.network import write_contact
from jaxgran.dynamics.numba_engine.sums import FIRST_TERM, LARGEST_OVERLAP, add_solve, terms_of
from jaxgran.dynamics.numba_engine.team.lanes import (
    ballot,
    before_and_total,
    in_turns,
    lanes_in_turn,
    largest,
    lower_lanes,
    of_lane,
    own_index,
    place_in_list,
    shared_out,
    sum_of,
    sync,
)
from jaxgran.dynamics.numba_engine.team.memory import MOST_COLOURS

residual_target, relative_residual = LAW["residual_target"], LAW["relative_residual"]
_LAST_COLOUR = np.uint32(1 << MOST_COLOURS - 1)


@intrinsic
def _add_terms(context, sums, first, terms):
    """Add the numbers of a tuple to those of an array from a place on.

    An index into a tuple that is known at run time only would have a way to an error, and lanes
    that may leave a loop do not meet again before its end.
    """

    def generate(context, builder, signature, arguments):
        kind, _, numbers = signature.args
        array = context.make_array(kind)(context, builder, arguments[0])
        place = builder.gep(array.data, [arguments[1]])
        for n in range(len(numbers)):
            here = builder.gep(place, [cgutils.intp_t(n)])
            term = builder.extract_value(arguments[2], n)
            total = builder.fadd(builder.load(here), term, flags=("contract",))
            builder.store(total, here)
        return context.get_dummy_value()

    return types.none(sums, types.intp, terms), generate


@njit
def collide(team, contacts, t, flow, grains, pairs, network, clusters, sums):
    """Solve the contacts of a step and add them to the sums; returns how many approach, and the
    status. The impulses on the grains are in ``network.impulses``.
    """
    impulses, own_scale, own_approaching = network.impulses, 0.0, 0
    for c in shared_out(team, contacts):
        overlap, squared_approach = write_contact(c, t, flow, grains, pairs, network)
        sums[LARGEST_OVERLAP] = max(sums[LARGEST_OVERLAP], overlap)
        own_scale += squared_approach
        own_approaching += network.rows[APPROACH, c] < 0.0
        for end in range(2):
            g = network.ends[end, c]
            impulses[g, 0] = impulses[g, 1] = 0.0
    _, approaching = before_and_total(team, own_approaching)
    most, all_coloured = _colour(team, contacts, network)
    coupled = _isolate_and_sort(team, contacts, most, grains, network, clusters)
    iterations, residual, status = 1, 0.0, OK
    if coupled > 0:
        scale = math.sqrt(sum_of(team, own_scale))
        target = residual_target(scale, flow.tolerance, flow.shear_rate, EPSILON)
        iterations, squared_residual, status = _solve(
            team, coupled, most, all_coloured, target * target, flow, grains, network, clusters
        )
        residual = relative_residual(math.sqrt(squared_residual), scale, target)
    for g in shared_out(team, impulses.shape[0]):
        if network.colours[g] != 0:  # from changes of velocity at restitution zero
            for axis in range(2):
                impulses[g, axis] *= flow.one_plus_alpha / grains.constants[g].inverse_mass
    sync()
    if team.lane == 0:
        add_solve(sums, iterations, residual, status, 0.0)
    for c in shared_out(team, contacts):
        _add_terms(sums, FIRST_TERM, terms_of(c, flow.one_plus_alpha, grains, network))
    return approaching, status


@njit
def _colour(team, contacts, network):
    """Give every contact the lowest colour that neither of its grains has, in the order of the
    contacts; returns the number of colours, and whether they were enough.

    Of the contacts that the lanes have at once, one waits for those of lower lanes that share a
    grain with it.
    """
    colours, colour, ends = network.colours, network.colour, network.ends
    own_colours, enough = np.uint32(0), True
    for first in in_turns(team, contacts):
        c, here = own_index(team, first, contacts)
        i, j = (ends[FIRST, c], ends[SECOND, c]) if here else (np.uint32(0), np.uint32(0))
        both, before = np.uint64(i) << np.uint64(32) | np.uint64(j), np.uint64(0)
        for n in range(lanes_in_turn(team, first, contacts)):
            other = of_lane(team, both, n)
            other_i, other_j = np.uint32(other >> np.uint64(32)), np.uint32(other)
            shares = (i == other_i) | (i == other_j) | (j == other_i) | (j == other_j)
            before |= np.uint64(shares) << n
        before &= lower_lanes(team)
        waiting = ballot(team, here)
        while waiting != 0:
            ready = here and before & waiting == 0
            if ready:
                taken = colours[i] | colours[j]
                bit = np.uint32(~taken & (taken + np.uint32(1)))
                if bit == 0 or bit == _LAST_COLOUR:
                    bit, enough = _LAST_COLOUR, False
                colours[i], colours[j], colour[c] = colours[i] | bit, colours[j] | bit, bit
                own_colours |= bit
                here = False
            waiting &= ~ballot(team, ready)
            sync()
    most = 0
    while most < MOST_COLOURS and ballot(team, own_colours >> np.uint32(most) > 0) > 0:
        most += 1
    return most, ballot(team, not enough) == 0


@njit
def _isolate_and_sort(team, contacts, most, grains, network, clusters):
    """Solve the isolated pairs, and sort the other contacts by colour; returns their number."""
    ends, rows, loaded, colours = network.ends, network.rows, network.loaded, network.colours
    constants, dv, one = grains.constants, clusters.dv, np.uint32(1)
    for c in shared_out(team, contacts):
        i, j = ends[FIRST, c], ends[SECOND, c]
        if colours[i] & (colours[i] - one) == 0 and colours[j] & (colours[j] - one) == 0:
            mi, mj = constants[i].inverse_mass, constants[j].inverse_mass
            impulse = max(0.0, -rows[APPROACH, c]) / (mi + mj)
            rows[IMPULSE, c], network.colour[c] = impulse, 0
            loaded[i] = loaded[j] = 1 if impulse > 0.0 else 0
            dv[i, 0], dv[i, 1] = impulse * mi * rows[NX, c], impulse * mi * rows[NY, c]
            dv[j, 0], dv[j, 1] = -impulse * mj * rows[NX, c], -impulse * mj * rows[NY, c]
    coupled = 0
    for n in range(most if most > 1 else 0):
        if team.lane == 0:
            clusters.starts[n] = coupled
        bit = np.uint32(1) << np.uint32(n)
        for first in in_turns(team, contacts):
            c, here = own_index(team, first, contacts)
            wanted = here and network.colour[c] == bit
            place, coupled = place_in_list(team, wanted, coupled)
            if wanted:
                clusters.source[place] = c
    if team.lane == 0:
        clusters.starts[most] = coupled
    sync()
    return coupled


@njit
def _share_of(team, begin, end, all_coloured):
    """This lane's first contact of a colour, the end, and the stride; all contacts are the first
    lane's where colours did not suffice.
    """
    begin, end = np.uint64(begin), np.uint64(end)
    if all_coloured:
        return begin + team.lane, end, team.lanes
    return begin if team.lane == 0 else end, end, np.uint64(1)


@njit
def _solve(team, size, most, all_coloured, target, flow, grains, network, clusters):
    """Write the impulses at restitution zero of contacts sorted by colour, and the changes of
    velocity; returns the iterations, the squared residual and a status, as
    ``numba_engine.cluster_solver.solve_cluster`` does.
    """
    rows, ends, dv, starts = clusters.rows, clusters.ends, clusters.dv, clusters.starts
    for n in shared_out(team, size):
        take_contact(n, clusters.source[n], grains, network, clusters)
    sync()
    relaxation = RELAXATION[min(size, RELAXATION.size - 1)]
    sweeps, squared_residual, keep_going = 0, math.inf, True
    while keep_going:
        own_estimate = 0.0
        for colour in range(most):
            n, end, stride = _share_of(team, starts[colour], starts[colour + 1], all_coloured)
            while n < end:
                change = relax(n, relaxation, rows, ends, dv)
                own_estimate += change * change
                n += stride
            sync()
        sweeps += 1
        estimate = sum_of(team, own_estimate)
        keep_going = sweeps < min(flow.max_steps, SWEEPS) and estimate < math.inf
        if estimate <= target * relaxation * relaxation or not keep_going:
            own_error = 0.0
            for n in shared_out(team, size):
                error = error_of(n, rows, ends, dv)
                own_error += error * error
            sync()
            squared_residual = sum_of(team, own_error)
            keep_going = keep_going and not squared_residual <= target
    status = OK
    if not squared_residual <= target:
        sweeps, squared_residual, status = _go_on(
            team, size, target, sweeps, squared_residual, flow.max_steps, clusters
        )
    for colour in range(most):
        n, end, stride = _share_of(team, starts[colour], starts[colour + 1], all_coloured)
        while n < end:
            if rows[n].impulse > 0.0:
                network.loaded[ends[n, FIRST]] += 1
                network.loaded[ends[n, SECOND]] += 1
            n += stride
        sync()
    for n in shared_out(team, size):
        network.rows[IMPULSE, clusters.source[n]] = rows[n].impulse
    return sweeps, squared_residual, status


@njit
def _go_on(team, size, target, sweeps, squared_residual, max_steps, clusters):
    """The method of Barzilai and Borwein, by the first lane, where the sweeps are slow; returns
    iterations, squared residual and status.
    """
    rows, ends, dv = clusters.rows, clusters.ends, clusters.dv
    jammed = False
    if team.lane == 0:
        jammed = is_jammed(size, clusters)
        if squared_residual < math.inf and sweeps < max_steps:
            more, squared_residual = descend(size, target, max_steps - sweeps, clusters)
            jammed = is_jammed(size, clusters)
            sweeps += more
            for n in range(size):
                rows[n].impulse = clusters.iterate[n].best
                for end in range(2):
                    dv[ends[n, end], 0] = dv[ends[n, end], 1] = 0.0
            for n in range(size):
                add_impulse(n, rows, ends, dv)
    sync()
    squared_residual = of_lane(team, squared_residual, 0)
    jammed = ballot(team, jammed) > 0
    return of_lane(team, sweeps, 0), squared_residual, status_of(squared_residual, target, jammed)


@njit
def strike(team, t, flow, grains, network, kinetic, max_speed):
    """Change the velocities of the grains with contacts; returns this lane's Σ m c ⊗ c, and the
    largest speed of the flow.
    """
    own_speed = max_speed
    for g in shared_out(team, grains.motion.size):
        if network.colours[g] != 0:
            network.colours[g] = 0
            if network.loaded[g] > 0:
                kinetic, speed = strike_grain(
                    g, t, flow.shear_rate, grains, network.impulses, kinetic
                )
                own_speed = max(own_speed, speed) if speed < math.inf else math.inf
    return kinetic, largest(team, own_speed)
