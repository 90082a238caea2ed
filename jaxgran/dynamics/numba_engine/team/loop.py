"""The time loop of a team: the steps, the calendar and the sums of ``numba_engine.loop``.

It differs in how the work is shared out. Every pass over grains, pairs or contacts is strided over
the lanes. What a lane adds to a list stands behind that of lower lanes. The running sums are
private to each lane until a block ends. All lanes hold the same numbers of the flow, so they take
the same branches, and meet at every barrier.
"""

# pyright: reportCallIssue=false

import math

import numpy as np

from jaxgran.dynamics.numba_engine.calendar import contact_steps, pair_motion
from jaxgran.dynamics.numba_engine.compilation import CELL, njit, whole_part
from jaxgran.dynamics.numba_engine.layout import (
    BEGINS,
    CAPACITY,
    DRIFT,
    ENDS,
    EPSILON,
    FAILED,
    FIRST,
    IMAGE_ROW,
    IMAGE_X,
    KINETIC,
    MANY,
    NEVER,
    NONFINITE,
    OK,
    RESULTS,
    SECOND,
    STATUS,
    STRIKES,
    TILT,
)
from jaxgran.dynamics.numba_engine.loop import flow_of, skin_of_a_list
from jaxgran.dynamics.numba_engine.motion import (
    bring_grain_into_cell,
    move_grain,
    read_grain,
    with_grain,
    write_grain,
)
from jaxgran.dynamics.numba_engine.near_pairs import (
    ATTEMPTS,
    LIFE,
    cell_of,
    closing_speed_bound,
    grid_of,
    stretch_of,
)
from jaxgran.dynamics.numba_engine.sums import add_flight
from jaxgran.dynamics.numba_engine.team.contacts import collide, strike
from jaxgran.dynamics.numba_engine.team.lanes import (
    ballot,
    before_and_total,
    bits_of,
    in_turns,
    lanes_in_turn,
    largest,
    least,
    lower_lanes,
    of_lane,
    own_index,
    place_in_list,
    shared_out,
    sum_of,
    sync,
)
from jaxgran.dynamics.numba_engine.velocity_scales import (
    DURATION,
    LOCAL,
    READ_UNTIL,
    WAVE,
    box_of,
    place_and_velocity,
)
from jaxgran.dynamics.tally import LARGEST, NUMBERS, place_of, span_of
from jaxgran.dynamics.velocity_scales import BOX_GRAINS, READ_AFTER, WAVES

image_in_cell, nearest_image, remap_tilt = (
    CELL[name] for name in ("image_in_cell", "nearest_image", "remap_tilt")
)
_STEPS = place_of("steps")
_WAVES = np.array(WAVES, float)
_FIRST_LARGEST, _END_LARGEST = span_of(LARGEST).start, span_of(LARGEST).stop


