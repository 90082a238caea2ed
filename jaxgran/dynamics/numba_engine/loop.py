"""The time loop of the numba engine: the advance of one replica from contact to contact.

The loop does what the engine ``Jax`` does, contact for contact, with the same rule, impulses to the
same tolerance and the same sums. It differs in what it visits:

- *Search.* One list of near pairs is found through a grid of cells (``near_pairs``). It is valid as
  long as the fastest pair cannot have crossed its skin.
- *Fly.* Of every near pair the ``calendar`` knows in which steps it will be a contact. The next
  step to visit is its smallest entry. Where an event has few contacts among many pairs, bounds of
  blocks of the calendar find it. Flight moves nothing: positions in the laboratory are r + v t,
  with t counted from the search.
- *Collide.* The contacts of a step fall into clusters. Isolated pairs have a closed form; the
  others are solved cluster by cluster (``cluster_solver``). A cluster in which nothing approaches
  needs no impulses. Each cluster may leave a share of the permitted squared residual that earlier
  ones have not used, in proportion to its contacts.
- *Renew the calendar.* An impulse changes the entries of the struck grains' pairs, and no others.
- *Move.* When a list expires, the grains are moved to their present positions.
- *Begin a block.* At the end of a block of steps the next row of sums begins, and list and calendar
  stay.
- *End early.* Where steps are recorded, the loop ends with its first list, or when the records are
  full, and the next call goes on from there.
"""

import math

from jaxgran.dynamics.numba_engine.calendar import (
    bound_blocks,
    choose_blocks,
    clear_calendar,
    contacts_of_step,
    next_contact_step,
    predict_contact_steps,
)
from jaxgran.dynamics.numba_engine.collisions import collide, list_struck_pairs, strike
from jaxgran.dynamics.numba_engine.compilation import CELL, njit, whole_part
from jaxgran.dynamics.numba_engine.layout import (
    CAPACITY,
    DRIFT,
    EPSILON,
    FAILED,
    KINETIC,
    MANY,
    NONFINITE,
    OK,
    READ,
    RECORDED,
    RESULTS,
    SOLVED,
    STATUS,
    STOP,
    TILT,
    UNFINISHED,
    Flow,
)
from jaxgran.dynamics.numba_engine.motion import (
    bring_into_cell,
    kinetic_sums,
    move_grains,
    put_in_order,
    read_state,
    write_motion,
    write_state,
)
from jaxgran.dynamics.numba_engine.near_pairs import LIFE, closing_speed_bound, search
from jaxgran.dynamics.numba_engine.records import record_contacts, record_flight
from jaxgran.dynamics.numba_engine.sums import COLLISIONS, add_flight
from jaxgran.dynamics.numba_engine.velocity_scales import DURATION, READ_UNTIL, read_velocity_scales
from jaxgran.dynamics.velocity_scales import READ_AFTER

image_in_cell, remap_tilt = CELL["image_in_cell"], CELL["remap_tilt"]

# Expected within the skin: wide lists cost the events, narrow ones the searches
_PAIRS_PER_GRAIN = 2.7
_NARROWEST_SKIN = 0.05  # σ, the usual skin of a dense flow


