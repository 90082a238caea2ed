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

import numpy as np

from jaxgran.dynamics.numba_engine.calendar import (
    bound_blocks,
    choose_blocks,
    clear_calendar,
    contacts_of_step,
    next_contact_step,
    predict_contact_steps,
)
from jaxgran.dynamics.numba_engine.cluster_solver import solve_cluster
from jaxgran.dynamics.numba_engine.compilation import LAW, inline_njit, njit
from jaxgran.dynamics.numba_engine.layout import (
    BETWEEN_LISTS,
    CAPACITY,
    DRIFT,
    EPSILON,
    FAILED,
    FIRST,
    INVERSE_MASS,
    KINETIC,
    MANY,
    NONFINITE,
    OK,
    RADIUS,
    RECORDED,
    RESULTS,
    SECOND,
    STATUS,
    STRIKES,
    SUSPENDED,
    TILT,
    VX,
    VY,
    WITHIN_LIST,
    Flow,
    X,
    Y,
)
from jaxgran.dynamics.numba_engine.near_pairs import (
    LIFE,
    bring_into_cell,
    kinetic_sums,
    put_in_order,
    search,
    skin_loss,
)
from jaxgran.dynamics.numba_engine.network import (
    find_clusters,
    gather_kicks,
    make_network,
    solve_isolated,
)
from jaxgran.dynamics.numba_engine.records import record_contacts, record_flight
from jaxgran.dynamics.numba_engine.sums import COLLISIONS, add_contacts, add_flight, add_solve
from jaxgran.dynamics.numba_engine.velocity_scales import read_velocity_scales
from jaxgran.dynamics.tally import NUMBERS
from jaxgran.dynamics.velocity_scales import READ_AFTER

residual_target, relative_residual = LAW["residual_target"], LAW["relative_residual"]

_PAIRS_PER_GRAIN = (
    2.7  # expected within the skin: wide lists cost the events, narrow ones the searches
)
_NARROWEST_SKIN = 0.05  # σ, the usual skin of a dense flow