@njit
def advance_team(
    team,
    positions,
    velocities,
    radii,
    masses,
    inputs,
    steps,
    begin,
    new_positions,
    new_velocities,
    results,
    memory,
):
    """Advance one replica by one block of steps after another, as ``numba_engine.loop.time_loop``
    does, but without records.

    Args:
      team: this lane; all lanes call with the same arrays.
      memory: ``memory.Memory``, which needs not be initialised.
    """
    side, shear_rate, dt = inputs.side, inputs.shear_rate, inputs.timestep
    flow = flow_of(inputs)
    grains, pairs, network, clusters = memory.grains, memory.pairs, memory.network, memory.clusters
    look_ahead, count, sums = flow.activation * dt, radii.size, memory.sums[team.lane]
    blocks, all_steps = steps.size, 0
    for b in range(blocks):
        all_steps += int(steps[b])
        for n in shared_out(team, RESULTS):
            results[b, n] = 0.0
    for n in range(NUMBERS):
        sums[n] = 0.0
    block, block_end = 0, int(steps[0])
    tilt, steps_before_list, solved = begin[TILT], 0, 0
    # readings of the velocity scales: collisions so far, the time of the last one, their interval
    collisions, read_until, reading_interval = 0, 0.0, 0.0

    own_diameter = 0.0
    for g in shared_out(team, count):
        finite = read_grain(g, g, positions, velocities, radii, masses, shear_rate, grains)
        network.loaded[g] = network.colours[g] = 0
        own_diameter = max(own_diameter, 2 * radii[g]) if finite else math.inf
    largest_diameter = largest(team, own_diameter)
    finite = largest_diameter < math.inf
    status = whole_part(begin[STATUS], FAILED) if finite else NONFINITE
    widest_skin = side / 2 - largest_diameter  # nearest images are unique
    if widest_skin < 0.0:
        status, widest_skin = max(status, CAPACITY), 0.0
    usual_skin = skin_of_a_list(side, count, widest_skin)

    life = LIFE / shear_rate if shear_rate > 0.0 else math.inf
    while steps_before_list < all_steps and status < NONFINITE:
        k, new_list = 0, True  # steps since the search
        max_speed, kinetic = _bring_into_cell(team, grains, side, tilt, shear_rate)
        speed = closing_speed_bound(max_speed, shear_rate, 2 * largest_diameter, look_ahead)
        least_skin = 1.2 * look_ahead * speed
        skin = min(max(least_skin, usual_skin), widest_skin)
        pair_count, skin, fits = _search(team, grains, pairs, side, tilt, largest_diameter, skin)
        closing_speed = closing_speed_bound(
            max_speed, shear_rate, largest_diameter + skin, look_ahead
        )
        slack = skin - closing_speed * look_ahead
        if slack < 0.0 or not fits:
            status = max(status, CAPACITY)
        if not closing_speed < math.inf:
            status = NONFINITE
            break
        valid = min(slack / closing_speed if closing_speed > 0.0 else math.inf, life)
        for p in shared_out(team, pair_count):
            pairs.listed[p] = p
        _predict(team, pair_count, 0.0, solved, max(valid, dt) + look_ahead, flow, grains, pairs)

        while True:
            list_steps = MANY
            if closing_speed > 0.0:
                list_steps = min(slack / (closing_speed * dt), life / dt - k)
            contact_step, last_k = _next_contact_step(team, pair_count, pairs), k
            list_end = last_k + max(whole_part(list_steps, MANY), 1 if new_list else 0)
            k = min(list_end, contact_step, block_end - steps_before_list)
            flight, new_list = (k - last_k) * dt, False
            kinetic = add_flight(sums, k - last_k, flight, shear_rate * flight, kinetic)
            slack -= closing_speed * flight
            solved = solved if k == last_k else 0
            t, block_ends = k * dt, steps_before_list + k >= block_end
            while block + 1 < blocks and steps_before_list + k >= block_end:
                here = tilt + shear_rate * t
                _read_velocity_scales(team, t, here, read_until, flow, grains, sums)
                _end_block(team, t, shear_rate, kinetic, status, grains, memory, results[block])
                block, status, collisions, read_until = block + 1, OK, 0, 0.0
                reading_interval = 0.0
                block_end += int(steps[block])
            if steps_before_list + k >= block_end or (k > last_k and slack < -16 * EPSILON * skin):
                break
            if contact_step > k:
                if block_ends:
                    continue
                break

            contacts = _contacts_of_step(team, k, pair_count, pairs, network)
            if contacts > network.near_pair.size:
                status, contacts = max(status, CAPACITY), network.near_pair.size
            approaching, outcome = collide(
                team, contacts, t, flow, grains, pairs, network, clusters, sums
            )
            status, solved, collisions = max(status, outcome), 1, collisions + approaching
            kinetic, max_speed = strike(team, t, flow, grains, network, kinetic, max_speed)
            last_speed = closing_speed
            closing_speed = closing_speed_bound(
                max_speed, shear_rate, largest_diameter + skin, look_ahead
            )
            if not closing_speed < math.inf:
                status = NONFINITE
                break
            if reading_interval == 0.0:
                if collisions >= READ_AFTER * count / 4:
                    reading_interval = 2 * sums[DURATION]
            elif sums[DURATION] - read_until >= reading_interval:
                here = tilt + shear_rate * t
                _read_velocity_scales(team, t, here, read_until, flow, grains, sums)
                read_until = sums[DURATION]
            slack -= (closing_speed - last_speed) * look_ahead
            horizon = max(min(slack / closing_speed, life - t), dt) + look_ahead
            listed = _struck_pairs(team, k, pair_count, pairs, network.loaded)
            for g in shared_out(team, count):
                network.loaded[g] = 0
            _predict(team, listed, t, k + 1, horizon, flow, grains, pairs)

        steps_before_list += k
        tilt = remap_tilt(tilt + shear_rate * k * dt)
        for g in shared_out(team, count):
            move_grain(g, k * dt, grains)

    for g in shared_out(team, count):
        if steps_before_list > 0:
            write_grain(g, g, side, tilt, shear_rate, grains, new_positions, new_velocities)
        else:  # as it was, to the bit
            new_positions[g, 0], new_positions[g, 1] = image_in_cell(
                positions[g, 0], positions[g, 1], side, tilt
            )
            new_velocities[g, 0], new_velocities[g, 1] = velocities[g, 0], velocities[g, 1]
    _add_lanes(team, memory, results[block])
    if team.lane == 0:
        for b in range(block, blocks):
            results[b, STATUS] = status
        results[blocks - 1, TILT] = tilt


