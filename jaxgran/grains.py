"""Grains: radii and masses of the discs, and the stratified sample of a size distribution."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxgran.flow import MAX_GRAINS, require_key, require_number, require_whole


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
      polydispersity: half width Δ of the distribution, in σ, 0 to 0.5.
      key: JAX random key.
    """
    require_whole("count", count, 1, MAX_GRAINS, "as memory is limited")
    require_number("polydispersity", polydispersity, lambda x: (x >= 0) & (x <= 0.5), "between 0 and 0.5")
    require_key(key)
    quantile = (jnp.arange(count, dtype=jnp.result_type(float)) + 0.5) / count
    diameters = jax.random.permutation(key, 1 + polydispersity * (2 * quantile - 1))
    return Grains(radii=diameters / 2, masses=diameters**2)
