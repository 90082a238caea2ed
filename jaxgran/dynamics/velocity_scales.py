"""How the fluctuations of velocity divide over lengths: within a neighbourhood, and in the longest
waves of the cell.

In large dissipative flows the granular temperature grows with the number of grains, because long
waves of velocity carry energy of their own. The temperature relative to the mean velocity of a
neighbourhood does not.

Both are readings of a state. The engines take them at the end of an advance and, in between, after
about ``READ_AFTER`` collisions of every grain: more seldom, the instants would scatter more than
the flow does; more often, they would cost more than 2 % of a step. A reading that waited for a
number of collisions would find the flow hotter than it is on average, by 2 % at N = 32, as a hot
flow collides more often. So the time of the first half of that number, doubled, is the interval
between all readings of an advance (``reading_interval`` of the engines). A reading is taken after
the contacts of a step; a collision takes (1 − α²)/2N of the energy, and half of that is missing.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxgran.model.cell import wrap
from jaxgran.model.state import State

READ_AFTER = 64  # collisions of every grain between two readings, on average
BOX_GRAINS = 25  # mean number of grains in a box, as nearly as equal boxes allow
WAVES = ((1, 0), (0, 1), (1, 1), (1, -1))  # the longest waves, in reciprocal lattice vectors


def readings(state: State) -> Float[Array, " instant"]:
    """Local and wave temperature, in the order of the rows of ``tally`` for instants."""
    return jnp.stack([local_temperature(state), wave_temperature(state)])


def local_temperature(state: State) -> Float[Array, ""]:
    """Granular temperature relative to the mean velocity of boxes of about 25 grains, in mσ²/t².

    The cell is divided into equal boxes that are sheared as it is. In a box of k grains, Σ m (c −
    c̄)² is on average 2 (k − 1) T for uncorrelated velocities, with c̄ the mean velocity by mass.
    So the sums of all boxes are divided by the sum of 2 (k − 1). With fewer than about 56 grains
    there is one box, and the result differs from the granular temperature by N/(N − 1) only.
    """
    count = state.positions.shape[0]
    across = boxes_across(count)
    boxes = across**2
    column, row = jnp.clip(jnp.floor(_in_cell(state) * across).astype(jnp.int32), 0, across - 1).T
    box = across * row + column
    masses = state.grains.masses
    mass = jax.ops.segment_sum(masses, box, boxes)
    momentum = jax.ops.segment_sum(masses[:, None] * state.velocities, box, boxes)
    mean = momentum / jnp.where(mass > 0, mass, 1)[:, None]
    deviation = masses * jnp.sum((state.velocities - mean[box]) ** 2, axis=1)
    occupied = jnp.sum((mass > 0).astype(masses.dtype))
    return jnp.sum(deviation) / (2 * jnp.maximum(count - occupied, 1))


def boxes_across(count: int) -> int:
    """Boxes along each side of a cell of so many grains."""
    return max(1, round((count / BOX_GRAINS) ** 0.5))


def wave_temperature(state: State) -> Float[Array, ""]:
    """Kinetic energy of the four longest waves of velocity, as a granular temperature, in mσ²/t².

    It is the mean of |Σ m c exp(ik·r)|² / Σ m over four wave vectors k and both components of c.
    Uncorrelated velocities of granular temperature T give T on average, which is equipartition.
    """
    vectors = jnp.asarray(WAVES, state.positions.dtype)
    phases = 2 * jnp.pi * jnp.einsum("wa,ga->wg", vectors, _in_cell(state))
    momenta = state.grains.masses[:, None] * state.velocities
    amplitudes = [jnp.einsum("wg,ga->wa", wave(phases), momenta) for wave in (jnp.cos, jnp.sin)]
    return sum(jnp.mean(part**2) for part in amplitudes) / jnp.sum(state.grains.masses)


def _in_cell(state: State) -> Float[Array, "grains 2"]:
    """Positions in the sheared cell, in units of its lattice vectors, from 0 to 1."""
    x, y = wrap(state.positions, state.side, state.tilt).T
    across = (x - state.tilt * y) / state.side
    return jnp.stack([across - jnp.floor(across), y / state.side], axis=1)
