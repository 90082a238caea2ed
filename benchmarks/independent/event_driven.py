"""Event-driven simulation of hard discs in steady simple shear, with a duration of contact t_c (the
TC model).

It has no time step. Between collisions every disc moves on a straight line in the laboratory, and
every collision is carried out at its own instant. It shares no code with jaxgran, so it is a
reference for it.

A collision has the restitution α, or one if either disc has collided within the time t_c before (S.
Luding and S. McNamara, Granular Matter 1, 113, 1998). So collisions that follow closely lose no
energy, and no inelastic collapse can last. At t_c = 0 these are inelastic hard discs.

How it works: near pairs are found with a cell list. The list stands until discs may have approached
by more than its skin. The next collisions of near pairs stand in a heap. A stamp of each disc
changes when it collides, and events with an old stamp are dropped. The periodic cell is sheared
(Lees and Edwards): the image row above moves with γ̇ℓ.

Units are those of jaxgran: mean diameter σ, mass of a mean grain m, and 1/γ̇.
"""

from heapq import heappop, heappush
from typing import NamedTuple

import numpy as np
from numba import njit

# σ, added to the reach of a near pair, and the same times the packing fraction
MOST_SKIN, NARROW_SKIN = 1.0, 0.2
HEADROOM = 1.5  # a list stands until a disc is faster than this, over the fastest when it was made
LEAST_SPEED = 1e-3  # σ/t, of the fastest disc, so that the life of a list is finite
MOST_COLLISIONS = 20_000_000  # of a block, more of which are taken for a collapse

SUMS = (
    "duration",
    "kinetic_xx",  # ∫ Σ m c ⊗ c dt
    "kinetic_xy",
    "kinetic_yy",
    "contact_xx",  # Σ s ⊗ p over the collisions, s the vector between the centres
    "contact_xy",
    "contact_yy",
    "dissipation",
    "collisions",
)
DURATION, KINETIC, CONTACT, DISSIPATION, COLLISIONS = 0, 1, 4, 7, 8


class Discs(NamedTuple):
    """A sheared packing at one instant.

    ==========  ==========  ====  =================================================================
    field       shape       unit  meaning
    ==========  ==========  ====  =================================================================
    radii       (discs,)    σ     radius
    masses      (discs,)    m     mass
    positions   (discs, 2)  σ     centres
    velocities  (discs, 2)  σ/t   peculiar velocities c; in the laboratory c + γ̇ y x̂
    last        (discs,)    t     time of the last collision, now being zero
    side        ()          σ     side ℓ of the cell
    tilt        ()          –     offset of the image row above, in ℓ
    ==========  ==========  ====  =================================================================
    """

    radii: np.ndarray
    masses: np.ndarray
    positions: np.ndarray
    velocities: np.ndarray
    last: np.ndarray
    side: float
    tilt: float


class Law(NamedTuple):
    """Restitution α, duration of contact t_c and shear rate γ̇."""

    restitution: float
    contact_duration: float = 0.0
    shear_rate: float = 1.0


class _Near(NamedTuple):
    """List of near pairs, each for both of its discs: those of disc i are at the places from
    starts[i] to starts[i+1].

    ======  =================  ========================================================
    starts  (discs + 1,)       where the near discs of each begin
    discs   (places,)          the near disc
    shifts  (places, 3)        x and y of its image at time zero, and the image's velocity
    ======  =================  ========================================================
    """

    starts: np.ndarray
    discs: np.ndarray
    shifts: np.ndarray


def sheared(
    discs: Discs, law: Law, duration: float, blocks: int = 1, most_collisions: int = MOST_COLLISIONS
) -> tuple[Discs, dict[str, np.ndarray]]:
    """The discs after a time, and the sums over each of the blocks into which it is divided, arrays
    (blocks,).

    Raises:
      ValueError: the cell is too small for its discs.
      RuntimeError: the collisions of a block are too many, as in an inelastic collapse.
    """
    fraction = np.pi * np.sum(discs.radii**2) / discs.side**2
    skin = min(MOST_SKIN, NARROW_SKIN / fraction)
    # Near discs are in the same or in adjacent cells, whatever the tilt
    cells = int(discs.side / ((2 * np.max(discs.radii) + skin) * np.sqrt(1.25)))
    if cells < 3:
        raise ValueError("the cell must be at least three reaches of a disc wide: take more discs.")
    sums = np.zeros((blocks, len(SUMS)))
    law = Law(*map(float, law))
    for row in sums:
        moving = ("positions", "velocities", "last")
        discs = discs._replace(**{name: getattr(discs, name).copy() for name in moving})
        tilt = _advance(discs, law, duration / blocks, skin, cells, most_collisions, row)
        if row[COLLISIONS] >= most_collisions:
            raise RuntimeError("more collisions than can be done, as in an inelastic collapse.")
        discs = discs._replace(tilt=tilt)
    return discs, dict(zip(SUMS, sums.T, strict=True))


