"""Real control flow for a batch of replicas.

Under ``vmap`` a batched predicate turns ``lax.cond`` into a ``select`` that pays both branches. Reduced over
the named axis ``"replica"`` the predicate is one scalar for the whole batch, and control flow stays control
flow. A function of the engine used on its own, or under ``lax.map``, has no such axis, and nothing changes.
"""

from typing import TypeVar

import jax
import jax.numpy as jnp
from jax import lax

AXIS = "replica"
T = TypeVar("T")


def in_batch() -> bool:
    """Whether the code being traced runs under ``vmap(axis_name="replica")``."""
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
    """``new`` in replicas that are ``active`` and ``old`` elsewhere: a replica that has finished stays as it is.

    Outside a batch control flow never reaches an inactive replica, so ``new`` is returned as it is.
    """
    if not in_batch():
        return new
    return jax.tree.map(lambda a, b: jnp.where(active, a, b), new, old)
