"""Real control flow for a batch of replicas.

Under ``vmap`` a batched predicate turns ``lax.cond`` into a ``select``, which computes both
branches, and a loop into one that selects in every iteration. A predicate that passes through
``any_replica`` stays one scalar for the whole batch, so only one branch is computed. Then
``where_active`` keeps what is finished in a replica while others of its batch go on. Outside a
batch both change nothing.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_batching import custom_vmap

T = TypeVar("T")


@custom_vmap
def any_replica(predicate: jax.Array) -> jax.Array:
    """Whether the predicate holds in at least one replica of the batch; the predicate itself
    outside a batch.
    """
    return predicate


@any_replica.def_vmap
def _(size: int, batched: list[bool], predicate: jax.Array) -> tuple[jax.Array, bool]:
    return any_replica(jnp.any(predicate, axis=0) if batched[0] else predicate), False


@custom_vmap
def _takes_part(active: jax.Array) -> jax.Array:
    """Whether a replica takes part in an iteration: always outside a batch, where a loop ends with
    its only replica.
    """
    return jnp.ones_like(active)


@_takes_part.def_vmap
def _(size: int, batched: list[bool], active: jax.Array) -> tuple[jax.Array, bool]:
    return (active, True) if batched[0] else (_takes_part(active), False)


def where_active(active: jax.Array, new: T, old: T) -> T:
    """``new`` in active replicas and ``old`` in finished ones; outside a batch always ``new``."""
    takes_part = _takes_part(active)
    return jax.tree.map(partial(jnp.where, takes_part), new, old)


def switch_replica(
    branch: jax.Array, default: T, branches: Sequence[Callable[[jax.Array], T]]
) -> T:
    """The result of the branch of the given number, counted from one, or ``default`` for 0.

    A branch is given whether this replica takes it, which is known to the compiler outside a batch.
    A batch computes each branch that one of its replicas takes, and no other, so that the result of
    a replica does not depend on the batch.
    """

    def computed(function: Callable[[jax.Array], T], chosen: jax.Array, result: T) -> T:
        return where_active(chosen, function(_takes_part(chosen)), result)

    result: Any = default
    for number, function in enumerate(branches, 1):
        chosen = branch == number
        compute = partial(computed, function, chosen)
        result = lax.cond(any_replica(chosen), compute, lambda result: result, result)
    return result
