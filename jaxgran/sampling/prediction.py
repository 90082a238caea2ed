"""What kinetic theory predicts for a batch of flows, as arrays of NumPy."""

from itertools import pairwise
from typing import Any

import jax
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
    numbers = np.stack(
        np.broadcast_arrays(restitution, packing_fraction, shear_rate, polydispersity), axis=-1
    )
    classes = () if grains is None else [x.astype(numbers.dtype) for x in size_classes(grains)]
    count = len(numbers)
    places = np.arange(-(-count // _TOGETHER) * _TOGETHER).reshape(-1, _TOGETHER) % count
    parts = [_moments(numbers[some], *(x[some] for x in classes)) for some in places]
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
def _moments(numbers: Float[Array, "flows 4"], *classes: Float[Array, "flows classes"]) -> Any:
    if not classes:
        return jax.vmap(gaussian_moments)(*numbers.T)
    alpha, nu, rate, _ = numbers.T
    return jax.vmap(mixture_moments)(alpha, nu, rate, *classes)


def size_classes(grains: Grains) -> tuple[np.ndarray, np.ndarray]:
    """Mean diameters and masses (..., classes) of classes of equal numbers of grains (..., grains),
    sorted by diameter and then by mass.
    """
    radii, masses = np.asarray(grains.radii), np.asarray(grains.masses)
    order = np.lexsort((masses, radii))
    edges = np.arange(_SIZE_CLASSES + 1) * order.shape[-1] // _SIZE_CLASSES
    members = [order[..., first:last] for first, last in pairwise(edges)]
    mean_radii, mean_masses = (
        np.stack([np.mean(np.take_along_axis(x, numbers, -1), -1) for numbers in members], axis=-1)
        for x in (radii, masses)
    )
    return mean_radii / np.mean(mean_radii, -1, keepdims=True), mean_masses
