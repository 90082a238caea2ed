"""ShearFlow: the parameters of one simple shear flow, with their units and accepted ranges."""

from collections.abc import Iterable
from dataclasses import dataclass, field, fields
from typing import Literal, get_args

import jax
import numpy as np
from jax.core import Tracer

Activation = Literal["midpoint", "touching"]
Solver = Literal["nesterov", "barzilai-borwein", "jacobi", "jacobi-count", "jacobi-diagonal"]

MAX_PACKING_FRACTION = 0.83
MIN_GRAINS = 16


class InputError(ValueError):
    """A mistake in what a user gave; the message is one sentence that says what is accepted."""


_STATIC = {"static": True}


@dataclass(frozen=True)
class ShearFlow:
    """Parameters of a simple shear flow of rigid, frictionless, polydisperse discs.

    Units: length in mean grain diameters σ, mass in masses m of a grain of diameter σ. ``grains``,
    ``activation`` and ``solver`` are static; all else is traced, so that a change recompiles nothing and a
    batch of flows is one ``ShearFlow`` whose numbers carry a leading ``(replicas,)`` axis.

    ================  =================  ===============================================================
    field             unit               meaning
    ================  =================  ===============================================================
    grains            –                  number of discs N, at least 16
    restitution       –                  α in [0, 1], ratio of normal velocities after and before
    packing_fraction  –                  ν in (0, 0.83], area of the grains over the area of the cell
    timestep          1/shear_rate = 1   dt, at most 0.1
    shear_rate        1/time             γ̇ > 0
    polydispersity    σ                  Δ in [0, 0.5]: diameters uniform in σ ± Δ
    tolerance         –                  relative residual of the contact solve, in [1e-12, 0.1]
    max_iterations    –                  cap of one contact solve
    activation        –                  "midpoint": contact if half a step of free flight overlaps;
                                         "touching": contact if the grains overlap
    relaxation        –                  ω in (0, 2) of the Jacobi methods
    solver            –                  projected method of the contact solve, see ``methods``
    ================  =================  ===============================================================

    Raises:
      InputError: (a ValueError) a number is outside its range; traced numbers are not judged.
    """

    grains: int = field(metadata=_STATIC)
    restitution: float | jax.Array
    packing_fraction: float | jax.Array
    timestep: float | jax.Array
    shear_rate: float | jax.Array = 1.0
    polydispersity: float | jax.Array = 0.26
    tolerance: float | jax.Array = 1e-4
    max_iterations: int | jax.Array = 5000
    relaxation: float | jax.Array = 1.8
    activation: Activation = field(default="midpoint", metadata=_STATIC)
    solver: Solver = field(default="barzilai-borwein", metadata=_STATIC)

    def __post_init__(self):
        whole = isinstance(self.grains, (int, np.integer)) and not isinstance(self.grains, bool)
        if not whole or self.grains < MIN_GRAINS:
            raise InputError(f"grains must be a whole number of at least {MIN_GRAINS}, not {self.grains!r}.")
        for name, allowed in (("activation", get_args(Activation)), ("solver", get_args(Solver))):
            if getattr(self, name) not in allowed:
                raise InputError(
                    f"{name} must be {', '.join(allowed[:-1])} or {allowed[-1]}, not {getattr(self, name)!r}."
                )
        for name, (accepts, words) in _RANGES.items():
            require(name, getattr(self, name), accepts, words)
        timestep, shear_rate = _known(self.timestep), _known(self.shear_rate)
        if timestep is not None and shear_rate is not None and np.any(timestep * shear_rate > 0.1):
            raise InputError(f"timestep must be at most 0.1 / shear_rate, not {self.timestep!r}.")

    @property
    def activation_fraction(self) -> float:
        """θ: the share of a step of free flight over which a pair must overlap to be a contact."""
        return 0.5 if self.activation == "midpoint" else 0.0


_TRACED, _FIXED = (
    tuple(f.name for f in fields(ShearFlow) if bool(f.metadata.get("static")) is static) for static in (False, True)
)


def _unflatten(fixed: tuple, traced: Iterable) -> ShearFlow:
    """A flow of any leaves, not judged: they may be derivatives, axes or placeholders."""
    flow = object.__new__(ShearFlow)
    for name, value in zip(_FIXED + _TRACED, (*fixed, *traced), strict=True):
        object.__setattr__(flow, name, value)
    return flow


jax.tree_util.register_pytree_with_keys(
    ShearFlow,
    lambda flow: (
        [(jax.tree_util.GetAttrKey(name), getattr(flow, name)) for name in _TRACED],
        tuple(getattr(flow, name) for name in _FIXED),
    ),
    _unflatten,
)

_RANGES = {
    "restitution": (lambda x: (x >= 0) & (x <= 1), "between 0 and 1"),
    "packing_fraction": (
        lambda x: (x > 0) & (x <= MAX_PACKING_FRACTION),
        f"above 0 and at most {MAX_PACKING_FRACTION}",
    ),
    "timestep": (lambda x: (x > 0) & np.isfinite(x), "a positive number"),
    "shear_rate": (lambda x: (x > 0) & np.isfinite(x), "a positive number"),
    "polydispersity": (lambda x: (x >= 0) & (x <= 0.5), "between 0 and 0.5"),
    "tolerance": (lambda x: (x >= 1e-12) & (x <= 0.1), "between 1e-12 and 0.1"),
    "relaxation": (lambda x: (x > 0) & (x < 2), "between 0 and 2, both excluded"),
    "max_iterations": (lambda x: (x >= 1) & (x <= 2**31 - 1) & (x == np.floor(x)), "a whole number of at least 1"),
}


def _known(value) -> np.ndarray | None:
    """The value as an array of numbers, or None while it is only traced or a placeholder of a pytree."""
    numbers = (bool, int, float, complex, str, list, tuple, np.generic, np.ndarray, jax.Array)
    if isinstance(value, Tracer) or not isinstance(value, numbers):
        return None
    return np.asarray(value)


def two_digits(value: float, up: bool) -> str:
    """A positive number as 1.2e-03, rounded to the side of a limit on which it is still accepted."""
    unit = 10.0 ** (np.floor(np.log10(value)) - 1)
    return f"{(np.ceil if up else np.floor)(value / unit) * unit:.1e}"


def require(name: str, value, accepts, words: str) -> None:
    """Raise an InputError that says what is accepted, unless every known number of ``value`` is."""
    known = _known(value)
    if known is None:
        return
    if isinstance(value, (list, tuple)) or known.dtype.kind not in "iuf" or not np.all(accepts(known)):
        raise InputError(f"{name} must be {words}, not {' '.join(repr(value).split())}.")
