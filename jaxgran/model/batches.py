"""Batches: pytrees whose arrays all have the same leading axes of replicas."""

from typing import Any, TypeVar

import jax
import numpy as np

from jaxgran.model.checks import InputError, is_traced

T = TypeVar("T")


def replica_of(batch: T, place: Any, replicas: tuple[int, ...]) -> T:
    """One replica of a batch, or several by a slice or a list.

    Raises:
      InputError: there is no axis of replicas.
      IndexError: there is no such replica.
    """
    if not replicas:
        raise InputError(f"an index takes a replica of a batch, and this is one {type(batch).__name__}, not a batch.")
    if not is_traced(place):
        np.broadcast_to(0, replicas)[place]  # JAX would take the last replica in place of one that is not there
    return jax.tree.map(lambda leaf: leaf[place], batch)


def in_numpy(tree: T) -> T:
    """The same with NumPy arrays, whose small sums need no compilation; unchanged where JAX traces part of it."""
    return tree if is_traced(tree) else jax.tree.map(np.asarray, tree)
