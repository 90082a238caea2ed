"""ShearFlow: the parameters of one simple shear flow, with their units and accepted ranges."""

from collections.abc import Iterable
from dataclasses import dataclass, field, fields
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array

from jaxgran.model.batches import Indexable, equal_values
from jaxgran.model.checks import (
    InputError,
    as_array,
    concrete_or_none,
    is_traced,
    require,
    require_number,
    require_whole,
    short_repr,
    two_digits,
)
from jaxgran.model.choices import (
    MAX_GRAINS,
    MAX_PACKING_FRACTION,
    MAX_STEPS,
    MIN_GRAINS,
)
from jaxgran.model.display import text_of

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


@dataclass(frozen=True)
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

    __eq__ = equal_values

    def __hash__(self) -> int:
        leaves, structure = jax.tree.flatten(self)
        return hash((structure, *leaves))

    def __repr__(self) -> str:
        values = {name: getattr(self, name) for name in self.__dataclass_fields__}
        if isinstance(self.activation, float):
            rules = {theta: rule for rule, theta in _THETA.items()}
            values["activation"] = rules.get(self.activation, self.activation)
        return text_of("ShearFlow", values)

    def __post_init__(self):
        require_whole("grains", self.grains, MIN_GRAINS, MAX_GRAINS, "as memory is limited")
        if isinstance(self.activation, str):
            object.__setattr__(self, "activation", _THETA.get(self.activation, self.activation))
        for name, (accepts, words) in RANGES.items():
            object.__setattr__(self, name, as_array(getattr(self, name)))
            require(name, getattr(self, name), accepts, words)
        shapes = sorted({np.shape(getattr(self, name)) for name in _TRACED_FIELDS} - {()})
        if len(shapes) > 1:
            raise InputError(
                "the numbers of a batch of flows must be arrays of one shape, not "
                f"{short_repr(shapes)}."
            )
        timestep, shear_rate = concrete_or_none(self.timestep), concrete_or_none(self.shear_rate)
        with np.errstate(over="ignore"):
            too_long = (
                timestep is not None
                and shear_rate is not None
                and np.any(timestep * shear_rate > 0.1)
            )
        if too_long:
            raise InputError(
                f"timestep must be at most 0.1 / shear_rate, not {short_repr(self.timestep)}."
            )
        if shapes:
            _broadcast(self, shapes[0])

    @property
    def _axes(self) -> tuple[int, ...]:
        return np.shape(self.restitution)


_TRACED_FIELDS = tuple(f.name for f in fields(ShearFlow) if not f.metadata.get("static"))
_STATIC_FIELDS = tuple(f.name for f in fields(ShearFlow) if f.metadata.get("static"))


def _broadcast(flow: ShearFlow, shape: tuple[int, ...]) -> None:
    """Give every number of a batch its axis of replicas, in JAX's default precision: that of
    another number may be too low for it.
    """
    numbers = {name: getattr(flow, name) for name in _TRACED_FIELDS}
    kind = jnp.result_type(float)
    for name, value in numbers.items():
        if np.ndim(value) == 0:
            traced = isinstance(value, Tracer)
            repeated = (
                jnp.broadcast_to(value, shape)
                if traced
                else np.broadcast_to(np.asarray(value, kind), shape)
            )
            object.__setattr__(flow, name, repeated)


def _unflatten(static: tuple, traced: Iterable) -> ShearFlow:
    """A flow of any leaves, without checks: JAX also passes derivatives, axis numbers and
    placeholders.
    """
    flow = object.__new__(ShearFlow)
    for name, value in zip(_STATIC_FIELDS + _TRACED_FIELDS, (*static, *traced), strict=True):
        object.__setattr__(flow, name, value)
    return flow


jax.tree_util.register_pytree_with_keys(
    ShearFlow,
    lambda flow: (
        [(jax.tree_util.GetAttrKey(name), getattr(flow, name)) for name in _TRACED_FIELDS],
        tuple(getattr(flow, name) for name in _STATIC_FIELDS),
    ),
    _unflatten,
)


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
        require(
            "strain", strain, lambda x: x >= 0.99 * least, f"at least {parts} time steps, {least:g}"
        )
        require(
            "strain",
            strain,
            lambda x: x <= most,
            f"at most {MAX_STEPS} time steps, {two_digits(most, up=False)}",
        )


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
    _require_flows(flow)
    shapes = {np.shape(getattr(flow, name)) for name in _TRACED_FIELDS} - {()}
    if shapes - {(count,)}:
        raise InputError(
            f"numbers of the flow must be single ones or arrays ({count},), one for each key, not "
            f"of the shapes {', '.join(map(str, sorted(shapes)))}."
        )
    return jax.tree.map(lambda x: np.broadcast_to(x, (count,))[k], flow)


def _require_flows(flow: Any) -> None:
    if not isinstance(flow, ShearFlow):
        raise InputError(f"flow must be a ShearFlow, not {short_repr(flow)}.")


@jax.custom_jvp
def _of_state(packing_fraction: Array) -> Array:
    """A packing fraction that a state has."""
    return packing_fraction


@partial(_of_state.defjvp, symbolic_zeros=True)
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
    numbers = {name: getattr(flow, name) for name in _TRACED_FIELDS}
    # A copy: JAX refuses a batch of NumPy numbers, over which vmap maps, in a custom derivative.
    numbers["packing_fraction"] = _of_state(jnp.array(flow.packing_fraction))
    return _unflatten((flow.grains,), numbers.values())


def is_batch(flow: Any) -> bool:
    """Whether this is a ShearFlow whose numbers have an axis of replicas."""
    return isinstance(flow, ShearFlow) and any(
        np.ndim(getattr(flow, name)) for name in _TRACED_FIELDS
    )


def require_flow(flow: Any) -> None:
    """Raise an InputError unless this is a single ShearFlow, not a batch."""
    _require_flows(flow)
    if is_batch(flow):
        raise InputError(
            "flow must be one ShearFlow, and this is a batch: use jax.vmap or jax.lax.map."
        )
