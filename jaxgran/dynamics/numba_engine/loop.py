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
- *Suspend.* When the records are full, the loop stops. The next call continues in the same memory,
  so the trajectory and its sums are those of one call, to the bit.
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
    BETWEEN_LISTS,
    CAPACITY,
    DRIFT,
    EPSILON,
    FAILED,
    INVERSE_MASS,
    KINETIC,
    MANY,
    NONFINITE,
    OK,
    RECORDED,
    RESULTS,
    STATUS,
    SUSPENDED,
    TILT,
    VX,
    VY,
    WITHIN_LIST,
    Flow,
    Y,
)
from jaxgran.dynamics.numba_engine.motion import (
    bring_into_cell,
    kinetic_sums,
    move_grains,
    put_in_order,
    read_state,
    write_state,
)
from jaxgran.dynamics.numba_engine.near_pairs import LIFE, closing_speed_bound, search
from jaxgran.dynamics.numba_engine.records import record_contacts, record_flight
from jaxgran.dynamics.numba_engine.sums import COLLISIONS, add_flight
from jaxgran.dynamics.numba_engine.velocity_scales import read_velocity_scales
from jaxgran.dynamics.tally import NUMBERS
from jaxgran.dynamics.velocity_scales import READ_AFTER

image_in_cell, remap_tilt = CELL["image_in_cell"], CELL["remap_tilt"]

# Expected within the skin: wide lists cost the events, narrow ones the searches
_PAIRS_PER_GRAIN = 2.7
_NARROWEST_SKIN = 0.05  # σ, the usual skin of a dense flow


