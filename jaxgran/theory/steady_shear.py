"""SteadyShear, the prediction of every theory here, and what the theories share.

Lengths are in mean diameters, masses in the mass of a grain of mean diameter. A grain of diameter d
has mass d² unless its mass is given. All functions are differentiable and treat one flow;
`jax.vmap` adds a leading `(replicas,)`.
"""

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from functools import wraps
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Real

from jaxgran.model.checks import require_number

Scalar = float | int | Real[Array, ""]
T = TypeVar("T")

_RANGES = {
    "restitution": (lambda x: (x >= 0) & (x <= 1), "a number between 0 and 1"),
    "packing_fraction": (lambda x: (x > 0) & (x < 1), "a number above 0 and below 1"),
    "shear_rate": (lambda x: (x >= 0) & (x < np.inf), "a number of at least 0"),
    "polydispersity": (lambda x: (x >= 0) & (x < 1), "a number of at least 0 and below 1"),
}


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class SteadyShear:
    """Prediction of a theory for steady simple shear.

    ====================  =======  =================================================================
    field                 unit     meaning
    ====================  =======  =================================================================
    granular_temperature  m(σ/t)²  Σ m c²/(2N), c the peculiar velocity
    pressure              m/t²     half the trace of the stress, kinetic and collisional
    shear_stress          m/t²     positive, kinetic and collisional
    collision_rate        –        collisions per grain and unit strain; each grain counts all its
                                   collisions
    dissipation_rate      m/t³     energy lost per unit area and time; equals the power of the
                                   shear, shear_stress × shear_rate
    ====================  =======  =================================================================

    All are scalars, with a leading ``(replicas,)`` under ``vmap``. The unit of time t is that of
    the shear rate; at the default γ̇ = 1, all numbers are in units of m = σ = γ̇ = 1.
    """

    granular_temperature: Float[Array, "*replicas"]
    pressure: Float[Array, "*replicas"]
    shear_stress: Float[Array, "*replicas"]
    collision_rate: Float[Array, "*replicas"]
    dissipation_rate: Float[Array, "*replicas"]


def contact_value(packing_fraction: Scalar) -> Float[Array, ""]:
    """Pair distribution at contact of discs of one size in equilibrium.

    ================  ====  =======================================================
    name              unit  meaning
    ================  ====  =======================================================
    packing_fraction  –     ν < 1, area of the grains over the area of the cell
    returns           –     χ = (1 − 7ν/16)/(1 − ν)², a scalar
    ================  ====  =======================================================

    Source: D. Henderson, Mol. Phys. 30, 971 (1975).

    Examples:
      >>> [round(float(contact_value(nu)), 3) for nu in (0.0, 0.5, 0.75)]
      [1.0, 3.125, 10.75]
    """
    nu = jnp.asarray(packing_fraction)
    return (1 - 7 * nu / 16) / (1 - nu) ** 2


def of_one_flow(theory: Callable[..., T]) -> Callable[..., T]:
    """The theory, with an InputError where the numbers of the flow are outside of their ranges;
    traced ones pass.
    """
    names = tuple(inspect.signature(theory).parameters)

    @wraps(theory)
    def checked(*args: Any, **others: Any) -> T:
        for name, value in (dict(zip(names, args, strict=False)) | others).items():
            if name in _RANGES:
                require_number(name, value, *_RANGES[name])
        return theory(*args, **others)

    return checked


def as_floats(*values: Scalar) -> list[Float[Array, ""]]:
    """The values as arrays of a common floating-point type."""
    dtype = jnp.result_type(float, *values)
    return [jnp.asarray(value, dtype) for value in values]
