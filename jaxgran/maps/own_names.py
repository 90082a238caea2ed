"""Names of a user's observables in a map: which ones are free, and the check of their function before the run."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import jax

from jaxgran.model.checks import InputError, refused, short_repr
from jaxgran.sampling.observables import GROUPS, OBSERVABLES
from jaxgran.sampling.observe import dimensions_of, observed_shapes

if TYPE_CHECKING:
    from jaxgran.model.flow import ShearFlow

_ENDINGS = ("stderr", "ci95", "converged")
RESERVED = frozenset(
    [
        *(name for one in OBSERVABLES for name in (one, *(f"{one}_{ending}" for ending in _ENDINGS))),
        *("status", "correlation_strain", "friction_error_correlation"),
        *("strain", "equilibration_strain", "sample_timestep"),
        *("grains", "timestep", "packing_fraction", "restitution", "point_grains", "point_timestep"),
        *("seed", "observable"),
        *("error_source", "axis_a", "axis_b", "grain", "pair", "block", "quantity"),
        *(*GROUPS, "theory", "seeds", "sums", "snapshots", "large_system"),
    ]
)
"""Names of the variables, coordinates, dimensions and groups of a map."""


def require_observe(observe: Any, flow: ShearFlow) -> None:
    """Raise an InputError unless a function returns numbers or arrays, summed over contacts, by names that are free."""
    if not callable(observe):
        raise refused("observe", observe, "must be a function that is passed to `ratio_map`, or None")
    try:
        hash(observe)
    except TypeError:
        raise refused("observe", observe, "must be hashable") from None
    shapes = observed_shapes(observe, flow)
    names = list(shapes) if isinstance(shapes, dict) else []
    if not names or not all(isinstance(x, jax.ShapeDtypeStruct) for x in shapes.values()):
        raise InputError("observe must return a dictionary of numbers or arrays by name.", field="observe")
    if not all(isinstance(name, str) and name.isidentifier() for name in names):
        raise InputError(f"observe must return names without spaces and signs, not {short_repr(names)}.")
    made = [one for name, shape in shapes.items() for one in (*_names(name), *dimensions_of(name, shape.shape))]
    taken = [name for name in made if name in RESERVED or made.count(name) > 1]
    if taken:
        raise InputError(f"observe must return names that a map does not have, not {short_repr(taken[0])}.")


def _names(name: str) -> tuple[str, str, str]:
    return name, f"{name}_stderr", f"{name}_ci95"
