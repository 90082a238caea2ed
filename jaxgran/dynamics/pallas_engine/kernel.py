"""The engine for NVIDIA GPUs: the advance of one replica as one kernel, with a thread for each grain.

The engine ``Jax`` starts a few dozen kernels in every step that it visits, and a batch waits for its slowest replica at
each. Here all steps are in one kernel, written in Pallas. A replica goes at its own pace, and its numbers stay in
registers and in the nearest caches.

- *A grain is a thread.* Every array has an entry for each thread. What a thread has written it reads without waiting.
  It reads of other grains what all threads write at the same time, with a barrier before and after.
- *Every pair is computed twice*, once from each of its grains, with separations, normals and impulses that are equal
  and opposite to the bit. Sums over the contacts of a grain are sums of its thread, in a fixed order. No two threads
  add to the same number, so results are the same from run to run.
- *Pairs are computed again, not stored.* A thread goes through the list of its near grains, one after the other. The
  loops end at the longest of these lists.
- *Few contacts, little work.* Two grains that touch no other have a closed form. The other contacts go through the
  default method of ``contact.projected_methods``.

The interpreter of Pallas runs the kernel on any machine, which is how it is tested. On NVIDIA GPUs Triton compiles it.
The number of warps is that of the grains over 32, so that each thread holds one grain.
"""

import math
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton
from jaxtyping import Array, Int

from jaxgran.contact.law import first_step, flight_of, gap_coefficients, kinetic_means, overlaps_within, time_to_touch
from jaxgran.contact.projected_methods import BarzilaiBorwein, ProjectedMethod
from jaxgran.dynamics.jax_engine import ended
from jaxgran.dynamics.pallas_engine.memory import (
    APPROACH,
    CX,
    CY,
    DISTANCE,
    GIVEN,
    INVERSE_MASS,
    KINETIC,
    NEAR,
    NX,
    NY,
    RADIUS,
    RESIDUALS,
    SUMS,
    Block,
    Counts,
    Flow,
    Motion,
    Thread,
    X,
    Y,
    results,
    status_if,
)
from jaxgran.dynamics.pallas_engine.solver import collided
from jaxgran.dynamics.tally import LAYOUT, RESIDUAL_EDGES, RunningSums, Tally, sums_from_row
from jaxgran.model.cell import remap_tilt, wrap
from jaxgran.model.flow import ShearFlow
from jaxgran.model.grains import Grains
from jaxgran.model.state import State
from jaxgran.model.status import Status

_FEWEST_THREADS, _WARP = 64, 32  # a thread for each bin of the residuals
_PAIRS_PER_GRAIN = 2.7  # expected within the skin
_NARROWER = 12  # lists that are tried with ever narrower skins, where a grain has more near grains than that
_LIFE = 0.1  # strain: the longest life of a list, in which a peculiar speed grows by 1.1 at most
_MANY = 2.0**30  # steps of a flight


class _Lists(NamedTuple):
    """The lists of near grains: lengths and the largest of them, tilt at the search, and strain and time since."""

    near: Array
    longest: Array
    tilt: Array
    strain: Array
    age: Array
    skin: Array
    slack: Array  # of the skin


class _Carry(NamedTuple):
    motion: Motion
    lists: _Lists
    step: Array
    solved: Array  # whether the contacts of the present step have been dealt with
    status: Array
    counts: Counts