@njit
def advance_loop(
    positions,
    velocities,
    radii,
    masses,
    inputs,
    steps,
    new_positions,
    new_velocities,
    results,
    records,
    arrays,
    stop,
):
    """Advance one replica by one block of steps after another.

    Args:
      positions, velocities: (grains, 2) as in a State; ``new_positions`` and ``new_velocities``
        receive those after.
      radii, masses: (grains,).
      inputs: the numbers ``layout.Inputs``.
      steps: (blocks,) numbers of time steps.
      results: (blocks, RESULTS) receives, for each block, the running sums and the status; at the
        end of all but the last one also a reading of the velocity scales, the kinetic energy and
        the relative momentum; in the last one the tilt, where the loop is suspended (0 if it is
        finished), and the number of records.
      records: (room, numbers) receives ``records`` of the steps of one block; when they are full,
        the loop is suspended before it writes the new state. Without room it records nothing.
      arrays: memory of the loop, see ``allocation``; of the earlier call where one was suspended.
      stop: (1,), a word that another thread may set; unless it is zero, the loop ends with the
        status ``failed``.
    """
    side, tilt, shear_rate, dt = inputs.side, inputs.tilt, inputs.shear_rate, inputs.timestep
    flow = Flow(
        side,
        shear_rate,
        dt,
        inputs.activation,
        1.0 + inputs.restitution,
        inputs.tolerance,
        whole_part(inputs.max_steps, MANY),
    )
    look_ahead, count = flow.activation * dt, radii.size
    blocks, all_steps = steps.size, 0
    for b in range(blocks):
        all_steps += int(steps[b])
        for n in range(RESULTS):
            results[b, n] = 0.0
    block, block_end, sums = 0, int(steps[0]), results[0]

    grains, pairs, network, clusters, order, step_sums, saved_sums, saved_numbers = arrays
    saved = saved_numbers[0]
    resume_at = int(inputs.resume_at)
    if resume_at > 0:
        for n in range(NUMBERS):
            sums[n] = saved_sums[n]
        tilt, largest_diameter = saved.tilt, saved.largest_diameter
        steps_before_list, solved, status = saved.steps_before_list, saved.solved, saved.status
        collisions_read = saved.collisions_read
    else:
        put_in_order(positions, side, tilt, order)
        largest_diameter, finite = read_state(
            positions, velocities, radii, masses, order.in_state, shear_rate, grains
        )
        # ``solved``: whether the contacts of the present step have been dealt with
        steps_before_list, solved = 0, 0
        status = whole_part(inputs.status, FAILED) if finite else NONFINITE
        collisions_read = 0.0  # collisions until the last reading of the velocity scales
    widest_skin = side / 2 - largest_diameter  # nearest images are unique
    if widest_skin < 0.0:
        status, widest_skin = max(status, CAPACITY), 0.0
    expected_skin = math.sqrt(2 * _PAIRS_PER_GRAIN * side * side / (math.pi * count)) - 1.0
    usual_skin = min(max(expected_skin, _NARROWEST_SKIN), widest_skin)

    life = LIFE / shear_rate if shear_rate > 0.0 else math.inf
    room, recorded, suspended = records.shape[0], 0, 0
    while steps_before_list < all_steps and status < NONFINITE:
        if 0 < room < recorded + 2:  # for a list and for contacts
            suspended = BETWEEN_LISTS
            break
        if resume_at == WITHIN_LIST:
            resume_at, new_list = 0, False
            k, pair_count, skin, closing_speed = (
                saved.k,
                saved.pair_count,
                saved.skin,
                saved.closing_speed,
            )
            slack, max_speed = saved.slack, saved.max_speed
            kinetic = saved.kinetic_xx, saved.kinetic_xy, saved.kinetic_yy
        else:
            k, new_list = 0, True  # steps since the search
            max_speed = bring_into_cell(grains, side, tilt, shear_rate)
            kinetic = kinetic_sums(grains, shear_rate)
            # what one step may need
            least_skin = (
                1.2 * (2 * max_speed * (1 + LIFE) + shear_rate * largest_diameter) * look_ahead
            )
            skin = min(max(least_skin, usual_skin), widest_skin)
            pair_count, skin, fits = search(grains, pairs, side, tilt, largest_diameter, skin)
            closing_speed = closing_speed_bound(max_speed, shear_rate, largest_diameter + skin)
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
        list_steps = max(min(slack / closing_speed, life - k * dt) / dt, 1.0)
        shift = choose_blocks(entries, list_steps, pairs)
        if shift > 0:
            bound_blocks(entries, shift, pairs)

        if room > 0:
            t = k * dt
            record_flight(
                records[recorded],
                steps_before_list + k,
                solved,
                tilt + shear_rate * t,
                t,
                shear_rate,
                grains,
                order.in_state,
            )
            recorded += 1
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
            if stop[0] != 0:
                status = FAILED
                break
            t, block_ends = k * dt, steps_before_list + k >= block_end
            while block + 1 < blocks and steps_before_list + k >= block_end:
                _end_block(
                    t,
                    tilt + shear_rate * t,
                    side,
                    shear_rate,
                    kinetic,
                    status,
                    grains,
                    clusters,
                    step_sums,
                    sums,
                )
                block, sums, status, collisions_read = block + 1, results[block + 1], OK, 0.0
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
                contacts, t, flow, grains, pairs, network, clusters, step_sums, sums
            )
            status = max(status, CAPACITY if overfull else OK, outcome)
            solved = 1
            if room > 0:
                record_flight(
                    records[recorded],
                    steps_before_list + k,
                    solved,
                    tilt + shear_rate * t,
                    t,
                    shear_rate,
                    grains,
                    order.in_state,
                )
                record_contacts(
                    records[recorded], contacts, flow.one_plus_alpha, order.in_state, network
                )
                recorded += 1
            kinetic, max_speed, finite = strike(
                touched_count, t, shear_rate, grains, network, clusters, kinetic, max_speed
            )
            last_speed = closing_speed
            closing_speed = closing_speed_bound(max_speed, shear_rate, largest_diameter + skin)
            if not (finite and closing_speed < math.inf):
                status = NONFINITE
                break
            if sums[COLLISIONS] - collisions_read >= READ_AFTER * count / 2:
                read_velocity_scales(
                    t,
                    tilt + shear_rate * t,
                    side,
                    shear_rate,
                    grains,
                    clusters.matrices,
                    step_sums,
                    sums,
                )
                collisions_read = sums[COLLISIONS]
            slack -= (closing_speed - last_speed) * look_ahead
            horizon = max(min(slack / closing_speed, life - t), dt) + look_ahead
            listed = list_struck_pairs(
                k, touched_count, pair_count if overfull else contacts, overfull, pairs, network
            )
            predict_contact_steps(listed, t, k + 1, horizon, shift, flow, grains, pairs)
            if 0 < room == recorded:
                suspended = WITHIN_LIST
                break

        if suspended > 0:
            saved.k, saved.pair_count, saved.skin = k, pair_count, skin
            saved.closing_speed, saved.slack, saved.max_speed = closing_speed, slack, max_speed
            saved.kinetic_xx, saved.kinetic_xy, saved.kinetic_yy = kinetic
            break
        steps_before_list += k
        tilt = remap_tilt(tilt + shear_rate * k * dt)
        move_grains(k * dt, grains)

    if suspended > 0:
        for n in range(NUMBERS):
            saved_sums[n] = sums[n]
        saved.tilt, saved.largest_diameter = tilt, largest_diameter
        saved.steps_before_list, saved.solved, saved.status = steps_before_list, solved, status
        saved.collisions_read = collisions_read
    elif steps_before_list > 0:
        write_state(order.in_state, side, tilt, shear_rate, grains, new_positions, new_velocities)
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
    sums[TILT], sums[SUSPENDED], sums[RECORDED] = tilt, suspended, recorded


@njit
def _end_block(t, tilt, side, shear_rate, kinetic, status, grains, clusters, step_sums, sums):
    """Complete the sums of a block that ends at the time t since the search, and is not the last
    one.
    """
    motion, constants = grains.motion, grains.constants
    read_velocity_scales(t, tilt, side, shear_rate, grains, clusters.matrices, step_sums, sums)
    px = py = total = 0.0
    for g in range(motion.shape[0]):
        cx, cy = motion[g, VX] - shear_rate * (motion[g, Y] + motion[g, VY] * t), motion[g, VY]
        mass = 1 / constants[g, INVERSE_MASS]
        px += mass * cx
        py += mass * cy
        total += mass * math.sqrt(cx * cx + cy * cy)
    xx, _, yy = kinetic
    sums[STATUS], sums[KINETIC] = status, (xx + yy) / 2
    sums[DRIFT] = math.sqrt(px * px + py * py) / total if total > 0.0 else 0.0
