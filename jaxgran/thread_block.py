"""The advance of one replica as one thread block of an accelerator: a grain is a thread, and a launch is many steps.

XLA starts a few dozen kernels for every step that is visited, and a batch waits for its slowest replica at each. This is
the plain advance of ``dynamics`` with all its steps in one kernel, written in Pallas: a replica goes at its own pace,
and what it works on stays in registers and in the caches beside them.

- *A grain is a thread.* Every array has an entry for each thread, so what a thread has written it reads without
  waiting. It learns of other grains through ``shared``, between two barriers.
- *Every pair is seen twice*, once from each of its grains, with separations, normals and impulses that are equal and
  opposite to the bit: sums over the contacts of a grain are sums of its thread, in a fixed order, and nothing is ever
  added up by several threads at once. Results are the same from run to run.
- *Pairs are computed again, not stored*: a thread goes through the list of its near grains, one after the other, and
  the loops end at the longest list that there is at present.
- *Few contacts, little work*: two grains that touch nobody else have a closed form; what is left goes through the
  default of ``methods``, of which only contacts are part.

The kernel runs as it is in the interpreter of Pallas, on any machine, which is how it is tested; on accelerators Triton
compiles it.
"""

import math
import warnings
from collections.abc import Callable, Sequence
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton
from jaxtyping import Array, Int

from jaxgran.cell import wrap
from jaxgran.contacts import overlaps_within, time_to_touch
from jaxgran.dynamics import DEEP_OVERLAP, State, ended
from jaxgran.flow import ShearFlow
from jaxgran.grains import Grains
from jaxgran.methods import LONGEST_STRIDE, PROGRESS, WINDOW
from jaxgran.solver import JAMMED_RESPONSE
from jaxgran.status import Status
from jaxgran.tally import RESIDUAL_EDGES, Sums, Tally, empty_sums

MOST_GRAINS = 1024  # threads of a block
_FEWEST_THREADS, _WARP = 64, 32  # a thread for each bin of the residuals
_NEAR = 20  # near grains that a grain has room for
_PAIRS_PER_GRAIN = 2.7  # expected within the skin
_NARROWER = 12  # lists that are tried with ever narrower skins, where a grain has more near grains than that
_LIFE = 0.1  # strain: the longest life of a list, in which a peculiar speed grows by 1.1 at most
_ROW, _COLUMN, _CENTRE = 12, 15, 4  # bits of an entry of a list, above the grain: row and column of its image, plus 4

_NUMBERS = 11  # in the order of ``_Flow``
_X, _Y, _VX, _VY, _RADIUS, _INVERSE_MASS = range(6)  # rows of what is given; the first four are those of ``shared`` too
_PULL_X, _PULL_Y, _WIDTH, _SHARED = range(4, 8)  # velocity changes by impulses, and eigenvalues of the spectral bound
_TOUCHING, _LOADED = range(2)  # rows of the counts
_NX, _NY, _APPROACH, _DISTANCE, _IMPULSE, _RESPONSE, _STEP, _CHANGE, _BEST, _BOUND, _ROWS = range(11)  # of the network
_CONTACT_SUMS, _KINETIC, _RESIDUALS, _SUMS = 17, 17, 20, 21  # rows of the sums: of contacts, of flights, of solves


class _Flow(NamedTuple):
    """Numbers of the flow, and of its lists: the largest diameter, and the usual and the widest skin."""

    side: Array
    tilt: Array
    restitution: Array
    timestep: Array
    shear_rate: Array
    tolerance: Array
    ahead: Array  # share of a step that a contact may lie ahead
    largest: Array
    usual: Array
    widest: Array
    epsilon: Array
    max_iterations: Array
    steps: Array
    ok: Array  # the status, for branches: Triton's want a value, not a constant


class _Block(NamedTuple):
    """Memory of a thread block; ``threads`` is the number of grains, filled up to a power of two."""

    numbers: Any  # (11,)
    whole: Any  # (3,): most iterations, steps, and the status ok
    given: Any  # (6, threads): positions, peculiar velocities, radii, inverse masses
    bins: Any  # (2, threads): bounds of the bins of the residuals
    moved: Any  # (4, threads): positions and peculiar velocities at the end
    totals: Any  # (27,): sums over all grains, and the tilt
    state: Any  # (1,): status
    sums: Any  # (21, threads): what each grain adds to the sums, and the solves by residual
    shared: Any  # (7, threads): what grains tell each other
    counts: Any  # (2, threads): the same of counts
    near: Any  # (near, threads): near grains and their images
    partners: Any  # (near, threads): grains in contact
    network: Any  # (10, near, threads): the contacts