@njit
def time_loop(
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
    records,
    arrays,
    shared,
):
    """Advance one replica by one block of steps after another.

    Args:
      positions, velocities: (grains, 2) as in a State, or as an unfinished call has left them.
      radii, masses: (grains,).
      inputs: the numbers ``layout.Inputs``.
      steps: (blocks,) numbers of time steps.
      begin: (RESULTS,) the sums and the other numbers before the first step, see ``layout``.
      new_positions, new_velocities: (grains, 2) receive those of the state after the last step; of
        an unfinished call the positions of unwrapped grains, and velocities in the laboratory.
      results: (blocks, RESULTS) receives the sums of each block, see ``layout``; those of the first
        one go on from ``begin``.
      records: (room, numbers) receives ``records`` of the steps of one block; with the first list
        of near pairs, or when they are full, the loop ends unfinished. Without room it records
        nothing.
      arrays: memory of the loop.
      shared: words shared with Python; unless that of ``STOP`` is zero, the loop ends with the
        status ``failed``.
    """
    side, shear_rate, dt = inputs.side, inputs.shear_rate, inputs.timestep
    flow = flow_of(inputs)
    look_ahead, count = flow.activation * dt, radii.size
    blocks, all_steps = steps.size, 0
    for b in range(blocks):
        all_steps += int(steps[b])
        for n in range(RESULTS):
            results[b, n] = begin[n] if b == 0 else 0.0
    block, block_end, sums = 0, int(steps[0]), results[0]
    tilt, goes_on = begin[TILT], begin[UNFINISHED] > 0.0
    # ``solved``: whether the contacts of the present step have been dealt with
    steps_before_list, solved = 0, whole_part(begin[SOLVED], 1)
    reading_interval = begin[READ]  # time between readings of the velocity scales; 0 at first

    grains, pairs, network, clusters = arrays
    put_in_order(positions, side, tilt, grains, pairs)
    largest_diameter, finite = read_state(
        positions, velocities, radii, masses, 0.0 if goes_on else shear_rate, grains
    )
    status = whole_part(begin[STATUS], FAILED) if finite else NONFINITE
    widest_skin = side / 2 - largest_diameter  # nearest images are unique
    if widest_skin < 0.0:
        status, widest_skin = max(status, CAPACITY), 0.0
    usual_skin = skin_of_a_list(side, count, widest_skin)

    life = LIFE / shear_rate if shear_rate > 0.0 else math.inf
    room, recorded = records.shape[0], 0
    while steps_before_list < all_steps and status < NONFINITE:
        k, new_list = 0, True  # steps since the search
        max_speed = bring_into_cell(grains, side, tilt, shear_rate)
        kinetic = kinetic_sums(grains, shear_rate)
        speed = closing_speed_bound(max_speed, shear_rate, 2 * largest_diameter, look_ahead)
        least_skin = 1.2 * look_ahead * speed  # what one step may need
        skin = min(max(least_skin, usual_skin), widest_skin)
        pair_count, skin, fits = search(grains, pairs, side, tilt, largest_diameter, skin)
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
        horizon = max(valid, dt) + look_ahead
        for p in range(pair_count):
            pairs.listed[p] = p
        predict_contact_steps(pair_count, 0.0, solved, horizon, 0, flow, grains, pairs)
        entries = clear_calendar(pair_count, pairs)
        list_steps = max(min(slack / closing_speed, life) / dt, 1.0)
        shift = choose_blocks(entries, list_steps, pairs)
        if shift > 0:
            bound_blocks(entries, shift, pairs)

        if room > 0:
            record_flight(records[0], 0, solved, tilt, 0.0, shear_rate, grains)
            recorded = 1
        while True:
            # The next step to visit is that of a contact, the end of the list's life, or that of
            # the advance. A new list lasts to the next step, where it is renewed.
            list_steps = MANY
            if closing_speed > 0.0:
                list_steps = min(slack / (closing_speed * dt), life / dt - k)
            contact_step, last_k = next_contact_step(entries, shift, pairs), k
            list_end = last_k + max(whole_part(list_steps, MANY), 1 if new_list else 0)
            k = min(list_end, contact_step, block_end - steps_before_list)
            flight, new_list = (k - last_k) * dt, False
            kinetic = add_flight(sums, k - last_k, flight, shear_rate * flight, kinetic)
            slack -= closing_speed * flight
            solved = solved if k == last_k else 0
            if shared[STOP] != 0:
                status = FAILED
                break
            t, block_ends = k * dt, steps_before_list + k >= block_end
            while block + 1 < blocks and steps_before_list + k >= block_end:
                _end_block(
                    t, tilt + shear_rate * t, flow, kinetic, status, grains, network, clusters, sums
                )
                block, sums, status, reading_interval = block + 1, results[block + 1], OK, 0.0
                block_end += int(steps[block])
            if steps_before_list + k >= block_end or (k > last_k and slack < -16 * EPSILON * skin):
                break
            if contact_step > k:
                if block_ends:
                    continue
                break

            contacts = contacts_of_step(k, entries, shift, pairs, network.near_pair)
            overfull = contacts > network.near_pair.size
            contacts = min(contacts, network.near_pair.size)
            touched_count, outcome = collide(
                contacts, t, flow, grains, pairs, network, clusters, sums
            )
            status = max(status, CAPACITY if overfull else OK, outcome)
            solved = 1
            if room > 0:
                record = records[recorded]
                record_flight(record, k, solved, tilt + shear_rate * t, t, shear_rate, grains)
                record_contacts(record, contacts, flow.one_plus_alpha, grains, network)
                recorded += 1
            kinetic, max_speed, finite = strike(
                touched_count, t, shear_rate, grains, network, clusters, kinetic, max_speed
            )
            last_speed = closing_speed
            closing_speed = closing_speed_bound(
                max_speed, shear_rate, largest_diameter + skin, look_ahead
            )
            if not (finite and closing_speed < math.inf):
                status = NONFINITE
                break
            if reading_interval == 0.0:
                if sums[COLLISIONS] >= READ_AFTER * count / 4:
                    reading_interval = 2 * sums[DURATION]
            elif sums[DURATION] - sums[READ_UNTIL] >= reading_interval:
                read_velocity_scales(
                    t, tilt + shear_rate * t, flow, grains, network, clusters, sums
                )
            if 0 < room == recorded:
                break
            slack -= (closing_speed - last_speed) * look_ahead
            horizon = max(min(slack / closing_speed, life - t), dt) + look_ahead
            listed = list_struck_pairs(
                k, touched_count, pair_count if overfull else contacts, overfull, pairs, network
            )
            predict_contact_steps(listed, t, k + 1, horizon, shift, flow, grains, pairs)

        steps_before_list += k
        tilt = remap_tilt(tilt + shear_rate * k * dt)
        move_grains(k * dt, grains)
        if room > 0:
            break

    unfinished = steps_before_list < all_steps and status < NONFINITE
    if unfinished:
        write_motion(grains, new_positions, new_velocities)
    elif steps_before_list > 0 or goes_on:
        write_state(side, tilt, shear_rate, grains, new_positions, new_velocities)
    else:  # as it was, to the bit
        for g in range(count):
            new_positions[g, 0], new_positions[g, 1] = image_in_cell(
                positions[g, 0], positions[g, 1], side, tilt
            )
            new_velocities[g, 0], new_velocities[g, 1] = velocities[g, 0], velocities[g, 1]
    # several where a block has no steps, or where something went wrong
    for b in range(block, blocks):
        results[b, STATUS] = status
    sums = results[blocks - 1]
    sums[TILT], sums[UNFINISHED], sums[RECORDED] = tilt, unfinished, recorded
    sums[SOLVED], sums[READ] = solved, reading_interval


