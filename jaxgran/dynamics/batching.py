"""The rule by which ``jax.vmap`` batches the engine ``Jax``, and its forward derivative.

Under the usual rule every condition becomes a ``select`` that computes both branches, for all
replicas and steps. Here replicas advance one after another on a processor, with real conditions and
loops; on an accelerator they advance in lockstep under an axis of our own, over which predicates
are reduced (``model.control_flow``).
"""

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_batching import custom_vmap
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun

from jaxgran.dynamics.engine import in_lockstep
from jaxgran.model.checks import InputError
from jaxgran.model.control_flow import AXIS

T = TypeVar("T")


def with_own_batching(function: Callable[..., T]) -> Callable[..., T]:
    """A function of pytrees of arrays for one replica, which ``vmap`` batches by the rule above.

    Where the first argument is the same for all replicas, so are all conditions, and the usual rule
    is taken: as where ``jax.jacfwd`` follows many tangents of one flow.
    """

    def of_replicas(size: int, batched: Any, *arguments: Any) -> tuple[T, Any]:
        if not any(jax.tree.leaves(batched[0])):
            axes = jax.tree.map(lambda is_batched: 0 if is_batched else None, tuple(batched))
            return _all_batched(jax.vmap(function, axes)(*arguments))
        if in_lockstep():
            return _all_batched(together(*_with_axis(size, batched, arguments)))
        return _all_batched(_in_turn(batched_function, batched, arguments))

    def of_batches(size: int, batched: Any, *arguments: Any) -> tuple[T, Any]:
        batches = _with_axis(size, batched, arguments)
        result = together(*jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), batches))
        return _all_batched(jax.tree.map(lambda x: x.reshape(size, -1, *x.shape[1:]), result))

    batched_function = _with_rule(function, of_replicas)
    together = _with_rule(jax.vmap(function, axis_name=AXIS), of_batches)
    return batched_function


def _with_rule(function: Callable[..., T], rule: Callable[..., tuple[T, Any]]) -> Callable[..., T]:
    """``custom_vmap`` of a function with a rule.

    The constants of the function, which ``vmap`` of a condition gives an axis, are arguments here:
    ``custom_vmap`` by itself fails where constants have one. The rule computes them anew.
    """

    def call(*arguments: Any) -> T:
        jaxpr, shapes = jax.make_jaxpr(function, return_shape=True)(*arguments)

        @custom_vmap
        def of_constants(constants: list[jax.Array], arguments: tuple) -> T:
            of_leaves = jaxpr_as_fun(ClosedJaxpr(jaxpr.jaxpr, constants))
            return jax.tree.structure(shapes).unflatten(of_leaves(*jax.tree.leaves(arguments)))

        @of_constants.def_vmap
        def _(size: int, batched: Any, _: Any, arguments: tuple) -> tuple[T, Any]:
            return rule(size, batched[1], *arguments)

        return of_constants(jaxpr.consts, arguments)

    return call


def with_forward_derivative(
    engine: Callable[..., T], differentiable: Callable[..., T]
) -> Callable[..., T]:
    """An engine whose derivatives in forward mode are those of a function of the same arguments,
    batched as above.
    """

    def derivative(primals: tuple, tangents: list[jax.Array]) -> list[jax.Array]:
        return _of_real_numbers(*jax.jvp(differentiable, primals, _completed(primals, tangents)))

    batched = jax.custom_jvp(with_own_batching(derivative))
    wrapped = jax.custom_jvp(engine)

    @batched.defjvp
    def _(primals: tuple, tangents: tuple) -> Any:
        raise InputError(
            "an advance must be differentiated once, not twice: take differences of its first "
            "derivatives for second ones."
        )

    @wrapped.defjvp
    def _(primals: tuple, tangents: tuple) -> tuple[T, T]:
        result, change = wrapped(*primals), batched(primals, _of_real_numbers(primals, tangents))
        return result, _completed(result, change)

    return wrapped


def _of_real_numbers(values: Any, tangents: Any) -> list[jax.Array]:
    """The tangents of real numbers; whole numbers have none."""
    pairs = zip(jax.tree.leaves(values), jax.tree.leaves(tangents), strict=True)
    return [
        tangent for value, tangent in pairs if jnp.issubdtype(jnp.result_type(value), jnp.inexact)
    ]


def _completed(values: T, tangents: list[jax.Array]) -> T:
    """The tangents of all values, from those of real numbers."""
    leaves, structure = jax.tree.flatten(values)
    rest = iter(tangents)
    real = [jnp.issubdtype(jnp.result_type(x), jnp.inexact) for x in leaves]
    zeros = [np.zeros(jnp.shape(x), jax.dtypes.float0) for x in leaves]
    return structure.unflatten(
        [next(rest) if is_real else zero for is_real, zero in zip(real, zeros, strict=True)]
    )


def _in_turn(function: Callable[..., T], batched: Any, arguments: tuple) -> T:
    """The results for one replica after another. What all have in common stays outside of the
    loop, so that the compiler knows constants, such as numbers of the solver.
    """
    leaves, structure = jax.tree.flatten(arguments)
    is_batched = jax.tree.leaves(tuple(batched))

    def of_replica(own: list[jax.Array]) -> T:
        rest = iter(own)
        each = [next(rest) if mine else x for x, mine in zip(leaves, is_batched, strict=True)]
        return function(*structure.unflatten(each))

    return lax.map(of_replica, [x for x, mine in zip(leaves, is_batched, strict=True) if mine])


def _with_axis(size: int, batched: Any, arguments: tuple) -> tuple:
    """The arguments, all with a leading axis of replicas."""

    def spread(x: jax.Array, is_batched: bool) -> jax.Array:
        return x if is_batched else jnp.broadcast_to(x, (size, *jnp.shape(x)))

    return jax.tree.map(spread, arguments, tuple(batched))


def _all_batched(result: T) -> tuple[T, Any]:
    return result, jax.tree.map(lambda _: True, result)
