"""Real control flow for a batch of replicas.

Under ``vmap`` a batched predicate turns ``lax.cond`` into a ``select``, which computes both
branches. Reduced over the named axis ``AXIS``, the predicate is one scalar for the whole batch, and
only one branch is computed. Outside a batch, and under ``lax.map``, there is no such axis: the
functions below then return their argument unchanged.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import TypeVar

import jax
import jax.numpy as jnp
from jax import lax

AXIS = "jaxgran_replica"  # a name that no axis of a user has
T = TypeVar("T")


def in_batch() -> bool:
    """Whether the code that JAX traces runs under ``vmap(axis_name="jaxgran_replica")``."""
    try:
        lax.axis_index(AXIS)
    except NameError:
        return False
    return True


def any_replica(predicate: jax.Array) -> jax.Array:
    """Whether the predicate holds in at least one replica of the batch; the predicate itself
    outside a batch.
    """
    return lax.pmax(predicate.astype(jnp.int32), AXIS) > 0 if in_batch() else predicate


def where_active(active: jax.Array, new: T, old: T) -> T:
    """``new`` in active replicas and ``old`` in finished ones.

    Outside a batch the loop of a finished replica has ended, so the result is always ``new``.
    """
    if not in_batch():
        return new
    return jax.tree.map(lambda a, b: jnp.where(active, a, b), new, old)


def switch_replica(
    branch: jax.Array, default: T, branches: Sequence[Callable[[jax.Array], T]]
) -> T:
    """The result of the branch of the given number, counted from one, or ``default`` for 0.

    A branch is given whether this replica takes it. A batch computes each branch that one of its
    replicas takes, and no other, so that the result of a replica does not depend on the batch.
    """
    if not in_batch():
        taken = jnp.bool_(True)
        return lax.switch(branch, [lambda: default, *(partial(take, taken) for take in branches)])
    result = default
    for number, take in enumerate(branches, 1):
        mine = branch == number
        compute = partial(_taken, take, mine, result)
        result = lax.cond(any_replica(mine), compute, partial(lambda same: same, result))
    return result


def _taken(take: Callable[[jax.Array], T], mine: jax.Array, result: T) -> T:
    return where_active(mine, take(mine), result)