def averages(sums: dict[str, np.ndarray], discs: Discs) -> dict[str, np.ndarray]:
    """Temperature, total pressure and shear stress, and collisions per disc and time. Sums have any
    leading axes.
    """
    volume, count = discs.side**2 * sums["duration"], len(discs.radii)
    contact, kinetic = (sums[f"{name}_xx"] + sums[f"{name}_yy"] for name in ("contact", "kinetic"))
    return {
        "granular_temperature": kinetic / (2 * count * sums["duration"]),
        "pressure": (contact + kinetic) / (2 * volume),
        "shear_stress": -(sums["contact_xy"] + sums["kinetic_xy"]) / volume,
        "collision_rate": 2 * sums["collisions"] / (count * sums["duration"]),
    }


@njit(cache=True)
def _advance(discs, law, duration, skin, cells, most, sums):
    """Advance positions, velocities and last collisions in place, from list to list; the tilt at
    the end.
    """
    positions, velocities, rate = discs.positions, discs.velocities, law.shear_rate
    reach = 2 * np.max(discs.radii) + skin
    tilt, left = discs.tilt, duration
    while left > 0 and sums[COLLISIONS] < most:
        tilt -= np.floor(tilt + 0.5)
        near = _near_pairs(positions, discs.radii, discs.side, tilt, rate, skin, cells)
        limit = HEADROOM * max(LEAST_SPEED, np.sqrt(np.max(np.sum(velocities**2, axis=1))))
        # Two discs approach by life · (2 limit (1 + γ̇ life) + γ̇ reach) at most, less than the
        # skin as γ̇ life < ½
        life = min(left, skin / (3 * limit + rate * reach))
        velocities[:, 0] += rate * positions[:, 1]
        lived = _collide(discs, law, near, life, limit, most, sums)
        positions += velocities * lived
        velocities[:, 0] -= rate * positions[:, 1]
        discs.last[:] -= lived
        tilt += rate * lived
        left = left - lived if lived < left else 0.0
        sums[DURATION] += lived
    return tilt


