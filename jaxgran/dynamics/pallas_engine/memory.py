"""The memory of a thread block: what each thread holds, and how threads read from each other.

Every array has an entry for each thread, and a thread is a grain: what a thread has written it reads without waiting.
It reads of other grains from ``shared`` and ``counts``, which all threads write between two barriers and read after.

Pallas lowers kernels to Triton with limits that show here: a row is given by its number and not by a slice of an
array of vectors; a branch returns values and not constants (``Flow.ok`` is the status ok as a value); and what is
masked out is read as zero.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.experimental.pallas import triton
from jaxtyping import Array

from jaxgran.dynamics.tally import CONTACT, LAYOUT, NUMBERS, span_of
from jaxgran.model.status import Status

NEAR = 20  # near grains that a grain has room for
X, Y, CX, CY, RADIUS, INVERSE_MASS, GIVEN = range(7)  # rows of what is given; the first four are those of ``shared``
DV_X, DV_Y, WIDTH, SHARED = range(4, 8)  # changes of velocity; a grain's share λ/m in the spectral bound
TOUCHING, LOADED, COUNTS = range(3)  # contacts of a grain, and those that carry an impulse
NX, NY, APPROACH, DISTANCE, IMPULSE, RESPONSE, STEP, CHANGE, BEST, BOUND, NETWORK = range(11)  # of a contact

# Rows of the sums that each grain adds to: those of contacts, the kinetic moment, and the solves by residual.
KINETIC = span_of(CONTACT).stop - span_of(CONTACT).start
RESIDUALS = KINETIC + 3
SUMS = RESIDUALS + 1
_BINS = LAYOUT["residual_counts"]
TOTALS = NUMBERS - (_BINS.stop - _BINS.start) + 1  # the running sums without the counts by residual, and the tilt


class Flow(NamedTuple):
    """Numbers of the flow, and of its lists: the largest diameter, and the usual and the widest skin."""

    side: Array
    tilt: Array
    restitution: Array
    timestep: Array
    shear_rate: Array
    tolerance: Array
    activation_fraction: Array
    largest: Array
    usual: Array
    widest: Array
    epsilon: Array
    max_steps: Array
    steps: Array
    ok: Array  # the status


class Block(NamedTuple):
    """Memory of a thread block; ``threads`` is the number of grains, filled up to a power of two."""

    numbers: Any  # (11,): the numbers of ``Flow``
    whole: Any  # (3,): the whole ones
    given: Any  # (6, threads): positions, peculiar velocities, radii, inverse masses
    bins: Any  # (2, threads): bounds of the bins of the residuals
    moved: Any  # (4, threads): positions at the last search; at the end those then, and the peculiar velocities
    totals: Any  # (TOTALS,)
    status: Any  # (1,)
    sums: Any  # (SUMS, threads): what each grain adds to the sums, and the solves by residual
    shared: Any  # (7, threads): what threads publish to each other
    counts: Any  # (2, threads): the same of whole numbers
    near: Any  # (NEAR, threads): near grains
    apart: Any  # (2, NEAR, threads): separations of their nearest images at the search
    partners: Any  # (NEAR, threads): grains in contact
    network: Any  # (10, NEAR, threads): the contacts


def results(threads: int, dtype: jnp.dtype) -> list[jax.ShapeDtypeStruct]:
    """Shapes of what a block writes, in the order of its memory."""
    shapes: list[tuple[tuple[int, ...], Any]] = [
        ((4, threads), dtype),
        ((TOTALS,), dtype),
        ((1,), jnp.int32),
        ((SUMS, threads), dtype),
        ((SHARED, threads), dtype),
        ((COUNTS, threads), jnp.int32),
        ((NEAR, threads), jnp.int32),
        ((2, NEAR, threads), dtype),
        ((NEAR, threads), jnp.int32),
        ((NETWORK, NEAR, threads), dtype),
    ]
    return [jax.ShapeDtypeStruct(*shape) for shape in shapes]


class Thread(NamedTuple):
    """A thread: its number, its grain's radius and inverse mass, the block's memory, the flow, and how to wait."""

    number: Array
    radius: Array
    inverse_mass: Array
    block: Block
    flow: Flow
    wait: Callable[[], None]

    def publish(self, rows: Sequence[int], values: Sequence[Array]) -> list[Array]:
        """Write what other threads may gather: floats to ``shared``, integers to ``counts``, between two barriers.

        Returns the values as they have been written. Use these from here on: a product that the compiler fuses into a
        later sum is rounded differently from what the others read, and two grains would not see the same contact.
        """
        self.wait()
        memory = [self.block.counts if value.dtype == jnp.int32 else self.block.shared for value in values]
        for at, row, value in zip(memory, rows, values, strict=True):
            at[row, :] = value
        self.wait()
        return [at[row, :] for at, row in zip(memory, rows, strict=True)]

    def gather(self, memory: Any, row: int, other: Array, mask: Array) -> Array:
        """Read what another thread has published."""
        return triton.load(memory.at[row, other], mask=mask, other=0)

    def read(self, memory: Any, *place: Any, mask: Array) -> Array:
        """Read a place that belongs to this thread."""
        return triton.load(memory.at[*place, self.number], mask=mask, other=0)

    def write(self, memory: Any, *place: Any, value: Array, mask: Array) -> None:
        """Write to a place that belongs to this thread."""
        triton.store(memory.at[*place, self.number], value, mask=mask)

    def add(self, row: int, values: Sequence[Array]) -> None:
        """Add to the sums of this thread, from a row on."""
        for n, value in enumerate(values, row):
            self.block.sums[n, :] = self.block.sums[n, :] + value


class Motion(NamedTuple):
    """Displacements since the search, in a frame that shears with the flow, and peculiar velocities, (threads,)."""

    x: Array
    y: Array
    cx: Array
    cy: Array


class Counts(NamedTuple):
    """Sums of an advance that no single grain adds to: time, and those of solves."""

    time: Array
    networks: Array
    iterations: Array
    unconverged: Array
    overlap: Array  # the deepest one
    residual: Array  # the worst one


def status_if(predicate: Array, status: Status) -> Array:
    """The status where the predicate holds, and ok elsewhere."""
    return int(status) * predicate.astype(jnp.int32)
