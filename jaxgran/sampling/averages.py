"""The observables of a tally, by the formulas of their table."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array

from jaxgran.dynamics.tally import Tally
from jaxgran.model.values import in_numpy
from jaxgran.sampling.observables import OBSERVABLES


def averages(tally: Tally, area: ArrayLike, grains: int, shear_rate: ArrayLike) -> dict[str, Array]:
    """All observables of a tally, by the names of ``OBSERVABLES``.

    Args:
      tally: sums with any leading axes.
      area: area of the cell, in σ².
      grains: number of grains.
      shear_rate: γ̇, in 1/t.

    Returns:
      NumPy arrays, or those of JAX where it traces, with the leading axes of the tally; tensors
      have two more axes, (2, 2). The diagonal of a stress Σ^{ab} is positive, and the shear stress
      is −Σ^{xy}, as in the paper. An average over no contacts is NaN.
    """
    tally, area, shear_rate = in_numpy((tally, area, shear_rate))
    numbers = (*vars(tally).values(), area, shear_rate)
    # NumPy is 100 times faster for the few numbers of a point
    xp: Any = jnp if any(isinstance(x, jax.Array) for x in numbers) else np
    sums = Sums(tally, xp.asarray(area), grains, xp.asarray(shear_rate), xp)
    with np.errstate(divide="ignore", invalid="ignore"):  # NumPy warns of these, JAX does not
        return {name: getattr(sums, name) for name in OBSERVABLES}


@dataclass
class Sums:
    """What the formula of an observable is made from: the sums of a tally, means that several
    formulas share, and every other observable by its name.
    """

    tally: Tally
    area: Array
    grains: int
    shear_rate: Array
    xp: Any  # NumPy, or jax.numpy where JAX traces

    def __getattr__(self, observable: str) -> Any:
        if observable not in OBSERVABLES:
            raise AttributeError(observable)
        value = vars(self)[observable] = OBSERVABLES[observable].formula(self)
        return value

    @cached_property
    def volume(self) -> Array:
        """Area of the cell times the sampled time."""
        return self.area * self.tally.duration

    @cached_property
    def contact_pressure(self) -> Array:
        return self.trace(self.contact_stress) / 2

    @cached_property
    def kinetic_pressure(self) -> Array:
        return self.trace(self.kinetic_stress) / 2

    @cached_property
    def work(self) -> Array:
        """Work of the shear."""
        return self.shear_stress * self.shear_rate * self.volume

    def trace(self, tensor: Array) -> Array:
        return tensor[..., 0, 0] + tensor[..., 1, 1]

    def ratio(self, numerator: Array, denominator: Array) -> Array:
        """The quotient; NaN without a warning where the denominator is zero."""
        zero = denominator == 0
        return self.xp.where(zero, self.xp.nan, numerator / self.xp.where(zero, 1, denominator))