@njit
def advance_loop(
    positions,
    velocities,
    radii,
    masses,
    numbers,
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
      numbers: side, tilt, restitution, timestep, shear rate, tolerance, activation fraction, most
        iterations of a solve, and where an earlier call was suspended, or 0 to begin.
      steps: (blocks,) numbers of time steps.
      results: (blocks, RESULTS) receives, for each block, the running sums and the status; at the
        end of all but the last one also a reading of the velocity scales, the kinetic energy and
        the relative momentum; in the last one the tilt, where the loop is suspended (0 if it is
        finished), and the number of records.
      records: (room, numbers) receives ``records`` of the steps of one block; when they are full,
        the loop is suspended before it delivers anything. Without room it records nothing.
      arrays: memory of the loop, see ``allocation``; of the earlier call where one was suspended.
      stop: (1,), a word that another thread may set; unless it is zero, the loop ends with the
        status ``failed``.
    """
    side, tilt, alpha, dt, rate = numbers[0], numbers[1], numbers[2], numbers[3], numbers[4]
    flow = Flow(side, rate, dt, numbers[6], 1.0 + alpha, numbers[5], int(numbers[7]))
    ahead, count, blocks, total = flow.theta * dt, radii.size, steps.size, 0
    for b in range(blocks):
        total += int(steps[b])
        for n in range(RESULTS):
            results[b, n] = 0.0
    block, block_end, sums = 0, int(steps[0]), results[0]

    grains, pairs, network, clusters, order, step_sums, saved = arrays
    going_on = int(numbers[8])
    if going_on > 0:
        for n in range(NUMBERS):
            sums[n] = saved[n]
        tilt, largest, done, solved, status, counted = _advance_saved(saved[NUMBERS:])
    else:
        put_in_order(positions, side, tilt, order)
        largest, finite = _take_grains(
            positions, velocities, radii, masses, order.given, rate, grains
        )
        # steps until the last search; whether the contacts of the present step have been dealt with
        done, solved, status = 0, 0, OK if finite else NONFINITE
        counted = 0.0  # collisions until the last reading of the velocity scales
    widest = side / 2 - largest  # nearest images are unique
    if widest < 0.0:
        status, widest = max(status, CAPACITY), 0.0
    expected = math.sqrt(2 * _PAIRS_PER_GRAIN * side * side / (math.pi * count)) - 1.0
    usual = min(max(expected, _NARROWEST_SKIN), widest)

    life = LIFE / rate if rate > 0.0 else math.inf
    room, recorded, suspended = records.shape[0], 0, 0
    while done < total and status < NONFINITE:
        if 0 < room < recorded + 2:  # for a list and for contacts
            suspended = BETWEEN_LISTS
            break
        if going_on == WITHIN_LIST:
            fresh = False
            k, found, skin, loss, slack, fastest, kinetic = _list_saved(saved[NUMBERS:])
            going_on = 0
        else:
            k, fresh = 0, True  # steps since the search
            fastest = bring_into_cell(grains, side, tilt, rate)
            kinetic = kinetic_sums(grains, rate)
            needed = (
                1.2 * (2 * fastest * (1 + LIFE) + rate * largest) * ahead
            )  # what one step may need
            found, skin, fits = search(
                grains, pairs, side, tilt, largest, min(max(needed, usual), widest)
            )
            loss = skin_loss(fastest, rate, largest + skin)
            slack = skin - loss * ahead
            if slack < 0.0 or not fits:
                status = max(status, CAPACITY)
            if not loss < math.inf:
                status = NONFINITE
                break
            horizon = max(min(slack / loss if loss > 0.0 else math.inf, life), dt) + ahead
            for p in range(found):
                pairs.listed[p] = p
            predict_contact_steps(found, 0.0, solved, horizon, 0, flow, grains, pairs)
        entries = clear_calendar(found, pairs)
        shift = choose_blocks(entries, max(min(slack / loss, life - k * dt) / dt, 1.0), pairs)
        if shift > 0:
            bound_blocks(entries, shift, pairs)

        if room > 0:
            t = k * dt
            record_flight(
                records[recorded], done + k, solved, tilt + rate * t, t, rate, grains, order.given
            )
            recorded += 1
        while True:
            # The next step to visit is that of a contact, the end of the list's life, or that of
            # the advance.
            spare = min(slack / (loss * dt), life / dt - k, MANY) if loss > 0.0 else MANY
            strike, before = next_contact_step(entries, shift, pairs), k
            k = min(before + int(max(spare, 1.0 if fresh else 0.0)), strike, block_end - done)
            flight, fresh = (
                (k - before) * dt,
                False,
            )  # a new list lasts to the next step, where it is renewed
            kinetic = add_flight(sums, k - before, flight, rate * flight, kinetic)
            slack -= loss * flight
            solved = solved if k == before else 0
            if stop[0] != 0:
                status = FAILED
                break
            t, block_ends = k * dt, done + k >= block_end
            while block + 1 < blocks and done + k >= block_end:
                _end_block(
                    t,
                    tilt + rate * t,
                    side,
                    rate,
                    kinetic,
                    status,
                    grains,
                    clusters,
                    step_sums,
                    sums,
                )
                block, sums, status, counted = block + 1, results[block + 1], OK, 0.0
                block_end += int(steps[block])
            if done + k >= block_end or (k > before and slack < -16 * EPSILON * skin):
                break
            if strike > k:
                if block_ends:
                    continue
                break

            contacts = contacts_of_step(k, entries, shift, pairs, network.met)
            overfull = contacts > network.met.size
            contacts = min(contacts, network.met.size)
            hits, outcome = _collide(
                contacts, t, flow, grains, pairs, network, clusters, step_sums, sums
            )
            status = max(status, CAPACITY if overfull else OK, outcome)
            solved = 1
            if room > 0:
                record_flight(
                    records[recorded],
                    done + k,
                    solved,
                    tilt + rate * t,
                    t,
                    rate,
                    grains,
                    order.given,
                )
                record_contacts(
                    records[recorded], contacts, flow.one_plus_alpha, order.given, network
                )
                recorded += 1
            kinetic, fastest, finite = _strike(
                hits, t, rate, grains, network, clusters, kinetic, fastest
            )
            if not finite:
                status = NONFINITE
                break
            if sums[COLLISIONS] - counted >= READ_AFTER * count / 2:
                read_velocity_scales(
                    t, tilt + rate * t, side, rate, grains, clusters.matrices, step_sums, sums
                )
                counted = sums[COLLISIONS]
            loss_before, loss = loss, skin_loss(fastest, rate, largest + skin)
            slack -= (loss - loss_before) * ahead
            horizon = max(min(slack / loss, life - t), dt) + ahead
            listed = _list_struck(
                k, hits, found if overfull else contacts, overfull, pairs, network
            )
            predict_contact_steps(listed, t, k + 1, horizon, shift, flow, grains, pairs)
            if 0 < room == recorded:
                suspended = WITHIN_LIST
                break

        if suspended > 0:
            _save_list(k, found, skin, loss, slack, fastest, kinetic, saved[NUMBERS:])
            break
        done += k
        tilt += rate * k * dt
        tilt -= math.floor(tilt + 0.5)
        _move(k * dt, grains)

    if suspended > 0:
        for n in range(NUMBERS):
            saved[n] = sums[n]
        _save_advance(tilt, largest, done, solved, status, counted, saved[NUMBERS:])
    elif done > 0:
        _deliver(order.given, side, tilt, rate, grains, new_positions, new_velocities)
    else:  # as it was, to the bit
        for g in range(count):
            new_positions[g, 0], new_positions[g, 1] = _wrapped(
                positions[g, 0], positions[g, 1], side, tilt
            )
            new_velocities[g, 0], new_velocities[g, 1] = velocities[g, 0], velocities[g, 1]
    for b in range(
        block, blocks
    ):  # several where a block has no steps, or where something went wrong
        results[b, STATUS] = status
    sums = results[blocks - 1]
    sums[TILT], sums[SUSPENDED], sums[RECORDED] = tilt, suspended, recorded


@njit
def _end_block(t, tilt, side, rate, kinetic, status, grains, clusters, step_sums, sums):
    """Complete the sums of a block that ends at the time t since the search, and is not the last
    one.
    """
    motion, constants = grains.motion, grains.constants
    read_velocity_scales(t, tilt, side, rate, grains, clusters.matrices, step_sums, sums)
    px = py = total = 0.0
    for g in range(motion.shape[0]):
        cx, cy = motion[g, VX] - rate * (motion[g, Y] + motion[g, VY] * t), motion[g, VY]
        mass = 1 / constants[g, INVERSE_MASS]
        px += mass * cx
        py += mass * cy
        total += mass * math.sqrt(cx * cx + cy * cy)
    xx, _, yy = kinetic
    sums[STATUS], sums[KINETIC] = status, (xx + yy) / 2
    sums[DRIFT] = math.sqrt(px * px + py * py) / total if total > 0.0 else 0.0


@inline_njit
def _save_advance(tilt, largest, done, solved, status, counted, saved):
    """Save the numbers of a suspended advance."""
    saved[0], saved[1], saved[2], saved[3], saved[4], saved[14] = (
        tilt,
        largest,
        done,
        solved,
        status,
        counted,
    )


@inline_njit
def _advance_saved(saved):
    """The numbers of ``_save_advance``."""
    return saved[0], saved[1], int(saved[2]), int(saved[3]), int(saved[4]), saved[14]


@inline_njit
def _save_list(k, found, skin, loss, slack, fastest, kinetic, saved):
    """Save the numbers of a list that is in use."""
    saved[5], saved[6], saved[7], saved[8] = k, found, skin, loss
    saved[9], saved[10] = slack, fastest
    saved[11], saved[12], saved[13] = kinetic


@inline_njit
def _list_saved(saved):
    """The numbers of ``_save_list``."""
    kinetic = saved[11], saved[12], saved[13]
    return int(saved[5]), int(saved[6]), saved[7], saved[8], saved[9], saved[10], kinetic


@njit
def _take_grains(positions, velocities, radii, masses, places, rate, grains):
    """Copy the grains, with velocities of the laboratory; returns the largest diameter and whether
    all is finite.
    """
    motion, constants = grains.motion, grains.constants
    largest, finite = 0.0, True
    for g in range(places.size):
        given = places[g]
        motion[g, X], motion[g, Y] = positions[given, 0], positions[given, 1]
        motion[g, VX], motion[g, VY] = (
            velocities[given, 0] + rate * positions[given, 1],
            velocities[given, 1],
        )
        constants[g, RADIUS], constants[g, INVERSE_MASS] = radii[given], 1 / masses[given]
        largest = max(largest, 2 * radii[given])
        for a in range(4):
            finite &= abs(motion[g, a]) < math.inf
    return largest, finite


@inline_njit
def _collide(contacts, t, flow, grains, pairs, network, clusters, step_sums, results):
    """Solve the contacts of a step and add them to the sums; returns the number of their grains,
    and the status.
    """
    hits, squared_scale, deepest = make_network(contacts, t, flow, grains, pairs, network)
    scale = math.sqrt(squared_scale)
    target = residual_target(scale, flow.tolerance, flow.rate, EPSILON)
    iterations, squared, spare, outcome = 1, 0.0, target * target, OK
    if solve_isolated(contacts, grains, network) > 0:
        found = find_clusters(contacts, hits, network, clusters)
        starts = clusters.starts
        for m in range(found):
            share = spare * (starts[m + 1] - starts[m]) / (starts[found] - starts[m])
            needed, left, missed = solve_cluster(
                m, share, flow.most_iterations, grains, network, clusters
            )
            iterations, squared, outcome = (
                max(iterations, needed),
                squared + left,
                max(outcome, missed),
            )
            spare -= left if left < share else share
    residual = relative_residual(math.sqrt(squared), scale, target)
    gather_kicks(contacts, hits, flow.one_plus_alpha, network)
    add_contacts(results, step_sums, contacts, flow.one_plus_alpha, grains, network)
    add_solve(results, iterations, residual, outcome, deepest)
    return hits, outcome


@inline_njit
def _strike(hits, t, rate, grains, network, clusters, kinetic, fastest):
    """Change the velocities of the grains that were struck; returns the sums and the speed that
    follow from them.

    A position in the laboratory is r + v t, so a change of v by Δv shifts r by −Δv t.
    """
    motion, constants, kicks, touched = (
        grains.motion,
        grains.constants,
        network.kicks,
        network.touched,
    )
    xx, xy, yy = kinetic
    finite = True
    for h in range(hits):
        g = touched[h]
        network.degree[g], clusters.reached[g] = 0, 0
        px, py = kicks[g, 0], kicks[g, 1]
        ax, ay = px * constants[g, INVERSE_MASS], py * constants[g, INVERSE_MASS]
        if ax != 0.0 or ay != 0.0:
            cx, cy = motion[g, VX] - rate * (motion[g, Y] + motion[g, VY] * t), motion[g, VY]
            xx += px * (2 * cx + ax)
            xy += px * cy + py * cx + px * ay
            yy += py * (2 * cy + ay)
            speed = math.sqrt((cx + ax) * (cx + ax) + (cy + ay) * (cy + ay))
            finite &= speed < math.inf
            fastest = max(fastest, speed)
            motion[g, VX] += ax
            motion[g, VY] += ay
            motion[g, X] -= ax * t
            motion[g, Y] -= ay * t
    return (xx, xy, yy), fastest, finite


@inline_njit
def _list_struck(k, hits, contacts, overfull, pairs, network):
    """List the pairs of the struck grains, each once, for a new prediction; clears the impulses.
    Returns how many.
    """
    kicks, touched, loaded, met = network.kicks, network.touched, network.loaded, network.met
    ends, offsets, of_grain, listed = pairs.ends, pairs.offsets, pairs.of_grain, pairs.listed
    count = np.uint64(0)
    for h in range(hits):
        g = touched[h]
        if loaded[g] > 0:
            for q in range(offsets[g], offsets[g + 1]):
                p = of_grain[q]
                other = ends[FIRST, p] ^ ends[SECOND, p] ^ g
                listed[count] = p
                # each pair once: of two struck grains the one with the smaller number lists it
                count += np.uint64((other > g) | (loaded[other] == 0))
    for c in range(contacts):
        p = np.uint32(c) if overfull else met[c]
        if (
            pairs.calendar[STRIKES, p] <= k
            and loaded[ends[FIRST, p]] == 0
            and loaded[ends[SECOND, p]] == 0
        ):
            listed[count] = p  # it approached by rounding only, or there was no room for it
            count += np.uint64(1)
    for h in range(hits):
        g = touched[h]
        kicks[g, 0] = kicks[g, 1] = 0.0
        loaded[g] = 0
    return np.int64(count)


@inline_njit
def _move(t, grains):
    """Move the grains to their positions at the time t since the search."""
    motion = grains.motion
    for g in range(motion.shape[0]):
        motion[g, X] += motion[g, VX] * t
        motion[g, Y] += motion[g, VY] * t


@njit
def _deliver(places, side, tilt, rate, grains, new_positions, new_velocities):
    """Positions, in the cell, and peculiar velocities of the grains, in the order in which they
    were given.
    """
    motion = grains.motion
    for g in range(places.size):
        given = places[g]
        new_positions[given, 0], new_positions[given, 1] = _wrapped(
            motion[g, X], motion[g, Y], side, tilt
        )
        new_velocities[given, 0], new_velocities[given, 1] = (
            motion[g, VX] - rate * motion[g, Y],
            motion[g, VY],
        )


@inline_njit
def _wrapped(x, y, side, tilt):
    """The image of a position that has x and y in [0, L), as by ``model.cell.wrap``.

    Where XLA does this, its rounding depends on the program around it.
    """
    rows = np.floor(y / side)
    rows = rows + 1.0 if y - rows * side >= side else rows
    x, y = x - rows * tilt * side, y - rows * side
    x = x - side * np.floor(x / side)
    return 0.0 if x >= side else x, 0.0 if y < 0.0 else y
