"""Grains: radii and masses of the discs, and the stratified sample of a size distribution."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Grains:
    """The discs of one replica.

    ======  ===========  ====  =======
    field   shape        unit  meaning
    ======  ===========  ====  =======
    radii   (grains,)    σ     radius
    masses  (grains,)    m     mass
    ======  ===========  ====  =======
    """

    radii: Float[Array, " grains"]
    masses: Float[Array, " grains"]


def polydisperse(count: int, polydispersity: float | Array, key: Array) -> Grains:
    """Discs with diameters uniform in 1 ± ``polydispersity`` and masses equal to the diameter squared.

    The diameters are the quantile midpoints of the uniform law in random order, so that the mean is exactly one
    and no sample is unlucky: independent draws of 1000 diameters would move the pressure by 1–2 %.

    Args:
      count: number of grains.
      polydispersity: half width Δ of the distribution, in σ.
      key: JAX random key.
    """
    quantile = (jnp.arange(count, dtype=jnp.result_type(float)) + 0.5) / count
    diameters = jax.random.permutation(key, 1 + polydispersity * (2 * quantile - 1))
    return Grains(radii=diameters / 2, masses=diameters**2)
