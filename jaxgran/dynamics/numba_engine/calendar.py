"""The calendar of pairs: in which steps each near pair will be a contact, as long as neither grain
is struck.

Between two impulses both grains of a pair fly freely, so these steps follow from a quadratic
equation. The next step to visit is the smallest entry, and its contacts follow from comparisons of
whole numbers. Where an event has few contacts among many pairs, lower bounds of the entries of each
block say which blocks need to be looked at.
"""

import math

import numpy as np

from jaxgran.dynamics.numba_engine.compilation import LAW, njit
from jaxgran.dynamics.numba_engine.layout import (
    BEGINS,
    ENDS,
    FIRST,
    IMAGE_ROW,
    IMAGE_X,
    LANES,
    LEAST_SHIFT,
    MANY,
    NEVER,
    SECOND,
    STRIKES,
)

gap_coefficients, gap_discriminant = LAW["gap_coefficients"], LAW["gap_discriminant"]
touching_time, first_step = LAW["touching_time"], LAW["first_step"]

_NEVER = float(NEVER)
_TOGETHER = 8  # pairs whose steps are computed together
_ENTRIES_A_CONTACT = 900  # passed over in the time in which one contact renews the bounds of blocks
_ROW, _ROW_SHIFT = 16, 4  # bounds that are compared together


@njit
def pair_motion(p, t, flow, grains, pairs):
    """Both grains of a pair, its separation at the time t since the search, and its relative
    velocity.
    """
    motion, images = grains.motion, pairs.images
    i, j = pairs.ends[FIRST, p], pairs.ends[SECOND, p]
    up = images[IMAGE_ROW, p] * flow.side
    ux, uy = motion[i].vx - motion[j].vx - flow.shear_rate * up, motion[i].vy - motion[j].vy
    dx = motion[i].x - motion[j].x - images[IMAGE_X, p] + ux * t
    dy = motion[i].y - motion[j].y - up + uy * t
    return i, j, dx, dy, ux, uy


