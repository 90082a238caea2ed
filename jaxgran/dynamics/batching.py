"""The rule by which ``jax.vmap`` batches the engine ``Jax``, and the forward derivative of an
engine.
"""

from collections.abc import Callable
from typing import Any, TypeVar

import jax
from jax import lax
from jax.custom_batching import custom_vmap
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun

from jaxgran.environment import on_processor

T = TypeVar("T")


def with_own_batching(function: Callable[..., T]) -> Callable[..., T]:
    """A function of pytrees of arrays whose replicas ``vmap`` computes one after another on a
    processor, and in lockstep on an accelerator.

    What the replicas have in common stays outside of their loop, so that the compiler knows
    constants, such as numbers of the solver. The constants of the function itself are arguments of
    ``custom_vmap``, which fails where ``vmap`` of a condition gives them an axis.
    """

    def call(*arguments: Any) -> T:
        traced, shapes = jax.make_jaxpr(function, return_shape=True)(*arguments)

        def with_constants(constants: list[jax.Array], *arguments: Any) -> T:
            of_leaves = jaxpr_as_fun(ClosedJaxpr(traced.jaxpr, constants))
            return jax.tree.structure(shapes).unflatten(of_leaves(*jax.tree.leaves(arguments)))

        in_turn = custom_vmap(with_constants)

        @in_turn.def_vmap
        def _(size: int, is_batched: list, *arguments: Any) -> tuple[T, Any]:
            if on_processor():
                result = _map(in_turn, arguments, is_batched)
            else:
                axes = jax.tree.map(lambda batched: 0 if batched else None, tuple(is_batched))
                result = jax.vmap(with_constants, axes)(*arguments)
            return result, jax.tree.map(lambda _: True, result)

        return in_turn(traced.consts, *arguments)

    return call


def _map(function: Callable[..., T], arguments: tuple, is_batched: list) -> T:
    """The results of a function for one replica after another."""
    leaves, structure = jax.tree.flatten(arguments)
    places = [k for k, batched in enumerate(jax.tree.leaves(is_batched)) if batched]

    def of_replica(batched_leaves: list[jax.Array]) -> T:
        of_places = dict(zip(places, batched_leaves, strict=True))
        return function(*structure.unflatten([of_places.get(k, x) for k, x in enumerate(leaves)]))

    return lax.map(of_replica, [leaves[k] for k in places])


def with_forward_derivative(
    engine: Callable[..., T], differentiable: Callable[..., T]
) -> Callable[..., T]:
    """``engine``, whose derivative in forward mode is that of ``differentiable``, a function of the
    same arguments; ``jax.jvp`` also returns the values of the latter.
    """
    differentiated = jax.custom_jvp(engine)

    @differentiated.defjvp
    def _(primals: tuple, tangents: tuple) -> tuple[T, T]:
        return jax.jvp(differentiable, primals, tangents)

    return differentiated
