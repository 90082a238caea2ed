"""Cell-list search for pairs in the sheared cell, supplied by jax-md; the only module that imports it."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


def cell_list_pairs(positions: Float[Array, "grains 2"], side: Array, tilt: Array, cutoff: Array, capacity: int):
    raise NotImplementedError
