"""ShearFlow: the parameters of one simple shear flow, with their units and accepted ranges."""

from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array

from jaxgran.model.checks import (
    InputError,
    as_array,
    concrete_or_none,
    is_traced,
    refused,
    require,
    require_number,
    require_whole,
    short_repr,
    two_digits,
)
from jaxgran.model.choices import MAX_GRAINS, MAX_PACKING_FRACTION, MAX_STEPS, MIN_GRAINS
from jaxgran.model.values import Indexable

_FASTEST = 1e100  # shear rate; the square and cube of it and of its inverse are finite in float64
_THETA = {"midpoint": 0.5, "touching": 0.0}  # of the activation rules

RANGES = {
    "restitution": (lambda x: (x >= 0) & (x <= 1), "between 0 and 1"),
    "packing_fraction": (
        lambda x: (x > 0) & (x <= MAX_PACKING_FRACTION),
        f"above 0 and at most {MAX_PACKING_FRACTION}",
    ),
    "timestep": (lambda x: (x > 0) & np.isfinite(x), "a positive number"),
    "shear_rate": (
        lambda x: (x == 0) | (np.float64(x) >= 1 / _FASTEST) & (np.float64(x) <= _FASTEST),
        f"0 or between {1 / _FASTEST:g} and {_FASTEST:g}",
    ),
    "polydispersity": (lambda x: (x >= 0) & (x <= 0.5), "between 0 and 0.5"),
    "activation": (lambda x: (x == 0.5) | (x == 0), " or ".join(_THETA)),
}


@dataclass(frozen=True, eq=False, repr=False)
class ShearFlow(Indexable):
    """Parameters of a simple shear flow of rigid, frictionless, polydisperse discs.

    The unit of length is the mean grain diameter σ. The unit of mass is the mass m of a grain of
    diameter σ. ``grains`` is static. All other fields are traced: changing them recompiles nothing.
    A batch of flows is one ``ShearFlow`` whose numbers are lists or arrays with a leading
    ``(replicas,)`` axis; numbers that are the same for all are broadcast, and ``flows[0]`` is the
    first of them. How a flow is solved is no part of it: see the arguments ``solver`` and
    ``engine`` of ``sample``.

    ================  =================  ===========================================================
    field             unit               meaning
    ================  =================  ===========================================================
    grains            –                  number of discs N, 16 to 1e7
    restitution       –                  α in [0, 1], normal velocity after a collision over that
                                         before
    packing_fraction  –                  ν in (0, 0.83], area of the grains over area of the cell
    timestep          1/shear_rate = 1   dt, at most 0.1
    shear_rate        1/time             γ̇, 1e-100 to 1e100; 0 in free cooling, where the unit of
                                         time is free
    polydispersity    σ                  Δ in [0, 0.5]: diameters uniform in σ ± Δ of the grains
                                         that ``prepare`` makes; a state has its own grains
    activation        –                  θ, the part of a step of free flight after which grains
                                         that overlap are in contact: 0.5, given as "midpoint", or
                                         0, given as "touching"
    ================  =================  ===========================================================

    Raises:
      InputError: (a ValueError) a number is outside its range, or arrays differ in shape; the
        values of traced numbers are not checked.

    Examples:
      >>> flows = ShearFlow(grains=64, restitution=[0.5, 0.9], packing_fraction=0.6, timestep=1e-3)
      >>> flows.packing_fraction.tolist(), float(flows[1].restitution)
      ([0.6, 0.6], 0.9)
    """

    grains: int = field(metadata={"static": True})
    restitution: float | jax.Array
    packing_fraction: float | jax.Array
    timestep: float | jax.Array
    shear_rate: float | jax.Array = 1.0
    polydispersity: float | jax.Array = 0.26
    activation: Any = "midpoint"

    def __post_init__(self) -> None:
        require_whole("grains", self.grains, MIN_GRAINS, MAX_GRAINS, "as memory is limited")
        theta = _THETA.get(self.activation) if isinstance(self.activation, str) else None
        numbers = {name: as_array(getattr(self, name)) for name in RANGES}
        numbers |= {} if theta is None else {"activation": theta}
        for name, (accepts, words) in RANGES.items():
            require(name, numbers[name], accepts, words)
        shapes = sorted({*map(np.shape, numbers.values())} - {()})
        if len(shapes) > 1:
            raise InputError(
                "the numbers of a batch of flows must be arrays of one shape, not "
                f"{short_repr(shapes)}."
            )
        timestep, shear_rate = (concrete_or_none(numbers[x]) for x in ("timestep", "shear_rate"))
        if timestep is not None and shear_rate is not None:
            with np.errstate(over="ignore"):
                too_long = np.any(timestep * shear_rate > 0.1)
            if too_long:
                raise InputError(
                    f"timestep must be at most 0.1 / shear_rate, not {short_repr(self.timestep)}."
                )
        for name, value in numbers.items():
            object.__setattr__(self, name, _repeated(value, shapes[0]) if shapes else value)

    @property
    def _axes(self) -> tuple[int, ...]:
        return np.shape(self.restitution)

    def _shown(self) -> dict[str, Any]:
        rules = {theta: rule for rule, theta in _THETA.items()}
        named = {"activation": rules[self.activation]} if np.ndim(self.activation) == 0 else {}
        return super()._shown() | named