@njit
def _bring_into_cell(team, grains, side, tilt, shear_rate):
    """Bring the grains into the cell; returns the largest peculiar speed, and this lane's share of
    Σ m c ⊗ c.
    """
    squared_speed, kinetic = 0.0, (0.0, 0.0, 0.0)
    for g in shared_out(team, grains.motion.size):
        own = bring_grain_into_cell(g, grains, side, tilt, shear_rate)
        squared_speed = max(squared_speed, own) if own < math.inf else math.inf
        kinetic = with_grain(g, grains, shear_rate, kinetic)
    sync()
    return math.sqrt(largest(team, squared_speed)), kinetic


@njit
def _search(team, grains, pairs, side, tilt, largest_diameter, skin):
    """List the near pairs, with ever narrower skins while there is no room for them; returns their
    number, the skin, and whether there was room.
    """
    capacity, found = pairs.listed.size, 0
    for _ in range(ATTEMPTS):
        reach = largest_diameter + skin
        found = _find_near_pairs(team, grains, pairs, side, tilt, reach, skin, capacity)
        if found <= capacity:
            break
        skin *= 0.7
    return min(found, capacity), skin, found <= capacity


@njit
def _find_near_pairs(team, grains, pairs, side, tilt, reach, skin, capacity):
    """Write the pairs with a gap within the skin, and their images; pairs beyond the capacity are
    counted, not written. Each lane takes a grain, and compares it with those of half of the cells
    around; all with those behind it where there is no grid.
    """
    motion, constants, order = grains.motion, grains.constants, pairs.sorted
    ends, images, found, count = pairs.ends, pairs.images, 0, motion.size
    rows, columns = grid_of(reach, side, tilt, pairs.starts.size - 1)
    if rows > 0:
        _sort_into_cells(team, motion, pairs, side, tilt, rows, columns)
    for first in in_turns(team, count):
        m, here = own_index(team, first, count)
        i, own_row, own_column = np.uint32(m), 0, 0
        if here and rows > 0:
            i = order[m]
            cell = np.int64(pairs.cells[i])
            own_row, own_column = cell // columns, cell % columns
        x, y, radius_and_skin = 0.0, 0.0, 0.0
        if here:
            x, y, radius_and_skin = motion[i].x, motion[i].y, constants[i].radius + skin
        for part in range(4 if rows > 0 else 1):
            begin, end, column, row = 0, count, 0, 0
            if rows > 0:
                begin, end, column, row = stretch_of(
                    part, own_row, own_column, rows, columns, pairs.starts
                )
            n = m + np.uint64(1) if part == 0 else np.uint64(begin)
            end = np.uint64(end) if here else np.uint64(0)
            image_x, image_row = (column + row * tilt) * side, float(row)
            while ballot(team, n < end) > 0:
                j, is_near = np.uint32(n), False
                if n < end:
                    j = order[n] if rows > 0 else j
                    dx, dy = x - motion[j].x, y - motion[j].y
                    if rows == 0:
                        nearest_column, image_row = nearest_image(dx, dy, side, tilt)
                        image_x = nearest_column * side + image_row * tilt * side
                    dx, dy = dx - image_x, dy - image_row * side
                    distance = radius_and_skin + constants[j].radius
                    is_near = dx * dx + dy * dy <= distance * distance
                p, found = place_in_list(team, is_near, found)
                if is_near and p < capacity:
                    ends[FIRST, p], ends[SECOND, p] = i, j
                    images[IMAGE_X, p], images[IMAGE_ROW, p] = image_x, image_row
                n += np.uint64(1)
    sync()
    return found


