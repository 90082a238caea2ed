"""The calendar of pairs: in which steps each near pair will be a contact, as long as neither grain is struck.

Between two impulses both grains of a pair fly freely, so these steps follow from a quadratic equation. The next step to
visit is the smallest entry, and its contacts follow from comparisons of whole numbers.
"""

import math

import numpy as np

from jaxgran.dynamics.numba_engine.compilation import LAW, inline_njit
from jaxgran.dynamics.numba_engine.layout import (
    ACROSS,
    BEGINS,
    ENDS,
    FIRST,
    LANES,
    MANY,
    NEVER,
    RADIUS,
    ROW,
    SECOND,
    STRIKES,
    VX,
    VY,
    X,
    Y,
)

gap_coefficients, gap_discriminant = LAW["gap_coefficients"], LAW["gap_discriminant"]
touching_time, first_step = LAW["touching_time"], LAW["first_step"]

_NEVER = float(NEVER)
_TOGETHER = 8  # pairs whose steps are computed together


@inline_njit
def pair_motion(p, t, flow, grains, pairs):
    """Both grains of a pair, its separation at the time t since the search, and its relative velocity."""
    motion, images = grains.motion, pairs.images
    i, j = pairs.ends[FIRST, p], pairs.ends[SECOND, p]
    up = images[ROW, p] * flow.side
    ux, uy = motion[i, VX] - motion[j, VX] - flow.rate * up, motion[i, VY] - motion[j, VY]
    dx = motion[i, X] - motion[j, X] - images[ACROSS, p] + ux * t
    dy = motion[i, Y] - motion[j, Y] - up + uy * t
    return i, j, dx, dy, ux, uy


@inline_njit
def predict_contact_steps(count, t, earliest, horizon, flow, grains, pairs):
    """Write when, from the step ``earliest`` on, the listed pairs are contacts if their grains are not struck.

    ``t`` is the present time, and ``horizon`` the time from now after which the list is no longer valid. Pairs are
    taken in blocks, and the arithmetic has no branches, so that a processor vectorises it.
    """
    listed, calendar, flights, entries = pairs.listed, pairs.calendar, pairs.flights, pairs.entries
    for start in range(0, count, LANES):
        size = min(LANES, count - start)
        for n in range(size):
            i, j, dx, dy, ux, uy = pair_motion(listed[start + n], t, flow, grains, pairs)
            flights[0, n], flights[1, n], flights[2, n], flights[3, n] = dx, dy, ux, uy
            flights[4, n] = grains.constants[i, RADIUS] + grains.constants[j, RADIUS]
        for n in range((size + _TOGETHER - 1) // _TOGETHER * _TOGETHER):
            strikes, begins, ends = _contact_steps(
                flights[0, n], flights[1, n], flights[2, n], flights[3, n], flights[4, n], t, earliest, horizon, flow
            )
            entries[STRIKES, n], entries[BEGINS, n], entries[ENDS, n] = strikes, begins, ends
        for n in range(size):
            p = listed[start + n]
            calendar[STRIKES, p], calendar[BEGINS, p] = entries[STRIKES, n], entries[BEGINS, n]
            calendar[ENDS, p] = entries[ENDS, n]


@inline_njit
def _contact_steps(dx, dy, ux, uy, reach, t, earliest, horizon, flow):
    """The entries of the calendar of a pair."""
    dt, theta = flow.dt, flow.theta
    speed, closing, excess = gap_coefficients(dx, dy, ux, uy, reach)
    discriminant = gap_discriminant(speed, closing, excess)
    root, per_speed = math.sqrt(discriminant if discriminant > 0.0 else 0.0), 1 / speed
    turn = _as_step(first_step(t - closing * per_speed, dt, 0.0))  # the first step in which the pair recedes
    enter = touching_time(closing, excess, root) if closing < 0.0 else -(root + closing) * per_speed
    begin = _as_step(first_step(t + enter, dt, theta))
    begin = begin if begin > earliest else earliest
    last = _as_step(np.floor((t + (root - closing) * per_speed) / dt - theta))
    last = last if last > turn - 1 else turn - 1
    late = (excess > 0.0) & (excess + 2 * closing * horizon > 0.0)  # the gap does not close while the list is valid
    meets = (discriminant >= 0.0) & (begin <= last) & (begin < MANY) & (speed != 0.0)
    rests = (speed == 0.0) & (excess <= 0.0)
    begin = begin if meets else (earliest if rests else _NEVER)
    last = last if meets else (_NEVER - 1 if rests else -1.0)
    strikes = meets & (begin < turn) & (not late)
    return (
        np.int32(begin if strikes else _NEVER),
        np.int32(_NEVER if late else begin),
        np.int32(-1.0 if late else last),
    )


@inline_njit
def _as_step(number):
    """A number as a step of the calendar: -1 if it is past or NaN, and at most the last step."""
    number = number if number > -1.0 else -1.0
    return number if number < MANY else MANY


@inline_njit
def clear_calendar(found, pairs):
    """Pad the calendar behind the pairs found to whole ``LANES``; returns the number of these blocks."""
    blocks = (found + LANES - 1) // LANES
    for p in range(found, blocks * LANES):
        pairs.calendar[STRIKES, p], pairs.calendar[BEGINS, p], pairs.calendar[ENDS, p] = NEVER, NEVER, -1
    return blocks


@inline_njit
def next_contact_step(blocks, pairs):
    """The next step in which some contact approaches."""
    calendar = pairs.calendar
    strike = NEVER
    for p in range(blocks * LANES):
        strike = min(strike, calendar[STRIKES, p])
    return strike


@inline_njit
def contacts_of_step(k, blocks, pairs, met):
    """Write the pairs that are contacts in a step; those beyond the room are counted, not written."""
    calendar = pairs.calendar
    contacts, now = 0, np.int32(k)
    for block in range(blocks):
        inside = 0
        for p in range(block * LANES, (block + 1) * LANES):
            inside += (calendar[BEGINS, p] <= now) & (now <= calendar[ENDS, p])
        if inside > 0:
            for p in range(block * LANES, (block + 1) * LANES):
                if calendar[BEGINS, p] <= now and now <= calendar[ENDS, p]:
                    if contacts < met.size:
                        met[contacts] = p
                    contacts += 1
    return contacts