@njit
def flow_of(inputs):
    """The numbers of a flow that do not change."""
    return Flow(
        inputs.side,
        inputs.shear_rate,
        inputs.timestep,
        inputs.activation,
        1.0 + inputs.restitution,
        inputs.tolerance,
        whole_part(inputs.max_steps, MANY),
    )


@njit
def skin_of_a_list(side, count, widest_skin):
    """The skin within which a list is expected to have ``_PAIRS_PER_GRAIN``."""
    expected_skin = math.sqrt(2 * _PAIRS_PER_GRAIN * side * side / (math.pi * count)) - 1.0
    return min(max(expected_skin, _NARROWEST_SKIN), widest_skin)


@njit
def _end_block(t, tilt, flow, kinetic, status, grains, network, clusters, sums):
    """Complete the sums of a block that ends at the time t since the search, and is not the last
    one.
    """
    motion, constants, shear_rate = grains.motion, grains.constants, flow.shear_rate
    read_velocity_scales(t, tilt, flow, grains, network, clusters, sums)
    px = py = total = 0.0
    for g in range(motion.size):
        cx, cy = motion[g].vx - shear_rate * (motion[g].y + motion[g].vy * t), motion[g].vy
        mass = 1 / constants[g].inverse_mass
        px += mass * cx
        py += mass * cy
        total += mass * math.sqrt(cx * cx + cy * cy)
    xx, _, yy = kinetic
    sums[STATUS], sums[KINETIC] = status, (xx + yy) / 2
    sums[DRIFT] = math.sqrt(px * px + py * py) / total if total > 0.0 else 0.0