def advance_by_pallas(
    flow: ShearFlow, solver: ProjectedMethod, state: State, steps: Int[Array, ""], interpret: bool = False
) -> tuple[State, Tally]:
    """Advance one replica of up to 1024 grains; under ``vmap`` a thread block is a replica.

    Args:
      flow, solver, state, steps: as in ``dynamics.advance``.
      interpret: whether the kernel is interpreted, on any backend.
    """
    dtype, count = state.positions.dtype, flow.grains
    threads = max(_FEWEST_THREADS, 1 << (count - 1).bit_length())
    radii, masses, side = state.grains.radii, state.grains.masses, state.side
    largest = 2 * jnp.max(radii)
    widest = jnp.maximum(side / 2 - largest, 1e-3)  # nearest images are unique
    expected = jnp.sqrt(2 * _PAIRS_PER_GRAIN * side * side / (np.pi * count)) - 1
    usual = jnp.minimum(jnp.maximum(expected, 0.05), widest)
    numbers = (side, state.tilt, flow.restitution, flow.timestep, flow.shear_rate, solver.tolerance)
    numbers = (*numbers, flow.activation_fraction, largest, usual, widest, jnp.finfo(dtype).eps)
    given = jnp.stack([*state.positions.T, *state.velocities.T, radii, 1 / masses])
    edges = np.full((2, threads), np.inf)
    edges[:, : RESIDUAL_EDGES.size - 1] = RESIDUAL_EDGES[:-1], RESIDUAL_EDGES[1:]
    edges[0, 0], edges[1, RESIDUAL_EDGES.size - 2] = -1, np.inf

    call = pl.pallas_call(
        partial(_kernel, grains=count, interpret=interpret),
        out_shape=results(threads, dtype),
        interpret=interpret,
        compiler_params=triton.CompilerParams(num_warps=threads // _WARP, num_stages=1),
        name="jaxgran_advance",
    )
    moved, totals, status, sums, *_ = call(
        jnp.stack([jnp.asarray(x).astype(dtype) for x in numbers]),
        jnp.stack([jnp.asarray(x).astype(jnp.int32) for x in (solver.max_steps, steps, int(Status.ok))]),
        jnp.pad(given, ((0, 0), (0, threads - count))),
        jnp.asarray(edges, dtype),
    )
    x, y, cx, cy = moved[:, :count]
    idle = steps == 0  # as it was, to the bit
    positions = jnp.where(idle, state.positions, wrap(jnp.stack([x, y], axis=-1), side, totals[-1]))
    velocities = jnp.where(idle, state.velocities, jnp.stack([cx, cy], axis=-1))
    return ended(state, positions, totals[-1], velocities, _sums(totals, sums[RESIDUALS], status[0]))


def trial(grains: int, dtype: jnp.dtype) -> None:
    """Let a dense lattice collide on the device at hand; raises a RuntimeError where a law of contacts does not hold.

    The numbers of neighbours are far apart, so that grains of all threads touch. Momentum and energy are added up
    outside of the kernel.
    """
    rng, row = np.random.default_rng(0), math.isqrt(grains - 1) + 1
    places = rng.permutation(1.02 * np.stack(np.divmod(np.arange(grains), row), axis=-1) + 0.5)
    speeds = 2 * rng.normal(size=(grains, 2))
    numbers = (np.full(grains, 0.5), np.ones(grains), places, speeds - speeds.mean(0), 1.02 * row, 0.0)
    radii, masses, *others = (jnp.asarray(x, dtype) for x in numbers)
    flow, solver = ShearFlow(grains, 0.2, 0.7, 1e-2), BarzilaiBorwein(tolerance=1e-5)
    _, tally = jax.jit(advance_by_pallas)(flow, solver, State(Grains(radii, masses), *others), jnp.int32(30))
    work = -(tally.kinetic_moment[0, 1] + tally.contact_moment[0, 1])
    few = 1e-3 if dtype == jnp.float32 else 1e-8
    laws = {
        "momentum": tally.momentum_drift <= few,
        "energy": abs(work - tally.dissipation - tally.energy_change) <= few * tally.dissipation,
        "the contact law": abs(tally.complementarity) <= 1e-3 * tally.dissipation,
        "overlaps": tally.largest_overlap <= 0.2,
        "clusters": (tally.iterations > 2 * tally.solves) & (tally.status <= Status.deep_overlap),
    }
    wrong = [name for name, holds in laws.items() if not holds]
    if wrong:
        raise RuntimeError(f"it fails in {', '.join(wrong)}")


def _sums(totals: Array, counts: Array, status: Array) -> RunningSums:
    """The running sums of an advance from what the kernel returns; the counts by residual come from the grains."""
    bins = LAYOUT["residual_counts"]
    counts = counts[: bins.stop - bins.start]
    return sums_from_row(jnp.concatenate([totals[: bins.start], counts, totals[bins.start : -1]]), status)


def _kernel(*memory: Any, grains: int, interpret: bool) -> None:
    """All steps of one replica."""
    block = Block(*memory)
    flow = Flow(
        *(block.numbers[n] for n in range(block.numbers.size)), *(block.whole[n] for n in range(block.whole.size))
    )
    threads = block.given.shape[1]
    number = lax.broadcasted_iota(jnp.int32, (threads,), 0)
    given = [block.given[row, :] for row in range(GIVEN)]
    thread = Thread(
        number, given[RADIUS], given[INVERSE_MASS], block, flow, (lambda: None) if interpret else triton.debug_barrier
    )
    x, y, cx, cy = given[:4]
    finite = (abs(x) < jnp.inf) & (abs(y) < jnp.inf) & (abs(cx) < jnp.inf) & (abs(cy) < jnp.inf)
    zero, nothing = jnp.zeros_like(x), jnp.zeros_like(flow.side)
    block.moved[X, :], block.moved[Y, :] = x, y
    for row in range(SUMS):
        block.sums[row, :] = zero
    carry = _Carry(
        motion=Motion(zero, zero, cx, cy),
        lists=_Lists(jnp.zeros_like(number), jnp.int32(0), flow.tilt, nothing, nothing, nothing, nothing - 1),
        step=jnp.int32(0),
        solved=jnp.int32(0),
        status=status_if(jnp.min(finite.astype(jnp.int32)) == 0, Status.nonfinite),
        counts=Counts(*[nothing] * 6),
    )
    end = lax.while_loop(
        lambda now: (now.step < flow.steps) & (now.status < int(Status.capacity)),
        partial(_event, thread, grains),
        carry,
    )
    for row, value in enumerate((*_positions(thread, end.motion, end.lists), end.motion.cx, end.motion.cy)):
        block.moved[row, :] = value
    sums = [jnp.sum(block.sums[row, :]) for row in range(RESIDUALS)]
    contacts, kinetic = [total / 2 for total in sums[:KINETIC]], sums[KINETIC:]  # each contact was seen twice
    time, *solves = end.counts
    tilt = remap_tilt(end.lists.tilt + end.lists.strain)
    for n, value in enumerate([time, end.step.astype(x.dtype), *kinetic, *contacts, *solves, tilt]):
        block.totals[n] = value
    block.status[0] = end.status


def _event(thread: Thread, grains: int, now: _Carry) -> _Carry:
    """Go on to the next step in which something happens: a contact, or the end of a list's life."""
    flow = thread.flow
    dt, rate = flow.timestep, flow.shear_rate
    ahead, life = flow.activation_fraction * dt, _LIFE / rate
    fastest = _fastest(now.motion)

    loss = _loss(fastest, rate, flow.largest + now.lists.skin)
    worn = ~(now.lists.slack - loss * ahead >= loss * dt)
    aged = (now.lists.age > 0) & (now.lists.age + dt > life)
    motion, lists, crowded = lax.cond(
        worn | aged,
        partial(_search, thread, grains, fastest),
        lambda motion, lists: (motion, lists, flow.ok),
        now.motion,
        now.lists,
    )
    loss = _loss(fastest, rate, flow.largest + lists.skin)

    least = now.solved.astype(dt.dtype)
    spare = jnp.minimum((lists.slack - loss * ahead) / loss, life - lists.age)
    jump = jnp.minimum(_steps_to_contact(thread, motion, lists, least), jnp.floor(spare / dt))
    jump = jnp.where((jump > least) & (loss < jnp.inf), jnp.minimum(jump, _MANY), least)  # this where it is no number
    jump = jnp.minimum(jump.astype(jnp.int32), flow.steps - now.step)
    flight, step = jump.astype(dt.dtype) * dt, now.step + jump
    counts = _add_flight(thread, now.counts, motion, flight)
    dx, dy, cx = flight_of(motion.cx, motion.cy, lists.strain, flight, rate)
    flown = Motion(motion.x + dx, motion.y + dy, cx, motion.cy)

    flown, counts, status = lax.cond(
        step < flow.steps,
        lambda: _collide(thread, motion, flown, lists, flight, counts),
        lambda: (flown, counts, flow.ok),
    )
    flown = Motion(*thread.publish((X, Y, CX, CY), flown))
    lists = lists._replace(
        strain=lists.strain + rate * flight, age=lists.age + flight, slack=lists.slack - loss * flight
    )
    torn = lists.slack - loss * ahead < -16 * flow.epsilon * lists.skin
    found = (status_if(torn, Status.capacity), status_if(~(loss < jnp.inf), Status.nonfinite), crowded, now.status)
    for other in found:
        status = jnp.maximum(status, other)
    return _Carry(flown, lists, step, (step < flow.steps).astype(jnp.int32), status, counts)


def _fastest(motion: Motion) -> Array:
    """The largest peculiar speed, infinite where one is no number."""
    squared = motion.cx * motion.cx + motion.cy * motion.cy
    return jnp.sqrt(jnp.max(jnp.where(squared < jnp.inf, squared, jnp.inf)))


def _loss(fastest: Array, rate: Array, distance: Array) -> Array:
    """How much of its skin a list may lose in unit time, where pairs are within a distance."""
    return 2 * fastest * (1 + _LIFE) + rate * distance / 2


def _positions(thread: Thread, motion: Motion, lists: _Lists) -> tuple[Array, Array]:
    """Where the grains are, not wrapped."""
    y = thread.block.moved[Y, :] + motion.y
    return thread.block.moved[X, :] + motion.x + lists.strain * y, y


def _search(thread: Thread, count: int, fastest: Array, motion: Motion, lists: _Lists) -> tuple[Motion, _Lists, Array]:
    """No displacements from wrapped positions, the lists of near grains, and capacity where they had no room."""
    flow, number, block = thread.flow, thread.number, thread.block
    side, tilt = flow.side, remap_tilt(lists.tilt + lists.strain)
    x, y = _positions(thread, motion, lists)
    rows = jnp.floor(y / side)
    x, y = x - rows * tilt * side, y - rows * side
    x, y = thread.publish((X, Y), (x - jnp.floor((x - tilt * y) / side) * side, y))
    block.moved[X, :], block.moved[Y, :] = x, y

    def listed(skin: Array) -> Array:
        """Write the lists of a skin; returns their lengths, of which not more than ``NEAR`` are there."""

        def visit(other: Array, near: Array) -> Array:
            dx, dy = x - block.shared[X, other], y - block.shared[Y, other]
            row = jnp.floor(dy / side + 0.5)
            dx, dy = dx - row * tilt * side, dy - row * side
            dx = dx - jnp.floor(dx / side + 0.5) * side
            limit = thread.radius + block.given[RADIUS, other] + skin
            close = (dx * dx + dy * dy < limit * limit) & (other != number) & (number < count)
            room = close & (near < NEAR)
            place = jnp.where(room, near, 0)
            thread.write(block.near, place, value=jnp.full_like(number, 0) + other, mask=room)
            thread.write(block.apart, X, place, value=dx, mask=room)
            thread.write(block.apart, Y, place, value=dy, mask=room)
            return near + close.astype(jnp.int32)

        return lax.fori_loop(0, count, visit, jnp.zeros_like(number))

    def narrowed(at: tuple[Array, ...]) -> tuple[Array, ...]:
        tried, skin, *_ = at
        near = listed(0.7 * skin)
        return tried + 1, 0.7 * skin, near, jnp.max(near)

    reached = (1 + flow.activation_fraction) * flow.timestep  # in one step, and what that looks ahead
    needed = 1.2 * (2 * fastest * (1 + _LIFE) + flow.shear_rate * flow.largest) * reached
    skin = jnp.minimum(jnp.maximum(needed, flow.usual), flow.widest)
    near = listed(skin)
    _, skin, near, longest = lax.while_loop(
        lambda at: (at[0] < _NARROWER) & (at[3] > NEAR), narrowed, (jnp.int32(1), skin, near, jnp.max(near))
    )
    at_rest = Motion(*thread.publish((X, Y, CX, CY), (jnp.zeros_like(x), jnp.zeros_like(y), motion.cx, motion.cy)))
    lists = _Lists(jnp.minimum(near, NEAR), jnp.minimum(longest, NEAR), tilt, 0 * side, 0 * side, skin, skin)
    return at_rest, lists, status_if(longest > NEAR, Status.capacity)


class _Pair(NamedTuple):
    """One near pair of each thread: whether there is one, the other grain, separation, relative velocity, and reach."""

    real: Array
    other: Array
    x: Array
    y: Array
    ux: Array
    uy: Array
    reach: Array

    def after(self, flight: Array) -> "_Pair":
        return self._replace(x=self.x + self.ux * flight, y=self.y + self.uy * flight)

    def gap(self) -> tuple[Array, Array, Array]:
        return gap_coefficients(self.x, self.y, self.ux, self.uy, self.reach)


def _pair(thread: Thread, k: Array, motion: Motion, lists: _Lists) -> _Pair:
    """The k-th near pair of each thread, with the motion that all have reported."""
    block, rate = thread.block, thread.flow.shear_rate
    real = k < lists.near
    other = thread.read(block.near, k, mask=real)
    x, y, cx, cy = (thread.gather(block.shared, row, other, real) for row in (X, Y, CX, CY))
    y = thread.read(block.apart, Y, k, mask=real) + (motion.y - y)
    x = thread.read(block.apart, X, k, mask=real) + (motion.x - x) + lists.strain * y
    reach = thread.radius + thread.gather(block.given, RADIUS, other, real)
    return _Pair(real, other, x, y, motion.cx - cx + rate * y, motion.cy - cy, reach)


def _steps_to_contact(thread: Thread, motion: Motion, lists: _Lists, least: Array) -> Array:
    """Steps, at least ``least``, after which some pair first is an approaching contact; may be infinite."""
    flow = thread.flow

    def sooner(k: Array, soonest: Array) -> Array:
        pair = _pair(thread, k, motion, lists)
        time, closest = time_to_touch(*pair.gap())
        steps = jnp.maximum(first_step(time, flow.timestep, flow.activation_fraction), least)
        return jnp.where(pair.real & (steps * flow.timestep < closest), jnp.minimum(soonest, steps), soonest)

    return jnp.min(lax.fori_loop(0, lists.longest, sooner, jnp.full_like(motion.x, jnp.inf)))


def _add_flight(thread: Thread, counts: Counts, motion: Motion, flight: Array) -> Counts:
    """The counts with the time of a flight; ∫ m c ⊗ c dt along it goes to the sums."""
    cx, cy, real = motion.cx, motion.cy, thread.inverse_mass > 0
    weight = jnp.where(real, flight / jnp.where(real, thread.inverse_mass, 1), 0)
    means = kinetic_means(cx * cx, cx * cy, cy * cy, thread.flow.shear_rate * flight)
    thread.add(KINETIC, [weight * mean for mean in means])
    return counts._replace(time=counts.time + flight)


def _collide(
    thread: Thread, reported: Motion, motion: Motion, lists: _Lists, flight: Array, counts: Counts
) -> tuple[Motion, Counts, Array]:
    """Motion and counts after the contacts of one step, and its status; unchanged where no contact approaches.

    ``reported`` is the motion before the flight that led to the step, which is what other threads know of it.
    """
    flow, block = thread.flow, thread.block

    def visit(k: Array, found: tuple[Array, ...]) -> tuple[Array, ...]:
        """Write a pair down if it is a contact."""
        contacts, approached, scale, deepest = found
        pair = _pair(thread, k, reported, lists).after(flight)
        contact, approaching = overlaps_within(*pair.gap(), flow.activation_fraction * flow.timestep)
        contact = contact & pair.real
        distance = jnp.sqrt(pair.x * pair.x + pair.y * pair.y)
        nx, ny = pair.x / distance, pair.y / distance
        approach = nx * pair.ux + ny * pair.uy
        place = jnp.where(contact, contacts, 0)
        thread.write(block.partners, place, value=pair.other, mask=contact)
        for row, value in ((NX, nx), (NY, ny), (APPROACH, approach), (DISTANCE, distance)):
            thread.write(block.network, row, place, value=value, mask=contact)
        return (
            contacts + contact.astype(jnp.int32),
            jnp.maximum(approached, (contact & approaching).astype(jnp.int32)),
            scale + jnp.where(contact, jnp.minimum(approach, 0) * approach, 0),
            jnp.maximum(deepest, jnp.where(contact, pair.reach - distance, 0)),
        )

    zero, none = jnp.zeros_like(motion.x), jnp.zeros_like(lists.near)
    contacts, approached, scale, deepest = lax.fori_loop(0, lists.longest, visit, (none, none, zero, zero))
    return lax.cond(
        jnp.max(approached) > 0,
        lambda: collided(thread, motion, contacts, jnp.sum(scale) / 2, jnp.max(deepest), counts),
        lambda: (motion, counts, flow.ok),
    )