@njit(cache=True)
def _near_pairs(positions, radii, side, tilt, rate, skin, cells):
    """Wraps the discs into the cell, and lists the near pairs."""
    count = len(radii)
    shares = np.empty((count, 2))  # of the sides of the sheared cell
    columns, rows = np.empty(count, np.int64), np.empty(count, np.int64)
    first, following = np.full((cells, cells), -1), np.empty(count, np.int64)
    for i in range(count):
        above = np.floor(positions[i, 1] / side)
        positions[i, 1] -= side * above
        positions[i, 0] -= side * tilt * above
        positions[i, 0] -= side * np.floor((positions[i, 0] - tilt * positions[i, 1]) / side)
        shares[i, 0] = (positions[i, 0] - tilt * positions[i, 1]) / side
        shares[i, 1] = positions[i, 1] / side
        columns[i] = int(shares[i, 0] * cells) % cells  # a share may round to one
        rows[i] = int(shares[i, 1] * cells) % cells
        following[i] = first[columns[i], rows[i]]
        first[columns[i], rows[i]] = i
    starts = np.zeros(count + 1, np.int64)
    near, shifts = [0], [(0.0, 0.0, 0.0)]  # one place for the types, which is left out
    for i in range(count):
        for cell in range(9):
            j = first[(columns[i] + cell % 3 - 1) % cells, (rows[i] + cell // 3 - 1) % cells]
            while j >= 0:
                right = np.round(shares[i, 0] - shares[j, 0])
                up = np.round(shares[i, 1] - shares[j, 1])
                dx, dy = side * (right + tilt * up), side * up
                x = positions[i, 0] - positions[j, 0] - dx
                y = positions[i, 1] - positions[j, 1] - dy
                if i != j and x * x + y * y < (radii[i] + radii[j] + skin) ** 2:
                    near.append(j)
                    shifts.append((dx, dy, rate * dy))
                j = following[j]
        starts[i + 1] = len(near) - 1
    return _Near(starts, np.array(near)[1:], np.array(shifts)[1:])


@njit(cache=True)
def _collide(discs, law, near, life, limit, most, sums):
    """All collisions during the life of a list, and the time that it has lived.

    A disc is at position + velocity · time, with velocities of the laboratory. Both change when it
    collides.
    """
    masses, origins, velocities, last = discs.masses, discs.positions, discs.velocities, discs.last
    tc, rate = law.contact_duration, law.shear_rate
    stamps = np.zeros(len(masses), np.int64)
    since = np.zeros(len(masses))  # time up to which the kinetic stress of a disc is summed
    heap = [(0.0, 0, 0, 0, 0)]  # time, disc, place in the list, stamps of both discs
    heap.pop()
    for i in range(len(masses)):
        _predict(heap, discs, near, stamps, i, 0.0, life)
    while len(heap) > 0 and sums[COLLISIONS] < most:
        now, i, place, stamp_i, stamp_j = heappop(heap)
        j = near.discs[place]
        if stamps[i] != stamp_i or stamps[j] != stamp_j:
            continue
        sx, sy, ux, uy = _relative(origins, velocities, near, i, place, now)
        distance = np.sqrt(sx * sx + sy * sy)
        nx, ny = sx / distance, sy / distance
        approach = ux * nx + uy * ny
        soft = now - last[i] < tc or now - last[j] < tc
        restitution = 1.0 if soft else law.restitution
        reduced = masses[i] * masses[j] / (masses[i] + masses[j])
        impulse = -(1 + restitution) * reduced * approach
        sums[CONTACT] += impulse * nx * sx
        sums[CONTACT + 1] += impulse * nx * sy
        sums[CONTACT + 2] += impulse * ny * sy
        sums[DISSIPATION] += (1 - restitution * restitution) / 2 * reduced * approach * approach
        sums[COLLISIONS] += 1
        too_fast = False
        for disc, push in ((i, impulse), (j, -impulse)):
            origin, velocity = origins[disc], velocities[disc]
            _add_kinetic(sums, masses[disc], origin, velocity, since[disc], now, rate)
            for axis, change in ((0, push * nx / masses[disc]), (1, push * ny / masses[disc])):
                origin[axis] -= change * now
                velocity[axis] += change
            since[disc], last[disc] = now, now
            stamps[disc] += 1
            peculiar = velocity[0] - rate * (origin[1] + velocity[1] * now)
            too_fast = too_fast or peculiar**2 + velocity[1] ** 2 > limit * limit
        if too_fast:
            life = now
            break
        for disc in (i, j):
            _predict(heap, discs, near, stamps, disc, now, life)
    for i in range(len(masses)):
        _add_kinetic(sums, masses[i], origins[i], velocities[i], since[i], life, rate)
    return life


@njit(cache=True)
def _predict(heap, discs, near, stamps, i, now, life):
    """Puts the collisions of a disc with its near ones into the heap, those that come in the life
    of the list.
    """
    for place in range(near.starts[i], near.starts[i + 1]):
        j = near.discs[place]
        sx, sy, ux, uy = _relative(discs.positions, discs.velocities, near, i, place, now)
        closing = sx * ux + sy * uy
        excess = sx * sx + sy * sy - (discs.radii[i] + discs.radii[j]) ** 2
        discriminant = closing * closing - (ux * ux + uy * uy) * excess
        if closing < 0 and discriminant >= 0:
            time = now + max(0.0, excess / (np.sqrt(discriminant) - closing))
            if time < life:
                heappush(heap, (time, i, place, stamps[i], stamps[j]))


@njit(cache=True)
def _relative(origins, velocities, near, i, place, now):
    """Separation and relative velocity of a disc and the image of a near one."""
    j = near.discs[place]
    ux = velocities[i, 0] - velocities[j, 0] - near.shifts[place, 2]
    uy = velocities[i, 1] - velocities[j, 1]
    sx = origins[i, 0] - origins[j, 0] - near.shifts[place, 0] + ux * now
    sy = origins[i, 1] - origins[j, 1] - near.shifts[place, 1] + uy * now
    return sx, sy, ux, uy


@njit(cache=True)
def _add_kinetic(sums, mass, origin, velocity, start, end, rate):
    """∫ m c ⊗ c dt along a straight line, where c is linear in time: Simpson's rule is exact."""
    for time, weight in ((start, 1.0), ((start + end) / 2, 4.0), (end, 1.0)):
        cx = velocity[0] - rate * (origin[1] + velocity[1] * time)
        share = weight / 6 * mass * (end - start)
        sums[KINETIC] += share * cx * cx
        sums[KINETIC + 1] += share * cx * velocity[1]
        sums[KINETIC + 2] += share * velocity[1] * velocity[1]