class _Thread(NamedTuple):
    """What a thread knows: its number, the grain's radius and inverse mass, the memory of the block, how to wait."""

    number: Array
    radius: Array
    inverse_mass: Array
    block: _Block
    flow: _Flow
    wait: Callable[[], None]

    def tell(self, rows: Sequence[int], values: Sequence[Array]) -> None:
        """Write what other threads may ask for: numbers to ``shared``, whole numbers to ``counts``."""
        self.wait()
        for row, value in zip(rows, values, strict=True):
            memory = self.block.counts if value.dtype == jnp.int32 else self.block.shared
            memory[row, :] = value
        self.wait()

    def add(self, row: int, values: Sequence[Array]) -> None:
        """Add to the sums of the thread, from a row on."""
        for n, value in enumerate(values, row):
            self.block.sums[n, :] = self.block.sums[n, :] + value

    def ask(self, memory: Any, row: int, other: Array, mask: Array) -> Array:
        """What other threads have told, zero where the mask is not set."""
        return triton.load(memory.at[row, other], mask=mask, other=0)

    def read(self, memory: Any, *place: Any, mask: Array) -> Array:
        return triton.load(memory.at[*place, self.number], mask=mask, other=0)

    def write(self, memory: Any, *place: Any, value: Array, mask: Array) -> None:
        triton.store(memory.at[*place, self.number], value, mask=mask)


class _Grains(NamedTuple):
    """Positions and laboratory velocities, one of each a thread."""

    x: Array
    y: Array
    vx: Array
    vy: Array


class _Lists(NamedTuple):
    """The lists of near grains: how many, at most and of each; the tilt then, the age, the skin and what is left of it."""

    longest: Array
    near: Array
    tilt: Array
    age: Array
    skin: Array
    slack: Array


class _Counts(NamedTuple):
    """Sums of the advance that are not one for each grain: time, and what there is of solves."""

    time: Array
    networks: Array
    iterations: Array
    unconverged: Array
    overlap: Array  # the deepest one
    residual: Array  # the worst one


class _Carry(NamedTuple):
    grains: _Grains
    lists: _Lists
    step: Array
    solved: Array  # whether the contacts of the present step have been dealt with
    status: Array
    counts: _Counts