@njit
def predict_contact_steps(count, t, earliest, horizon, shift, flow, grains, pairs):
    """Write when, from the step ``earliest`` on, the listed pairs are contacts if their grains are
    not struck.

    ``t`` is the present time, and ``horizon`` the time from now after which the list is no longer
    valid. The bounds of blocks of ``2**shift`` entries are lowered where there are any. Pairs are
    taken together, and the arithmetic has no branches, so that a processor vectorises it.
    """
    listed, calendar, bounds = pairs.listed, pairs.calendar, pairs.bounds
    flights, entries = pairs.flights, pairs.entries
    for start in range(0, count, LANES):
        size = min(LANES, count - start)
        for n in range(size):
            i, j, dx, dy, ux, uy = pair_motion(listed[start + n], t, flow, grains, pairs)
            flights[0, n], flights[1, n], flights[2, n], flights[3, n] = dx, dy, ux, uy
            flights[4, n] = grains.constants[i].radius + grains.constants[j].radius
        for n in range((size + _TOGETHER - 1) // _TOGETHER * _TOGETHER):
            strikes, begins, ends = contact_steps(
                flights[0, n],
                flights[1, n],
                flights[2, n],
                flights[3, n],
                flights[4, n],
                t,
                earliest,
                horizon,
                flow,
            )
            entries[STRIKES, n], entries[BEGINS, n], entries[ENDS, n] = strikes, begins, ends
        for n in range(size):
            p = listed[start + n]
            calendar[STRIKES, p], calendar[BEGINS, p] = entries[STRIKES, n], entries[BEGINS, n]
            calendar[ENDS, p] = entries[ENDS, n]
            if shift > 0:
                b = p >> np.uint32(shift)
                bounds[STRIKES, b] = min(bounds[STRIKES, b], entries[STRIKES, n])
                bounds[BEGINS, b] = min(bounds[BEGINS, b], entries[BEGINS, n])


@njit
def contact_steps(dx, dy, ux, uy, reach, t, earliest, horizon, flow):
    """The entries of the calendar of a pair: the step in which it strikes, and the first and last
    step in which it is a contact.
    """
    dt, theta = flow.timestep, flow.activation
    squared_speed, closing, excess = gap_coefficients(dx, dy, ux, uy, reach)
    discriminant = gap_discriminant(squared_speed, closing, excess)
    root = math.sqrt(discriminant if discriminant > 0.0 else 0.0)
    per_squared_speed = 1 / squared_speed
    recedes_from = _as_step(first_step(t - closing * per_squared_speed, dt, 0.0))
    enter = (
        touching_time(closing, excess, root)
        if closing < 0.0
        else -(root + closing) * per_squared_speed
    )
    begin = _as_step(first_step(t + enter, dt, theta))
    begin = begin if begin > earliest else earliest
    last = _as_step(np.floor((t + (root - closing) * per_squared_speed) / dt - theta))
    last = last if last > recedes_from - 1 else recedes_from - 1
    # the gap does not close while the list is valid
    after_list = (excess > 0.0) & (excess + 2 * closing * horizon > 0.0)
    touches = (discriminant >= 0.0) & (begin <= last) & (begin < MANY) & (squared_speed != 0.0)
    in_contact = (squared_speed == 0.0) & (excess <= 0.0)
    begin = begin if touches else (earliest if in_contact else _NEVER)
    last = last if touches else (_NEVER - 1 if in_contact else -1.0)
    strikes = touches & (begin < recedes_from) & (not after_list)
    return (
        np.int32(begin if strikes else _NEVER),
        np.int32(_NEVER if after_list else begin),
        np.int32(-1.0 if after_list else last),
    )


@njit
def _as_step(number):
    """A number as a step of the calendar: -1 if it is past or NaN, and at most the last step."""
    number = number if number > -1.0 else -1.0
    return number if number < MANY else MANY


@njit
def clear_calendar(pair_count, pairs):
    """Pad the calendar to whole ``LANES``; returns the number of its entries."""
    entries = (pair_count + LANES - 1) // LANES * LANES
    for p in range(pair_count, entries):
        pairs.calendar[STRIKES, p] = pairs.calendar[BEGINS, p] = NEVER
        pairs.calendar[ENDS, p] = -1
    return entries


@njit
def choose_blocks(entries, steps, pairs):
    """The size of a block as a power of two, or 0 where it costs less to pass over all entries at
    each event.

    An event passes over the bounds of all blocks, and each contact over the entries of two or three
    blocks. How many contacts an event has follows from the strikes within the steps that the list
    will last.
    """
    strikes = 0
    for p in range(entries):
        strikes += pairs.calendar[STRIKES, p] < NEVER
    contacts = max(strikes / steps, 1.0)
    if entries < _ENTRIES_A_CONTACT * contacts:
        return 0
    shift = LEAST_SHIFT
    while contacts * 4.0**shift < entries / 2:
        shift += 1
    return shift


@njit
def _pairs_of_block(b, entries, shift):
    """The first pair of a block, unsigned so that loops over pairs vectorise, and the number of its
    pairs.
    """
    first = min(b << shift, entries)
    return np.uint64(first), min(1 << shift, entries - first)


@njit
def bound_blocks(entries, shift, pairs):
    """Write the least strike and the least begin of each block; the bounds are padded to whole
    rows.
    """
    calendar, bounds = pairs.calendar, pairs.bounds
    for b in range((_last_row(entries, shift) + 1) * _ROW):
        first, size = _pairs_of_block(b, entries, shift)
        strike, begin = NEVER, NEVER
        for n in range(size):
            p = first + np.uint64(n)
            strike = min(strike, calendar[STRIKES, p])
            begin = min(begin, calendar[BEGINS, p])
        bounds[STRIKES, b], bounds[BEGINS, b] = strike, begin


@njit
def _last_row(entries, shift):
    """The last row of ``_ROW`` bounds."""
    return (entries - 1) >> (shift + _ROW_SHIFT)


@njit
def next_contact_step(entries, shift, pairs):
    """The next step in which some contact approaches."""
    if shift > 0:
        return _next_by_blocks(entries, shift, pairs)
    calendar = pairs.calendar
    strike = NEVER
    for p in range(entries // LANES * LANES):
        strike = min(strike, calendar[STRIKES, p])
    return strike


@njit
def _next_by_blocks(entries, shift, pairs):
    """The same by the bounds of blocks: the least bound that is the strike of a pair; lower ones
    are renewed.
    """
    calendar, bounds = pairs.calendar, pairs.bounds
    rows = _last_row(entries, shift) + 1
    while True:
        least = NEVER
        for b in range(rows * _ROW):
            least = min(least, bounds[STRIKES, b])
        if least == NEVER:
            return least
        for row in range(rows):
            matches = 0
            for b in range(row * _ROW, (row + 1) * _ROW):
                matches += bounds[STRIKES, b] == least
            if matches > 0:
                for b in range(row * _ROW, (row + 1) * _ROW):
                    if bounds[STRIKES, b] == least:
                        first, size = _pairs_of_block(b, entries, shift)
                        strike = NEVER
                        for n in range(size):
                            strike = min(strike, calendar[STRIKES, first + np.uint64(n)])
                        bounds[STRIKES, b] = strike
                        if strike == least:
                            return least


@njit
def contacts_of_step(k, entries, shift, pairs, near_pair):
    """Write the pairs that are contacts in a step; those beyond the room are counted, not written.

    After the step, the entries of those that approach are written anew.
    """
    if shift > 0:
        return _contacts_by_blocks(k, entries, shift, pairs, near_pair)
    calendar = pairs.calendar
    contacts, now = 0, np.int32(k)
    for lanes in range(entries // LANES):
        inside = 0
        for p in range(lanes * LANES, (lanes + 1) * LANES):
            inside += (calendar[BEGINS, p] <= now) & (now <= calendar[ENDS, p])
        if inside > 0:
            contacts = _contacts_among(
                np.uint64(lanes * LANES), LANES, now, contacts, pairs, near_pair
            )
    return contacts


@njit
def _contacts_by_blocks(k, entries, shift, pairs, near_pair):
    """The same by the bounds of blocks, which become those of the steps after ``k`` in the blocks
    that have begun.
    """
    calendar, bounds = pairs.calendar, pairs.bounds
    contacts, now = 0, np.int32(k)
    for row in range(_last_row(entries, shift) + 1):
        begun = 0
        for b in range(row * _ROW, (row + 1) * _ROW):
            begun += bounds[BEGINS, b] <= now
        for b in range(row * _ROW, (row + 1) * _ROW if begun > 0 else 0):
            if bounds[BEGINS, b] <= now:
                first, size = _pairs_of_block(b, entries, shift)
                inside, bounds[STRIKES, b], bounds[BEGINS, b] = _after(now, first, size, calendar)
                if inside > 0:
                    contacts = _contacts_among(first, size, now, contacts, pairs, near_pair)
    return contacts


@njit
def _after(now, first, size, calendar):
    """How many of ``size`` pairs are contacts in a step, and their least strike and begin after
    it.
    """
    inside, strike, begin = 0, NEVER, NEVER
    for n in range(size):
        p = first + np.uint64(n)
        inside += (calendar[BEGINS, p] <= now) & (now <= calendar[ENDS, p])
        strikes, later = calendar[STRIKES, p], calendar[STRIKES, p] > now
        strike = min(strike, strikes if later else NEVER)
        begin = min(begin, calendar[BEGINS, p] if later & (calendar[ENDS, p] > now) else NEVER)
    return inside, strike, begin


@njit
def _contacts_among(first, size, now, contacts, pairs, near_pair):
    """Write the contacts among ``size`` pairs behind those found before; returns how many there are
    now.
    """
    calendar = pairs.calendar
    for n in range(size):
        p = first + np.uint64(n)
        if calendar[BEGINS, p] <= now and now <= calendar[ENDS, p]:
            if contacts < near_pair.size:
                near_pair[contacts] = p
            contacts += 1
    return contacts