@njit
def _sort_into_cells(team, motion, pairs, side, tilt, rows, columns):
    """Sort the grains by cell, those of a cell in their order: the grains that the lanes have at
    once are counted by comparing their cells.
    """
    starts, cells, order, ranks = pairs.starts, pairs.cells, pairs.sorted, pairs.listed
    count, cell_count = motion.size, rows * columns
    for cell in shared_out(team, cell_count + 1):
        starts[cell] = 0
    sync()
    for first in in_turns(team, count):
        (g, here), cell, same = own_index(team, first, count), cell_count, np.uint64(0)
        if here:
            cell = cell_of(motion[g].x, motion[g].y, side, tilt, rows, columns)
        for n in range(lanes_in_turn(team, first, count)):
            same |= np.uint64(of_lane(team, cell, n) == cell) << n
        before = bits_of(same & lower_lanes(team))
        if here:
            cells[g], ranks[g] = cell, starts[cell + 1] + before
        sync()
        if here and before == 0:
            starts[cell + 1] += bits_of(same)
        sync()
    filled = 0
    for first in in_turns(team, cell_count):
        cell, here = own_index(team, first, cell_count)
        size = np.int64(starts[cell + 1]) if here else 0
        before, of_turn = before_and_total(team, size)
        if here:
            starts[cell + 1] = filled + before + size
        filled += of_turn
    sync()
    for g in shared_out(team, count):
        order[starts[cells[g]] + ranks[g]] = g
    sync()


@njit
def _predict(team, count, t, earliest, horizon, flow, grains, pairs):
    """Write the calendar of the listed pairs, see ``numba_engine.calendar``."""
    constants, calendar = grains.constants, pairs.calendar
    for n in shared_out(team, count):
        p = pairs.listed[n]
        i, j, dx, dy, ux, uy = pair_motion(p, t, flow, grains, pairs)
        reach = constants[i].radius + constants[j].radius
        steps = contact_steps(dx, dy, ux, uy, reach, t, earliest, horizon, flow)
        calendar[STRIKES, p], calendar[BEGINS, p], calendar[ENDS, p] = steps
    sync()


@njit
def _next_contact_step(team, count, pairs):
    """The next step in which some contact approaches."""
    strike_step = np.int64(NEVER)
    for p in shared_out(team, count):
        strike_step = min(strike_step, np.int64(pairs.calendar[STRIKES, p]))
    return least(team, strike_step)


@njit
def _contacts_of_step(team, k, count, pairs, network):
    """Write the pairs that are contacts in a step; returns their number."""
    calendar, listed, found = pairs.calendar, network.near_pair, 0
    for first in in_turns(team, count):
        p, here = own_index(team, first, count)
        wanted = here and calendar[BEGINS, p] <= k and k <= calendar[ENDS, p]
        place, found = place_in_list(team, wanted, found)
        if wanted and place < listed.size:
            listed[place] = p
    sync()
    return found


@njit
def _struck_pairs(team, k, count, pairs, loaded):
    """List the pairs to be predicted anew: those of struck grains, and those that were due."""
    calendar, ends, found = pairs.calendar, pairs.ends, 0
    for first in in_turns(team, count):
        p, wanted = own_index(team, first, count)
        if wanted:
            struck = loaded[ends[FIRST, p]] + loaded[ends[SECOND, p]] > 0
            wanted = struck or calendar[STRIKES, p] <= k
        place, found = place_in_list(team, wanted, found)
        if wanted:
            pairs.listed[place] = p
    sync()
    return found