def advance(flow: ShearFlow, state: State, steps: Int[Array, ""], interpret: bool = False) -> tuple[State, Tally]:
    """Advance one replica of up to 1024 grains, as ``dynamics.advance`` does; under ``vmap`` a block is a replica.

    Args:
      flow, state, steps: as there; the method of the contact solve is the default one.
      interpret: whether the kernel is interpreted, on any backend.
    """
    dtype, count = state.positions.dtype, flow.grains
    threads = max(_FEWEST_THREADS, 1 << (count - 1).bit_length())
    radii, masses, side = state.grains.radii, state.grains.masses, state.side
    largest = 2 * jnp.max(radii)
    widest = jnp.maximum(side / 2 - largest, 1e-3)  # nearest images are unique
    expected = jnp.sqrt(2 * _PAIRS_PER_GRAIN * side * side / (np.pi * count)) - 1
    usual = jnp.minimum(jnp.maximum(expected, 0.05), widest)
    numbers = (side, state.tilt, flow.restitution, flow.timestep, flow.shear_rate, flow.tolerance)
    numbers = (*numbers, flow.activation_fraction, largest, usual, widest, jnp.finfo(dtype).eps)
    given = jnp.stack([*state.positions.T, *state.velocities.T, radii, 1 / masses])
    edges = np.full((2, threads), np.inf)
    edges[:, : RESIDUAL_EDGES.size - 1] = RESIDUAL_EDGES[:-1], RESIDUAL_EDGES[1:]
    edges[0, 0], edges[1, RESIDUAL_EDGES.size - 2] = -1, np.inf

    def memory(*shape: int, kind: Any = dtype) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct(shape, kind)

    results = [
        memory(4, threads),
        memory(32),
        memory(1, kind=jnp.int32),
        memory(_SUMS, threads),
        memory(_SHARED, threads),
        memory(2, threads, kind=jnp.int32),
        memory(_NEAR, threads, kind=jnp.int32),
        memory(_NEAR, threads, kind=jnp.int32),
        memory(_ROWS, _NEAR, threads),
    ]
    call = pl.pallas_call(
        partial(_kernel, grains=count, interpret=interpret),
        out_shape=results,
        interpret=interpret,
        compiler_params=triton.CompilerParams(num_warps=threads // _WARP),
        name="jaxgran_advance",
    )
    moved, totals, status, sums, *_ = call(
        jnp.stack([jnp.asarray(x).astype(dtype) for x in numbers]),
        jnp.stack([jnp.asarray(x).astype(jnp.int32) for x in (flow.max_iterations, steps, int(Status.ok))]),
        jnp.pad(given, ((0, 0), (0, threads - count))),
        jnp.asarray(edges, dtype),
    )
    x, y, cx, cy = moved[:, :count]
    idle = steps == 0  # as it was, to the bit
    positions = jnp.where(idle, state.positions, wrap(jnp.stack([x, y], axis=-1), side, totals[27]))
    velocities = jnp.where(idle, state.velocities, jnp.stack([cx, cy], axis=-1))
    return ended(state, positions, totals[27], velocities, _sums(totals, sums[_RESIDUALS], status[0]))


@cache
def serves(grains: int, dtype: jnp.dtype) -> bool:
    """Whether the kernel runs on the device at hand: tried once, on two grains that meet head on among others at rest."""
    if grains > MOST_GRAINS:
        return False
    row = math.isqrt(grains - 1) + 1
    places = 5.0 * np.stack([np.arange(grains) % row, np.arange(grains) // row], axis=-1) + 1
    places[1, 0] = 2.5
    speeds = np.zeros((grains, 2))
    speeds[:2, 0] = 1, -1
    flow = ShearFlow(grains, 0.5, 0.03, 1e-2, shear_rate=0.0)
    try:
        with jax.ensure_compile_time_eval():
            numbers = (jnp.asarray(x, dtype) for x in (places, speeds, 5 * row, 0))
            state = State(Grains(jnp.full(grains, 0.5, dtype), jnp.ones(grains, dtype)), *numbers)
            after, tally = jax.jit(advance)(flow, state, jnp.int32(50))
        right = np.allclose(after.velocities, -flow.restitution * speeds, atol=1e-5) and tally.collisions == 1
        problem = "" if right else "it gets a collision wrong"
    except Exception as error:  # of a compiler, a driver or a device: there is no saying which
        problem = f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
    if problem:
        warnings.warn(f"flows take the plain advance: the kernel for GPUs does not run here ({problem}).", stacklevel=2)
    return not problem


def _sums(totals: Array, residuals: Array, status: Array) -> Sums:
    """The sums of an advance from what the kernel returns: ``_CONTACT_SUMS`` first, then flights and solves."""
    of, rest = totals[:_CONTACT_SUMS], totals[_CONTACT_SUMS:]
    empty = empty_sums(totals.dtype)
    contacts = empty.contacts.at[0].set(of[:5]).at[1:4, 0].set(of[5:8]).at[1:4, 1].set(of[8:11])
    contacts = contacts.at[4, 0].set(of[14]).at[6, 0].set(of[15]).at[5, 2].set(of[16])
    return empty._replace(
        flights=rest[:5],
        contacts=contacts,
        clusters=of[11:14],
        solves=jnp.concatenate([rest[5:8], residuals[: RESIDUAL_EDGES.size - 1]]),
        largest=rest[8:10],
        status=status,
    )


def _kernel(*memory: Any, grains: int, interpret: bool) -> None:
    """All steps of one replica."""
    block = _Block(*memory)
    flow = _Flow(*(block.numbers[n] for n in range(_NUMBERS)), *(block.whole[n] for n in range(3)))
    threads = block.given.shape[1]
    number = lax.broadcasted_iota(jnp.int32, (threads,), 0)
    given = [block.given[row, :] for row in range(6)]
    thread = _Thread(
        number, given[_RADIUS], given[_INVERSE_MASS], block, flow, (lambda: None) if interpret else triton.debug_barrier
    )
    x, y, cx, cy = given[:4]
    start = _Grains(x, y, cx + flow.shear_rate * y, cy)
    none, nothing = jnp.zeros_like(number), jnp.zeros_like(flow.side)
    for row in range(_SUMS):
        block.sums[row, :] = jnp.zeros_like(x)
    finite = (abs(x) < jnp.inf) & (abs(y) < jnp.inf) & (abs(cx) < jnp.inf) & (abs(cy) < jnp.inf)
    carry = _Carry(
        grains=start,
        lists=_Lists(jnp.int32(0), none, flow.tilt, nothing, nothing, nothing - 1),
        step=jnp.int32(0),
        solved=jnp.int32(0),
        status=_if(~_all(finite), Status.nonfinite),
        counts=_Counts(*[nothing] * 6),
    )
    end = lax.while_loop(
        lambda now: (now.step < flow.steps) & (now.status < int(Status.nonfinite)),
        partial(_event, thread, grains),
        carry,
    )
    x, y, vx, vy = end.grains
    for row, value in enumerate((x, y, vx - flow.shear_rate * y, vy)):
        block.moved[row, :] = value
    sums = [jnp.sum(block.sums[row, :]) for row in range(_RESIDUALS)]
    contacts, kinetic = [total / 2 for total in sums[:_KINETIC]], sums[_KINETIC:]  # each contact was seen twice
    time, *solves = end.counts
    tilt = _remapped(end.lists.tilt + flow.shear_rate * end.lists.age)
    for n, value in enumerate([*contacts, time, end.step.astype(x.dtype), *kinetic, *solves, tilt]):
        block.totals[n] = value
    block.state[0] = end.status


def _event(thread: _Thread, grains: int, now: _Carry) -> _Carry:
    """The next step in which something happens: a contact, or the end of a list's life."""
    flow = thread.flow
    dt, rate = flow.timestep, flow.shear_rate
    ahead = flow.ahead * dt
    fastest = _fastest(now.grains, rate)
    life = _LIFE / rate

    lists, loss = now.lists, _loss(fastest, rate, flow.largest + now.lists.skin)
    worn = ~(lists.slack - loss * ahead >= loss * dt)
    aged = (lists.age > 0) & (lists.age + dt > life)
    moved, lists, crowded = lax.cond(
        worn | aged,
        partial(_search, thread, grains, fastest),
        lambda grains, lists: (grains, lists, flow.ok),
        now.grains,
        lists,
    )
    loss = _loss(fastest, rate, flow.largest + lists.skin)

    least = now.solved.astype(dt.dtype)
    spare = jnp.minimum((lists.slack - loss * ahead) / loss, life - lists.age)
    jump = jnp.minimum(_steps_to_contact(thread, moved, lists, least), jnp.floor(spare / dt))
    remaining = flow.steps - now.step
    jump = jnp.where(jump > least, jump, least)  # where it is no number too
    jump = jnp.minimum(jump, remaining.astype(dt.dtype)).astype(jnp.int32)
    flight = jump.astype(dt.dtype) * dt
    x, y, vx, vy = moved
    counts = _flown(thread, now.counts, moved, flight)
    step = now.step + jump
    flown = _Grains(x + vx * flight, y + vy * flight, vx, vy)

    after, counts, status = lax.cond(
        step < flow.steps,
        lambda: _collide(thread, moved, flown, lists, flight, counts),
        lambda: (flown, counts, flow.ok),
    )
    lists = lists._replace(age=lists.age + flight, slack=lists.slack - loss * flight)
    thread.tell((_X, _Y, _VX, _VY), after)
    torn = lists.slack - loss * ahead < -16 * flow.epsilon * lists.skin
    status = jnp.maximum(status, _if(torn, Status.capacity))
    status = jnp.maximum(status, _if(~(loss < jnp.inf), Status.nonfinite))
    status = jnp.maximum(jnp.maximum(now.status, crowded), status)
    return _Carry(after, lists, step, (step < flow.steps).astype(jnp.int32), status, counts)


def _all(predicate: Array) -> Array:
    return jnp.min(predicate.astype(jnp.int32)) > 0


def _if(predicate: Array, status: Status) -> Array:
    """The status where the predicate holds, and ok elsewhere."""
    return int(status) * predicate.astype(jnp.int32)


def _fastest(grains: _Grains, rate: Array) -> Array:
    """The largest peculiar speed, infinite where one is no number."""
    cx = grains.vx - rate * grains.y
    squared = cx * cx + grains.vy * grains.vy
    return jnp.sqrt(jnp.max(jnp.where(squared < jnp.inf, squared, jnp.inf)))


def _loss(fastest: Array, rate: Array, distance: Array) -> Array:
    """How much of its skin a list may lose in unit time, where pairs are within a distance."""
    return 2 * fastest * (1 + _LIFE) + rate * distance / 2


def _remapped(tilt: Array) -> Array:
    return tilt - jnp.floor(tilt + 0.5)


def _search(
    thread: _Thread, count: int, fastest: Array, grains: _Grains, lists: _Lists
) -> tuple[_Grains, _Lists, Array]:
    """Wrapped positions at the same peculiar velocities, the lists of near grains, and whether they had no room."""
    flow, number = thread.flow, thread.number
    side, rate = flow.side, flow.shear_rate
    tilt = _remapped(lists.tilt + rate * lists.age)
    rows = jnp.floor(grains.y / side)
    y, x = grains.y - rows * side, grains.x - rows * tilt * side
    x = x - jnp.floor((x - tilt * y) / side) * side
    wrapped = _Grains(x, y, grains.vx + rate * (y - grains.y), grains.vy)
    thread.tell((_X, _Y, _VX, _VY), wrapped)
    shared, given = thread.block.shared, thread.block.given

    def listed(skin: Array) -> Array:
        def one(other: Array, near: Array) -> Array:
            dx, dy = x - shared[_X, other], y - shared[_Y, other]
            row = jnp.floor(dy / side + 0.5)
            column = jnp.floor((dx - row * tilt * side) / side + 0.5)
            dx, dy = dx - (column + row * tilt) * side, dy - row * side
            limit = thread.radius + given[_RADIUS, other] + skin
            close = (dx * dx + dy * dy <= limit * limit) & (other != number) & (number < count)
            image = ((row.astype(jnp.int32) + _CENTRE) << _ROW) + ((column.astype(jnp.int32) + _CENTRE) << _COLUMN)
            room = close & (near < _NEAR)
            thread.write(thread.block.near, jnp.where(room, near, 0), value=other + image, mask=room)
            return near + close.astype(jnp.int32)

        return lax.fori_loop(0, count, one, jnp.zeros_like(number))

    needed = 1.2 * (2 * fastest * (1 + _LIFE) + rate * flow.largest) * flow.ahead * flow.timestep
    skin = jnp.minimum(jnp.maximum(needed, flow.usual), flow.widest)
    near = listed(skin)

    def narrowed(at: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
        tried, skin, *_ = at
        near = listed(0.7 * skin)
        return tried + 1, 0.7 * skin, near, jnp.max(near)

    tried = lambda at: (at[0] < _NARROWER) & (at[3] > _NEAR)  # noqa: E731
    _, skin, near, longest = lax.while_loop(tried, narrowed, (jnp.int32(1), skin, near, jnp.max(near)))
    crowded = _if(longest > _NEAR, Status.capacity)
    lists = _Lists(jnp.minimum(longest, _NEAR), jnp.minimum(near, _NEAR), tilt, 0 * side, skin, skin)
    return wrapped, lists, crowded


class _Pair(NamedTuple):
    """One near pair of each thread: the other grain, separation, relative velocity, and reach; ``real`` where it is one."""

    real: Array
    other: Array
    x: Array
    y: Array
    ux: Array
    uy: Array
    reach: Array

    def motion(self) -> tuple[Array, Array, Array]:
        """|u|², s·u and |s|² − d²."""
        excess = self.x * self.x + self.y * self.y - self.reach * self.reach
        return self.ux * self.ux + self.uy * self.uy, self.x * self.ux + self.y * self.uy, excess


def _pair(thread: _Thread, k: Array, grains: _Grains, lists: _Lists) -> _Pair:
    """The k-th near pair of each thread, where the grains are as they have told."""
    flow, block = thread.flow, thread.block
    real = k < lists.near
    entry = thread.read(block.near, k, mask=real)
    other = entry & ((1 << _ROW) - 1)
    row = (((entry >> _ROW) & 7) - _CENTRE).astype(grains.x.dtype)
    column = ((entry >> _COLUMN) - _CENTRE).astype(grains.x.dtype)
    up = row * flow.side
    x, y, vx, vy = (thread.ask(block.shared, n, other, real) for n in (_X, _Y, _VX, _VY))
    return _Pair(
        real=real,
        other=other,
        x=grains.x - x - (column + row * lists.tilt) * flow.side - flow.shear_rate * lists.age * up,
        y=grains.y - y - up,
        ux=grains.vx - vx - flow.shear_rate * up,
        uy=grains.vy - vy,
        reach=thread.radius + thread.ask(block.given, _RADIUS, other, real),
    )


def _steps_to_contact(thread: _Thread, grains: _Grains, lists: _Lists, least: Array) -> Array:
    """Steps, at least ``least``, after which some pair first is an approaching contact; may be infinite."""
    flow = thread.flow

    def sooner(k: Array, soonest: Array) -> Array:
        pair = _pair(thread, k, grains, lists)
        time, closest = time_to_touch(*pair.motion())
        steps = jnp.maximum(jnp.ceil(time / flow.timestep - flow.ahead), least)
        return jnp.where(pair.real & (steps * flow.timestep < closest), jnp.minimum(soonest, steps), soonest)

    return jnp.min(lax.fori_loop(0, lists.longest, sooner, jnp.full_like(grains.x, jnp.inf)))


def _flown(thread: _Thread, counts: _Counts, grains: _Grains, flight: Array) -> _Counts:
    """The counts with the time of a flight and ∫ m c ⊗ c dt along it, where c_x falls by γ̇ c_y t."""
    cx, cy = grains.vx - thread.flow.shear_rate * grains.y, grains.vy
    mass = jnp.where(thread.inverse_mass > 0, 1 / jnp.where(thread.inverse_mass > 0, thread.inverse_mass, 1), 0)
    turned = thread.flow.shear_rate * flight
    xx = cx * cx - turned * cx * cy + turned * turned / 3 * cy * cy
    thread.add(_KINETIC, [mass * flight * x for x in (xx, cx * cy - turned / 2 * cy * cy, cy * cy)])
    return counts._replace(time=counts.time + flight)


def _collide(
    thread: _Thread, told: _Grains, grains: _Grains, lists: _Lists, flight: Array, counts: _Counts
) -> tuple[_Grains, _Counts, Array]:
    """Grains and counts after the contacts of one step, and its status; unchanged where no contact approaches.

    ``told`` are the grains before the flight that led to the step, which is what other threads know of them.
    """
    flow, block = thread.flow, thread.block

    def look(k: Array, found: tuple[Array, ...]) -> tuple[Array, ...]:
        touching, hit, scale, deepest = found
        pair = _pair(thread, k, told, lists)
        pair = pair._replace(x=pair.x + pair.ux * flight, y=pair.y + pair.uy * flight)
        contact, approaching = overlaps_within(*pair.motion(), flow.ahead * flow.timestep)
        contact = contact & pair.real
        distance = jnp.sqrt(pair.x * pair.x + pair.y * pair.y)
        nx, ny = pair.x / distance, pair.y / distance
        approach = nx * pair.ux + ny * pair.uy
        place = jnp.where(contact, touching, 0)
        thread.write(block.partners, place, value=pair.other, mask=contact)
        for row, value in ((_NX, nx), (_NY, ny), (_APPROACH, approach), (_DISTANCE, distance)):
            thread.write(block.network, row, place, value=value, mask=contact)
        return (
            touching + contact.astype(jnp.int32),
            hit | (contact & approaching).astype(jnp.int32),
            scale + jnp.where(contact, jnp.minimum(approach, 0) * approach, 0),
            jnp.maximum(deepest, jnp.where(contact, pair.reach - distance, 0)),
        )

    zero = jnp.zeros_like(grains.x)
    none = jnp.zeros_like(lists.near)
    touching, hit, scale, deepest = lax.fori_loop(0, lists.longest, look, (none, none, zero, zero))
    return lax.cond(
        jnp.max(hit) > 0,
        lambda: _solved(thread, grains, touching, jnp.sum(scale) / 2, jnp.max(deepest), counts),
        lambda: (grains, counts, flow.ok),
    )


class _Solve(NamedTuple):
    """Outcome of a contact solve: iterations, squared residual, status."""

    iterations: Array
    squared: Array
    status: Array


def _solved(
    thread: _Thread, grains: _Grains, touching: Array, scale: Array, deepest: Array, counts: _Counts
) -> tuple[_Grains, _Counts, Array]:
    """Velocities after the impulses of the contacts of one step, the counts with them, and the status."""
    flow, block = thread.flow, thread.block
    network, bounce = block.network, 1 + flow.restitution
    target = flow.tolerance * jnp.sqrt(scale) + 10 * flow.epsilon * flow.shear_rate
    thread.tell([_TOUCHING], [touching])
    most = jnp.max(touching)

    def isolated(m: Array, shape: tuple[Array, ...]) -> tuple[Array, ...]:
        """Impulses of isolated pairs, zero for the others, of which the sums of n ⊗ n are returned."""
        xx, xy, yy = shape
        real = m < touching
        other = thread.read(block.partners, m, mask=real)
        nx, ny, approach = (thread.read(network, row, m, mask=real) for row in (_NX, _NY, _APPROACH))
        mobility = thread.inverse_mass + thread.ask(block.given, _INVERSE_MASS, other, real)
        alone = (touching == 1) & (thread.ask(block.counts, _TOUCHING, other, real) == 1)
        impulse = jnp.where(real & alone, jnp.maximum(0, -approach) / jnp.where(real, mobility, 1), 0)
        thread.write(network, _IMPULSE, m, value=impulse, mask=real)
        thread.write(network, _BOUND, m, value=jnp.where(alone, 0, 1.0).astype(nx.dtype), mask=real)
        coupled = real & ~alone
        return tuple(a + jnp.where(coupled, b, 0) for a, b in ((xx, nx * nx), (xy, nx * ny), (yy, ny * ny)))

    zero = jnp.zeros_like(grains.x)
    xx, xy, yy = lax.fori_loop(0, most, isolated, (zero,) * 3)
    coupled = jnp.where(xx + yy > 0, touching, 0)  # contacts in clusters, of each grain
    widest = (xx + yy + jnp.sqrt((xx - yy) * (xx - yy) + 4 * xy * xy)) / 2
    most_coupled = jnp.max(coupled)
    solve = lax.cond(
        most_coupled > 0,
        lambda: _descend(thread, coupled, most_coupled, widest, target * target),
        lambda: _Solve(flow.ok + 1, 0 * target, flow.ok),
    )
    pull_x, pull_y, loaded = _pulls(thread, touching, most, _IMPULSE)
    thread.tell((_PULL_X, _PULL_Y, _LOADED), (pull_x, pull_y, loaded))

    def tally(m: Array, _: Array) -> Array:
        real = m < touching
        other = thread.read(block.partners, m, mask=real)
        rows = (_NX, _NY, _APPROACH, _DISTANCE, _IMPULSE)
        nx, ny, approach, distance, impulse = (thread.read(network, row, m, mask=real) for row in rows)
        mobility = thread.inverse_mass + thread.ask(block.given, _INVERSE_MASS, other, real)
        response = nx * (pull_x - thread.ask(block.shared, _PULL_X, other, real))
        response = bounce / 2 * (response + ny * (pull_y - thread.ask(block.shared, _PULL_Y, other, real)))
        reach = thread.radius + thread.ask(block.given, _RADIUS, other, real)
        push, approaches = bounce * impulse, real & (approach < 0)
        single = jnp.where(approaches, -bounce * approach / jnp.where(real, mobility, 1), 0)
        clustered = (loaded > 1) | (thread.ask(block.counts, _LOADED, other, real) > 1)
        moments = nx * nx * distance, nx * ny * distance, ny * ny * distance
        flags = (x.astype(nx.dtype) for x in (real, push > 0, approaches))
        new = [push, single, *flags]
        new += [weight * moment for weight in (push, single, jnp.where(clustered, push, 0)) for moment in moments]
        new += [-push * (approach + response), push * (bounce / 2 * approach + response)]
        new += [jnp.where(real, jnp.maximum(reach - distance, 0), 0)]
        thread.add(0, new)
        return _

    lax.fori_loop(0, most, tally, flow.ok)
    residual = jnp.sqrt(solve.squared) / jnp.maximum(jnp.sqrt(scale), target)
    here = (residual > block.bins[0, :]) & (residual <= block.bins[1, :])
    thread.add(_RESIDUALS, [here.astype(zero.dtype)])
    counts = counts._replace(
        networks=counts.networks + 1,
        iterations=counts.iterations + solve.iterations.astype(target.dtype),
        unconverged=counts.unconverged + (solve.status != 0).astype(target.dtype),
        overlap=jnp.maximum(counts.overlap, deepest),
        residual=jnp.maximum(counts.residual, residual),
    )
    deep = _if(deepest > DEEP_OVERLAP, Status.deep_overlap)
    kicked = grains._replace(vx=grains.vx + bounce * pull_x, vy=grains.vy + bounce * pull_y)
    return kicked, counts, jnp.maximum(solve.status, deep)


def _pulls(thread: _Thread, contacts: Array, most: Array, row: int) -> tuple[Array, Array, Array]:
    """Velocity change of each grain by the impulses in a row of the network, and how many of them there are."""
    network = thread.block.network

    def add(m: Array, total: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        x, y, loaded = total
        real = m < contacts
        nx, ny, impulse = (thread.read(network, n, m, mask=real) for n in (_NX, _NY, row))
        return x + impulse * nx, y + impulse * ny, loaded + (impulse > 0).astype(jnp.int32)

    zero = jnp.zeros_like(thread.inverse_mass)
    x, y, loaded = lax.fori_loop(0, most, add, (zero, zero, jnp.zeros_like(contacts)))
    return x * thread.inverse_mass, y * thread.inverse_mass, loaded


class _Descent(NamedTuple):
    """Where the solve stands: as in ``methods``; ``felt`` and ``moved`` are −pᵀu⁻ and pᵀWp."""

    iterations: Array
    stride: Array
    momentum: Array
    before: Array
    best: Array
    squared: Array
    felt: Array
    moved: Array


def _descend(thread: _Thread, contacts: Array, most: Array, width: Array, target: Array) -> _Solve:
    """The guarded method of Barzilai and Borwein (``methods``) on the contacts of clusters, from zero impulses.

    ``target`` is the squared residual to reach; ``width`` are the grains' eigenvalues of the spectral bound.
    """
    block, network, flow = thread.block, thread.block.network, thread.flow
    thread.tell([_WIDTH], [width])

    def prepare(m: Array, _: Array) -> Array:
        real = m < contacts
        other = thread.read(block.partners, m, mask=real)
        inverse_mass = thread.ask(block.given, _INVERSE_MASS, other, real)
        bound = width * thread.inverse_mass + thread.ask(block.shared, _WIDTH, other, real) * inverse_mass
        thread.write(network, _BOUND, m, value=bound, mask=real)
        for row in (_IMPULSE, _RESPONSE, _STEP, _CHANGE, _BEST):
            thread.write(network, row, m, value=jnp.zeros_like(bound), mask=real)
        return _

    lax.fori_loop(0, most, prepare, flow.ok)

    def iterate(now: _Descent) -> _Descent:
        push = jnp.maximum(now.momentum, 0)
        push = push / (push + 3)

        def move(m: Array, total: tuple[Array, ...]) -> tuple[Array, ...]:
            x, y, descent = total
            real = m < contacts
            rows = (_NX, _NY, _APPROACH, _IMPULSE, _RESPONSE, _STEP, _CHANGE)
            nx, ny, approach, old, response, step, change = (thread.read(network, n, m, mask=real) for n in rows)
            bound = jnp.where(real, thread.read(network, _BOUND, m, mask=real), 1)
            at = old + push * step
            new = jnp.maximum(0, at - now.stride * (response + push * change + approach) / bound)
            thread.write(network, _STEP, m, value=new - old, mask=real)
            thread.write(network, _IMPULSE, m, value=new, mask=real)
            descent = descent + jnp.where(real, (at - new) * (new - old) * bound, 0)
            return x + new * nx, y + new * ny, descent

        zero = jnp.zeros_like(width)
        x, y, descent = lax.fori_loop(0, most, move, (zero,) * 3)
        x, y = x * thread.inverse_mass, y * thread.inverse_mass
        thread.tell((_PULL_X, _PULL_Y), (x, y))

        def feel(m: Array, total: tuple[Array, ...]) -> tuple[Array, ...]:
            squared, mixed, long, short, felt, moved = total
            real = m < contacts
            other = thread.read(block.partners, m, mask=real)
            rows = (_NX, _NY, _APPROACH, _IMPULSE, _RESPONSE, _STEP)
            nx, ny, approach, impulse, last, step = (thread.read(network, n, m, mask=real) for n in rows)
            bound = jnp.where(real, thread.read(network, _BOUND, m, mask=real), 1)
            mobility = thread.inverse_mass + thread.ask(block.given, _INVERSE_MASS, other, real)
            response = nx * (x - thread.ask(block.shared, _PULL_X, other, real))
            response = response + ny * (y - thread.ask(block.shared, _PULL_Y, other, real))
            error = jnp.minimum(mobility * impulse, response + approach)
            change = response - last
            thread.write(network, _RESPONSE, m, value=response, mask=real)
            thread.write(network, _CHANGE, m, value=change, mask=real)
            new = (error * error, step * change, step * step * bound, change * change / bound)
            new = (*new, -impulse * approach, impulse * response)
            return tuple(a + jnp.where(real, b, 0) for a, b in zip(total, new, strict=True))

        # Sums over the block are half of these: every contact is seen twice.
        squared, mixed, long, short, felt, moved = map(jnp.sum, lax.fori_loop(0, most, feel, (zero,) * 6))
        squared = squared / 2

        def keep() -> Array:
            def copy(m: Array, _: Array) -> Array:
                real = m < contacts
                thread.write(network, _BEST, m, value=thread.read(network, _IMPULSE, m, mask=real), mask=real)
                return _

            return lax.fori_loop(0, most, copy, flow.ok)

        lax.cond(squared < now.best, keep, lambda: flow.ok)
        best = jnp.minimum(squared, now.best)
        judged = now.iterations % WINDOW == WINDOW - 1
        slow = judged & ~(best < PROGRESS * PROGRESS * now.before)
        guarded = (now.momentum >= 0) | slow
        even = now.iterations % 2 == 0
        over, under = jnp.where(even, mixed, long), jnp.where(even, short, mixed)
        stride = jnp.where(under > 0, over / jnp.where(under > 0, under, 1), LONGEST_STRIDE)
        momentum = jnp.where(jnp.sum(descent) > 0, 0, jnp.maximum(now.momentum, -1) + 1)
        return _Descent(
            iterations=now.iterations + 1,
            stride=jnp.where(guarded, 1, jnp.minimum(stride, LONGEST_STRIDE)),
            momentum=jnp.where(guarded, momentum, -1),
            before=jnp.where(judged, best, now.before),
            best=best,
            squared=squared,
            felt=felt,
            moved=moved,
        )

    def unfinished(now: _Descent) -> Array:
        going = ~(now.squared <= target) & (now.squared < jnp.inf) & (now.iterations < flow.max_iterations)
        return going | (now.iterations == 0)

    infinite = jnp.full_like(target, jnp.inf)
    start = _Descent(
        iterations=jnp.int32(0),
        stride=jnp.full_like(target, 1),
        momentum=jnp.full_like(target, -1),
        before=infinite,
        best=infinite,
        squared=infinite,
        felt=jnp.zeros_like(target),
        moved=jnp.zeros_like(target),
    )
    end = lax.while_loop(unfinished, iterate, start)

    def settle(m: Array, _: Array) -> Array:
        real = m < contacts
        thread.write(network, _IMPULSE, m, value=thread.read(network, _BEST, m, mask=real), mask=real)
        return _

    lax.fori_loop(0, most, settle, flow.ok)
    jammed = end.moved < JAMMED_RESPONSE * end.felt
    missed, finite = ~(end.squared <= target), end.squared < jnp.inf
    status = jnp.maximum(_if(missed & jammed, Status.infeasible), _if(missed & ~jammed, Status.iteration_limit))
    return _Solve(end.iterations, end.best, jnp.maximum(status, _if(~finite, Status.nonfinite)))
