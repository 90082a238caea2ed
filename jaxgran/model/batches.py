"""Values, which are pytrees of arrays: their equality, and batches, whose arrays have leading axes of replicas."""

from typing import Any, TypeVar

import jax
import numpy as np

from jaxgran.model.checks import InputError, is_traced

T = TypeVar("T")


def replica_of(batch: T, place: Any, replicas: tuple[int, ...], whole: str = "a batch") -> T:
    """One replica of a batch, or several by a slice or a list; or the same of a series of times.

    Raises:
      InputError: there is no axis of replicas.
      IndexError: there is no such replica.
    """
    if not replicas:
        raise InputError(f"an index takes one of {whole}, and this is one {type(batch).__name__}, not {whole}.")
    if not is_traced(place):
        np.broadcast_to(0, replicas)[place]  # JAX would take the last replica in place of one that is not there
    return jax.tree.map(lambda leaf: leaf[place], batch)


def length_of(batch: Any, replicas: tuple[int, ...], whole: str = "a batch") -> int:
    """The number of replicas of a batch.

    Raises:
      TypeError: there is no axis of replicas.
    """
    if not replicas:
        raise TypeError(f"this is one {type(batch).__name__}, not {whole}, and has no length.")
    return replicas[0]


def equal_values(one: Any, other: object) -> bool:
    """Whether two values are of one class and hold equal numbers of equal shapes: the method ``__eq__``.

    Libraries, precisions and NaN do not matter: an array of NumPy equals one of JAX, and NaN equals NaN in its place.
    Parameters that are not traced, such as the number of grains, must be equal, too.

    Raises:
      InputError: JAX traces one of the values.
    """
    if type(one) is not type(other):
        return NotImplemented
    if is_traced(one, other):
        raise InputError(
            f"two values of {type(one).__name__} cannot be compared while JAX traces them: compare them before or "
            "after, or their arrays by jnp.array_equal."
        )
    one, other = (vars(x) if jax.tree_util.all_leaves([x]) else x for x in (one, other))  # what is no pytree
    (leaves, structure), (others, of_other) = jax.tree.flatten(one), jax.tree.flatten(other)
    return structure == of_other and all(map(_equal, leaves, others))


def _equal(one: Any, other: Any) -> bool:
    numbers = all(np.asarray(x).dtype.kind == "f" for x in (one, other))
    return one is other or np.array_equal(one, other, equal_nan=numbers)


def hash_of_values(self: Any) -> int:
    """The method ``__hash__`` that agrees with ``equal_values``, for values that may hold single numbers of Python.

    Raises:
      TypeError: it holds an array.
    """
    leaves, structure = jax.tree.flatten(self)
    return hash((structure, *leaves))


def in_numpy(tree: T) -> T:
    """The same with NumPy arrays, whose small sums need no compilation; unchanged where JAX traces part of it."""
    return tree if is_traced(tree) else jax.tree.map(np.asarray, tree)