@njit
def _end_block(team, t, shear_rate, kinetic, status, grains, memory, result):
    """Complete the sums of a block that ends at the time t since the search, and is not the last
    one.
    """
    motion, constants = grains.motion, grains.constants
    own_x = own_y = own_total = 0.0
    for g in shared_out(team, motion.size):
        cx, cy = motion[g].vx - shear_rate * (motion[g].y + motion[g].vy * t), motion[g].vy
        mass = 1 / constants[g].inverse_mass
        own_x += mass * cx
        own_y += mass * cy
        own_total += mass * math.sqrt(cx * cx + cy * cy)
    px, py, total = sum_of(team, own_x), sum_of(team, own_y), sum_of(team, own_total)
    xx, _, yy = kinetic
    energy = sum_of(team, (xx + yy) / 2)
    _add_lanes(team, memory, result)
    if team.lane == 0:
        result[STATUS], result[KINETIC] = status, energy
        result[DRIFT] = math.sqrt(px * px + py * py) / total if total > 0.0 else 0.0


@njit
def _add_lanes(team, memory, result):
    """Write the sums of all lanes, which begin anew."""
    sums = memory.sums
    sync()
    for n in shared_out(team, NUMBERS):
        is_largest = _FIRST_LARGEST <= n < _END_LARGEST
        of_all = n == DURATION or n == _STEPS  # each lane has the sum
        total = sums[0, n]
        for m in range(1, team.lanes):
            other = sums[m, n]
            if not of_all:
                total = max(total, other) if is_largest else total + other
        for m in range(team.lanes):
            sums[m, n] = 0.0
        result[n] = total
    sync()


@njit
def _sine(turns):
    """sin 2πx to 3e-16, by its series in a quarter of a turn: a device has no mathematical library
    to link.
    """
    x = turns - np.floor(turns + 0.5)
    x = 0.5 - x if x > 0.25 else -0.5 - x if x < -0.25 else x
    x *= 2 * math.pi
    term = total = x
    for n in range(1, 11):
        term *= -x * x / (2 * n * (2 * n + 1))
        total += term
    return total


@njit
def _read_velocity_scales(team, t, tilt, read_until, flow, grains, sums):
    """Add a reading, as ``numba_engine.velocity_scales`` does; it passes over the grains once for
    each box and each wave.
    """
    count = grains.motion.size
    across = max(1, int(np.rint(math.sqrt(count / BOX_GRAINS))))
    tilt = remap_tilt(tilt)
    energy, total, occupied, squares = 0.0, 0.0, 0, 0.0
    for box in range(across * across):
        mass = px = py = own_energy = 0.0
        for g in shared_out(team, count):
            sx, sy, m, cx, cy = place_and_velocity(g, t, tilt, flow, grains)
            if box_of(sx, sy, across) == box:
                mass += m
                px += m * cx
                py += m * cy
                own_energy += m * (cx * cx + cy * cy)
        mass, px, py = sum_of(team, mass), sum_of(team, px), sum_of(team, py)
        total += mass
        energy += sum_of(team, own_energy)
        if mass > 0.0:
            occupied += 1
            energy -= (px * px + py * py) / mass
    for n in range(len(WAVES)):
        kx, ky = _WAVES[n, 0], _WAVES[n, 1]
        real_x = real_y = imaginary_x = imaginary_y = 0.0
        for g in shared_out(team, count):
            sx, sy, mass, cx, cy = place_and_velocity(g, t, tilt, flow, grains)
            phase = kx * sx + ky * sy
            real, imaginary = mass * _sine(phase + 0.25), mass * _sine(phase)
            real_x += real * cx
            real_y += real * cy
            imaginary_x += imaginary * cx
            imaginary_y += imaginary * cy
        a, b = sum_of(team, real_x), sum_of(team, real_y)
        c, d = sum_of(team, imaginary_x), sum_of(team, imaginary_y)
        squares += a * a + b * b + c * c + d * d
    if team.lane == 0:
        since = sums[DURATION] - read_until
        sums[LOCAL] += since * energy / (2 * max(count - occupied, 1))
        sums[WAVE] += since * 2 * squares / (4 * len(WAVES) * total)
        sums[READ_UNTIL] = sums[DURATION]
