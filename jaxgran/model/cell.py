"""The sheared periodic cell (Lees–Edwards): a square of side ℓ whose image rows slide along x.

The lattice vectors are (ℓ, 0) and (tilt·ℓ, ℓ). Adding an integer to the tilt gives the same
lattice, so the tilt is kept in [−½, ½). Velocities are peculiar (SLLOD): all images of a grain have
the same one. The velocity jump between images enters through γ̇ Δy of the separation.

``remap_tilt``, ``nearest_image`` and ``image_in_cell`` take numbers or arrays: the numba engine
compiles the same source (``dynamics.numba_engine.compilation``).
"""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.numpy import floor, rint, where
from jaxtyping import Array, Float

from jaxgran.model.indexing import taken

Number = Any  # a number, or an array of them


def cell_side(radii: Float[Array, " grains"], packing_fraction: float | Array) -> Float[Array, ""]:
    """Side ℓ of the square cell in which the discs have the given packing fraction.

    Examples:
      >>> # four discs of diameter 1, each fills π/4 of a unit square
      >>> float(cell_side(jnp.full(4, 0.5), jnp.pi / 4))
      2.0
    """
    return jnp.sqrt(jnp.pi * jnp.sum(radii**2) / packing_fraction)


def remap_tilt(tilt: Number) -> Number:
    """The same lattice with its tilt in [−½, ½).

    Examples:
      >>> float(remap_tilt(jnp.asarray(0.75)))
      -0.25
    """
    return tilt - floor(tilt + 0.5)


def nearest_image(dx: Number, dy: Number, side: Number, tilt: Number) -> tuple[Number, Number]:
    """The whole numbers of columns and rows, lattice vectors (ℓ, 0) and (tilt·ℓ, ℓ), to subtract
    from a separation for the minimum image.
    """
    rows = rint(dy / side)
    return rint((dx - rows * tilt * side) / side), rows


def image_in_cell(x: Number, y: Number, side: Number, tilt: Number) -> tuple[Number, Number]:
    """The image of a position that has x and y in [0, ℓ)."""
    rows = floor(y / side)
    rows = where(y - rows * side >= side, rows + 1, rows)  # ℓ plus a tiny negative y rounds to ℓ
    x_of_row, y_of_row = x - rows * tilt * side, y - rows * side
    x_of_cell = x_of_row - side * floor(x_of_row / side)
    return where(x_of_cell >= side, 0.0, x_of_cell), where(y_of_row < 0, 0.0, y_of_row)


def displacement(
    to: Float[Array, "*n 2"], origin: Float[Array, "*n 2"], side: Array, tilt: Array
) -> Float[Array, "*n 2"]:
    """Minimum-image separation ``to − origin``, exact if it is shorter than half the side.

    Examples:
      The image below a grain at the top of a cell of side 10 has slid by a quarter of the side:

      >>> top, bottom = jnp.array([0.5, 9.5]), jnp.array([0.5, 0.5])
      >>> displacement(top, bottom, jnp.asarray(10.0), jnp.asarray(0.25)).tolist()
      [-2.5, -1.0]
    """
    d = to - origin
    dx, dy = d[..., 0], d[..., 1]
    columns, rows = nearest_image(dx, dy, side, tilt)
    return jnp.stack([dx - rows * tilt * side - side * columns, dy - rows * side], axis=-1)


def wrap(positions: Float[Array, "grains 2"], side: Array, tilt: Array) -> Float[Array, "grains 2"]:
    """The images of the positions that have x and y in [0, ℓ)."""
    return jnp.stack(image_in_cell(positions[:, 0], positions[:, 1], side, tilt), axis=-1)


def sheared(vectors: Float[Array, "*n 2"], strain: Array) -> Float[Array, "*n 2"]:
    """The vectors after a simple shear: strain·y is added to x."""
    return jnp.stack([vectors[..., 0] + strain * vectors[..., 1], vectors[..., 1]], axis=-1)


def relative_velocity(
    velocities: Float[Array, "grains 2"],
    i: Array,
    j: Array,
    separations: Float[Array, "pairs 2"],
    shear_rate: float | Array,
) -> Float[Array, "pairs 2"]:
    """Velocity of grain i relative to the nearest image of grain j, in the laboratory frame: c_i −
    c_j + γ̇ Δy x̂.
    """
    peculiar = taken(velocities, i) - taken(velocities, j)
    return jnp.stack([peculiar[:, 0] + shear_rate * separations[:, 1], peculiar[:, 1]], axis=-1)


def minimum_image(
    separations: Float[np.ndarray, "n 2"], side: float, tilt: float
) -> Float[np.ndarray, "n 2"]:
    """The minimum image of separations in NumPy, exact if they are shorter than half the side; see
    ``displacement``.
    """
    rows = np.round(separations[:, 1] / side)
    x = separations[:, 0] - rows * tilt * side
    return np.stack([x - side * np.round(x / side), separations[:, 1] - rows * side], axis=-1)


def centred(
    positions: Float[np.ndarray, "grains 2"], side: float, tilt: float
) -> Float[np.ndarray, "grains 2"]:
    """The images of positions in [0, ℓ) that lie in the sheared cell whose centre is the origin."""
    x, y = (positions - side / 2).T
    return np.stack([x - side * np.floor((x - tilt * y) / side + 0.5), y], axis=-1)