def _repeated(value: Any, shape: tuple[int, ...]) -> Any:
    """A number of a batch with the axis of replicas, in JAX's default precision: that of another
    number may be too low for it.
    """
    if np.ndim(value):
        return value
    if isinstance(value, Tracer):
        return jnp.broadcast_to(value, shape)
    return np.broadcast_to(np.asarray(value, jnp.result_type(float)), shape)


def in_dtype(numbers: Any, dtype: Any) -> Any:
    """The numbers of a flow or a batch, or a strain, in one dtype, so that one compiled program
    serves numbers of Python, NumPy and JAX.
    """

    def cast(x: Any) -> Any:
        return x.astype(dtype) if isinstance(x, Tracer) else np.asarray(x, dtype)

    return jax.tree.map(cast, numbers)


def require_strain(flow: ShearFlow, strain: Any, parts: int) -> None:
    """Raise an InputError unless the strain has at least one time step a part and at most
    ``MAX_STEPS`` in all.
    """
    require_sheared(flow)
    require_number("strain", strain, lambda x: (x > 0) & np.isfinite(x), "a positive number")
    if not is_traced(strain, flow.shear_rate, flow.timestep):
        step = float(np.asarray(flow.shear_rate) * np.asarray(flow.timestep))
        least, most = parts * step, MAX_STEPS * step
        few, many = f"at least {parts} time steps, {least:g}", f"at most {MAX_STEPS} time steps, "
        require("strain", strain, lambda x: x >= 0.99 * least, few)
        require("strain", strain, lambda x: x <= most, many + two_digits(most, up=False))


def steps_of_strain(flow: ShearFlow, strain: Any) -> Any:
    """Whole numbers of time steps nearest to a strain, as floats, for one flow or each of a batch.

    It is computed with JAX where values are traced and with NumPy otherwise, in the same precision
    to the same bits.

    Examples:
      >>> flow = ShearFlow(grains=64, restitution=0.5, packing_fraction=0.6, timestep=1e-3)
      >>> float(steps_of_strain(flow, 0.0104))
      10.0
    """
    numbers = strain, flow.shear_rate, flow.timestep
    xp, precision = jnp if is_traced(*numbers) else np, jnp.result_type(*numbers)
    strain, shear_rate, timestep = (xp.asarray(x, precision) for x in numbers)
    return xp.round(strain / (shear_rate * timestep))


def steps_of_blocks(steps: Any, blocks: int) -> Any:
    """Time steps of each of ``blocks`` parts of ``steps`` time steps, (..., blocks), which differ
    by one at most.

    Examples:
      >>> steps_of_blocks(np.array(10.0), 4).tolist()
      [2, 3, 3, 2]
    """
    edges = (steps[..., None] * np.arange(blocks + 1, dtype=steps.dtype) / blocks).round()
    return (edges[..., 1:] - edges[..., :-1]).astype(np.int32)


def require_sheared(flow: ShearFlow) -> None:
    """Raise an InputError if the shear rate is zero, for functions that measure time in strain."""
    words = "above 0 where strain is counted (a flow without shear is advanced by jg.advance)"
    require("shear_rate", flow.shear_rate, lambda x: x > 0, words)


def flow_of_replica(flow: Any, k: int, count: int) -> ShearFlow:
    """Flow ``k`` of a batch of ``count``, whose numbers are single ones, the same for all, or
    arrays of ``count``.
    """
    shapes = _shapes_of(flow)
    if shapes - {(count,)}:
        raise InputError(
            f"numbers of the flow must be single ones or arrays ({count},), one for each key, not "
            f"of the shapes {', '.join(map(str, sorted(shapes)))}."
        )
    return jax.tree.map(lambda x: np.broadcast_to(x, (count,))[k], flow)


def require_flow(flow: Any) -> None:
    """Raise an InputError unless this is a single ShearFlow, not a batch."""
    if _shapes_of(flow):
        raise InputError(
            "flow must be one ShearFlow, and this is a batch: use jax.vmap or jax.lax.map."
        )


def _shapes_of(flow: Any) -> set[tuple[int, ...]]:
    """The shapes of the arrays of a flow; none for a single one. InputError for anything else."""
    if not isinstance(flow, ShearFlow):
        raise refused("flow", flow, "must be a ShearFlow")
    return {*map(np.shape, jax.tree.leaves(flow))} - {()}


@jax.custom_jvp
def _not_differentiable(packing_fraction: Array) -> Array:
    """The same packing fraction, with respect to which JAX cannot differentiate."""
    return packing_fraction


@partial(_not_differentiable.defjvp, symbolic_zeros=True)
def _(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    if not isinstance(tangents[0], jax.custom_derivatives.SymbolicZero):
        raise InputError(
            "packing_fraction must not be differentiated, as it is that of the state, whose "
            "derivative it would leave out: differentiate states of several packing fractions, or "
            "hold it by jax.lax.stop_gradient(flow.packing_fraction)."
        )
    return primals[0], jnp.zeros_like(primals[0])


def flow_of_state(flow: ShearFlow) -> ShearFlow:
    """The flow of a state, which has the packing fraction: an InputError where JAX differentiates
    with respect to that of the flow.
    """
    if not is_traced(flow.packing_fraction):
        return flow
    # A copy: JAX refuses a batch of NumPy numbers, over which vmap maps, in a custom derivative.
    packing_fraction = jnp.copy(flow.packing_fraction)
    return replace(flow, packing_fraction=_not_differentiable(packing_fraction))
