"""Grains: radii and masses of the discs, from a size distribution or given by the user."""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from jaxgran.model.checks import (
    InputError,
    as_array,
    require,
    require_key,
    require_native,
    require_number,
    require_whole,
    short_repr,
)
from jaxgran.model.choices import MAX_GRAINS
from jaxgran.model.values import Value

_POSITIVE = "a list of positive numbers"
_LARGEST_VALUE = 1e30  # of a diameter or a mass; their sums stay finite in float32
_MEAN_DIAMETER_TOLERANCE = 1e-3  # σ


@dataclass(frozen=True, eq=False, repr=False)
class Grains(Value):
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
    """Discs with diameters uniform in 1 ± ``polydispersity`` and masses equal to the diameter
    squared.

    The diameters are the quantile midpoints of the uniform distribution, in random order. Their
    mean is exactly one, and every replica has the same sizes. Independent draws of 1000 diameters
    would change the pressure by 1–2 %.

    Args:
      count: number of grains.
      polydispersity: half width Δ of the distribution, in σ, 0 to 0.5.
      key: JAX random key.
    """
    require_whole("count", count, 1, MAX_GRAINS, "as memory is limited")
    require_number(
        "polydispersity", polydispersity, lambda x: (x >= 0) & (x <= 0.5), "between 0 and 0.5"
    )
    require_key(key)
    quantile = (jnp.arange(count, dtype=jnp.result_type(float)) + 0.5) / count
    diameters = jax.random.permutation(key, 1 + polydispersity * (2 * quantile - 1))
    return Grains(radii=diameters / 2, masses=diameters**2)


def own_grains(diameters: ArrayLike, masses: ArrayLike | None = None) -> Grains:
    """Discs of any diameters and masses, for ``prepare``, ``heated`` and ``pack``.

    Lengths are in mean diameters, so the diameters are divided by their mean. Masses are not
    rescaled. They are in the unit m of all stresses and temperatures. The inertial number and
    Bagnold's coefficients take m as the mass of a mean grain. In this bidisperse packing every
    second grain is hollow, and the solid grains of both sizes have mass m:

        diameters = np.repeat([1.0, 1.4], 128)
        grains = jg.own_grains(diameters, masses=np.where(np.arange(256) % 2, 0.1, 1.0))

    =========  =========  ====  ====================================================================
    argument   shape      unit  meaning
    =========  =========  ====  ====================================================================
    diameters  (grains,)  any   diameters, in any order: their positions in the packing are random
    masses     (grains,)  m     masses; None for equal density: the squares of the diameters over
                                their mean
    =========  =========  ====  ====================================================================

    Raises:
      InputError: these are not two lists of positive numbers of the same length.
    """

    def positive(name: str, values: Any) -> Array:
        numbers = as_array(values)
        require(name, numbers, lambda x: (x.ndim == 1) & (x > 0) & (x < _LARGEST_VALUE), _POSITIVE)
        return jnp.asarray(numbers, float)

    lengths = positive("diameters", diameters)
    sizes = lengths / jnp.mean(lengths)
    weights = sizes**2 if masses is None else positive("masses", masses)
    if weights.shape != sizes.shape:
        raise InputError(
            f"there must be as many masses as diameters, and there are {weights.size} and "
            f"{sizes.size}."
        )
    return Grains(radii=sizes / 2, masses=weights)


def require_grains(grains: Any, count: int) -> None:
    """Raise an InputError unless these are ``count`` grains of mean diameter 1; traced values are
    not checked.
    """
    words = f"grains must be Grains with radii and masses of {count} discs, as the flow has, not"
    if not isinstance(grains, Grains):
        raise InputError(f"{words} {short_repr(grains)}.")
    shapes = np.shape(grains.radii), np.shape(grains.masses)
    if shapes != ((count,), (count,)):
        raise InputError(f"{words} of shapes {shapes[0]} and {shapes[1]}.")
    require_native("grains", grains)
    for name in ("radii", "masses"):
        require(name, getattr(grains, name), lambda x: (x > 0) & np.isfinite(x), _POSITIVE)
    if not isinstance(grains.radii, Tracer):
        mean = 2 * float(np.mean(np.asarray(grains.radii)))
        if abs(mean - 1) > _MEAN_DIAMETER_TOLERANCE:
            raise InputError(
                f"the mean diameter must be 1, the unit of length, not {mean:g}: own_grains "
                "divides by it."
            )
