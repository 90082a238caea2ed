"""Batches of flows and states: a function of one replica applied to all of them, as their engine
does it fastest.
"""

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from jaxgran.dynamics.engine import Jax, Numerics, in_lockstep, select_engine
from jaxgran.dynamics.interruption import waited
from jaxgran.model.batches import in_numpy
from jaxgran.model.checks import InputError, is_traced
from jaxgran.model.control_flow import AXIS
from jaxgran.model.flow import ShearFlow
from jaxgran.model.state import State

Arguments = tuple[Any, ...]  # a flow, a state and numbers
_DIMENSIONS = (1, 1, 2, 2, 0, 0)  # of the arrays of one state, in the order of its leaves


def checked_batch(
    check: Callable[..., Any], flow: Any, state: Any, *numbers: Any
) -> Arguments | None:
    """The arguments of a batch, broadcast to a leading (replicas,) axis; None where flow and state
    are single ones.

    Args:
      check: called with the arguments of each replica, or of the first where JAX traces them;
        raises an InputError.

    Raises:
      InputError: the axes differ in length, or there are several, or the arguments of a replica do
        not pass.
    """
    batch = _batch_of(flow, state, *numbers)
    for one in _replicas(batch) if batch else [(flow, state, *numbers)]:
        check(*one)
    return batch


def _batch_of(flow: Any, state: Any, *numbers: Any) -> Arguments | None:
    if not (isinstance(flow, ShearFlow) and isinstance(state, State)):
        return None
    shapes = {*map(np.shape, jax.tree.leaves(flow)), np.shape(state.side)} - {()}
    if not shapes:
        return None
    shapes |= {np.shape(x) for x in numbers} - {()}
    if len(shapes) > 1 or len(max(shapes)) > 1:
        raise InputError(
            "a batch must have one axis of replicas, the same in the flow, the state and all "
            "numbers, not those of "
            f"{', '.join(map(str, sorted(shapes)))}."
        )

    def with_axis(x: Any, dimensions: int = 0) -> Any:
        x = (
            jnp.asarray(x, state.side.dtype)
            if isinstance(x, float)
            else x
            if hasattr(x, "ndim")
            else jnp.asarray(x)
        )
        return jnp.broadcast_to(x, (*max(shapes), *x.shape)) if x.ndim == dimensions else x

    leaves, structure = jax.tree.flatten(state)
    states = jax.tree.unflatten(structure, map(with_axis, leaves, _DIMENSIONS))
    return jax.tree.map(with_axis, flow), states, *map(with_axis, numbers)


def _replicas(batch: Arguments) -> Iterator[Any]:
    known = in_numpy(batch)
    for k in range(1 if is_traced(batch) else len(jax.tree.leaves(batch)[0])):
        yield jax.tree.map(lambda x, k=k: x[k], known)


def over_replicas(
    function: Callable, numerics: Numerics, batch: Arguments, option: str = ""
) -> Any:
    """The function of one replica for a batch, with the engine that ``select_engine`` takes for it.

    On a processor ``Numba`` advances the replicas by ``vmap``, and ``Jax`` in turn by ``lax.map``.
    On an accelerator they advance in lockstep, by ``vmap`` with a named axis.
    """
    flow, state, *_ = batch
    if in_lockstep():
        return jax.vmap(function, axis_name=AXIS)(*batch)
    if isinstance(select_engine(flow, numerics, state, option), Jax):
        return lax.map(lambda one: function(*one), batch)
    return jax.vmap(function)(*batch)


@partial(jax.jit, static_argnums=(0, 1, 2))
def compiled_over_replicas(
    function: Callable,
    static: tuple,
    option: str,
    numerics: Numerics,
    flow: ShearFlow,
    state: State,
    *numbers: Array,
) -> Any:
    """``over_replicas`` of ``function(flow, numerics, state, *numbers, *static)``, compiled."""

    def one(flow: ShearFlow, state: State, *numbers: Array) -> Any:
        return function(flow, numerics, state, *numbers, *static)

    return over_replicas(one, numerics, (flow, state, *numbers), option)


def compiled_for_few_sizes(
    program: Callable[..., Any], numerics: Numerics, batch: Arguments
) -> Any:
    """``program(*batch)``, compiled for 1, 2, 4, 8, … replicas; the last number of those that fill
    up is zero.

    Replicas in lockstep are not filled up, since memory is what limits them.
    """
    count = len(batch[-1])
    size = 1 << (count - 1).bit_length()
    if size == count or in_lockstep() or is_traced(batch):
        return waited(program(*batch))
    *others, number = jax.tree.map(
        lambda x: np.asarray(x)[np.minimum(np.arange(size), count - 1)], batch
    )
    filled = waited(program(*others, np.where(np.arange(size) < count, number, 0)))
    return jax.tree.map(lambda x: jnp.asarray(np.asarray(x)[:count]), filled)
