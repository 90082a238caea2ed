"""What kinetic theory predicts for a batch of flows, as arrays of NumPy."""

from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from jaxgran.cache.persistent_jit import persistent_jit
from jaxgran.model.flow import ShearFlow
from jaxgran.model.grains import Grains
from jaxgran.theory.gaussian_moments import gaussian_moments, mixture_moments
from jaxgran.theory.steady_shear import SteadyShear

_TOGETHER = 16  # flows of one call: one compiled program serves batches of any size
_SIZE_CLASSES = 8  # of given grains
_LARGEST_RESTITUTION = 0.99  # the temperature diverges at α = 1


def kinetic_theory(
    restitution: ArrayLike,
    packing_fraction: ArrayLike,
    shear_rate: ArrayLike = 1.0,
    polydispersity: ArrayLike = 0.26,
    grains: Grains | None = None,
) -> SteadyShear:
    """``gaussian_moments`` of many flows, (replicas,) each; not finite where α is 1.

    Given grains (replicas, grains) are taken as a mixture of eight classes, sorted by diameter and
    then by mass.
    """
    if grains is not None:
        return jax.tree.map(
            np.asarray, _mixture_moments(restitution, packing_fraction, shear_rate, grains)
        )
    numbers = np.stack(
        np.broadcast_arrays(restitution, packing_fraction, shear_rate, polydispersity), axis=-1
    )
    count = len(numbers)
    filled = numbers[np.arange(-(-count // _TOGETHER) * _TOGETHER) % count].reshape(
        -1, _TOGETHER, 4
    )
    parts = [jax.tree.map(np.asarray, _gaussian_moments(part)) for part in filled]
    return jax.tree.map(lambda *x: np.concatenate(x)[:count], *parts)


def predicted(flow: ShearFlow, grains: Grains | None = None) -> SteadyShear:
    """``kinetic_theory`` of every flow of a batch, with α at most 0.99, since T diverges at α =
    1.
    """
    numbers = (
        np.minimum(flow.restitution, _LARGEST_RESTITUTION),
        flow.packing_fraction,
        flow.shear_rate,
    )
    return kinetic_theory(*numbers, flow.polydispersity, grains)


@persistent_jit
def _gaussian_moments(numbers: Float[Array, "flows 4"]) -> SteadyShear:
    return jax.vmap(gaussian_moments)(*numbers.T)


@persistent_jit
def _mixture_moments(
    alpha: Array, packing_fraction: Array, shear_rate: Array, grains: Grains
) -> SteadyShear:
    return jax.vmap(mixture_moments)(
        alpha, packing_fraction, shear_rate, *jax.vmap(size_classes)(grains)
    )


def size_classes(grains: Grains) -> tuple[Float[Array, " classes"], Float[Array, " classes"]]:
    """Mean diameters and masses of classes of equal numbers of grains, sorted by diameter and then
    by mass.
    """
    order = jnp.lexsort((grains.masses, grains.radii))
    edges = np.arange(_SIZE_CLASSES + 1) * order.size // _SIZE_CLASSES
    members = [order[first:last] for first, last in pairwise(edges)]
    diameters = jnp.stack([2 * jnp.mean(grains.radii[one]) for one in members])
    return diameters / jnp.mean(diameters), jnp.stack(
        [jnp.mean(grains.masses[one]) for one in members]
    )
