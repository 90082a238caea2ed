"""Real control flow for a batch of replicas.

Under ``vmap`` a batched predicate turns ``lax.cond`` into a ``select``, which computes both branches. Reduced over the
named axis ``"replica"``, the predicate is one scalar for the whole batch, and only one branch is computed. Outside a
batch, and under ``lax.map``, there is no such axis: the functions below then return their argument unchanged.
"""

from typing import TypeVar

import jax
import jax.numpy as jnp
from jax import lax

AXIS = "replica"
T = TypeVar("T")


def in_batch() -> bool:
    """Whether the code that JAX traces runs under ``vmap(axis_name="replica")``."""
    try:
        lax.axis_index(AXIS)
    except NameError:
        return False
    return True


def any_replica(predicate: jax.Array) -> jax.Array:
    """Whether the predicate holds in at least one replica of the batch; the predicate itself outside a batch."""
    return lax.pmax(predicate.astype(jnp.int32), AXIS) > 0 if in_batch() else predicate


def largest_replica(value: jax.Array) -> jax.Array:
    """The largest value over the replicas of the batch; the value itself outside a batch."""
    return lax.pmax(value, AXIS) if in_batch() else value


def where_active(active: jax.Array, new: T, old: T) -> T:
    """``new`` in active replicas and ``old`` in finished ones.

    Outside a batch the loop of a finished replica has ended, so the result is always ``new``.
    """
    if not in_batch():
        return new
    return jax.tree.map(lambda a, b: jnp.where(active, a, b), new, old)
