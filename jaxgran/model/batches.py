"""Values, which are pytrees of arrays: their equality, and batches, whose arrays have leading axes
of replicas.
"""

from typing import Any, Self, TypeVar

import jax
import numpy as np

from jaxgran.model.checks import InputError, is_traced

T = TypeVar("T")


class Indexable:
    """Base of values that may be batches, or series: they are indexed, sliced and counted along
    their first axis.
    """

    _whole = "a batch"

    @property
    def _axes(self) -> tuple[int, ...]:
        """The leading axes; none for a single value."""
        raise NotImplementedError

    def __getitem__(self, place: Any) -> Self:
        """One of a batch or series, or several by a slice or a list.

        Raises:
          InputError: this is a single value.
          IndexError: there is none at this place.
        """
        if not self._axes:
            name = type(self).__name__
            raise InputError(
                f"an index takes one of {self._whole}, and this is one {name}, not {self._whole}."
            )
        if not is_traced(place):
            np.broadcast_to(0, self._axes)[place]  # JAX would take the last for one beyond it
        return jax.tree.map(lambda leaf: leaf[place], self)

    def __len__(self) -> int:
        """How many a batch or series holds; TypeError for a single value."""
        if not self._axes:
            raise TypeError(
                f"this is one {type(self).__name__}, not {self._whole}, and has no length."
            )
        return self._axes[0]

    def __bool__(self) -> bool:
        return True  # a single value has no length


def equal_values(value: Any, other: object) -> bool:
    """The method ``__eq__``: whether two values are of one class and hold equal numbers of equal
    shapes.

    Libraries, precisions and NaN do not matter: an array of NumPy equals one of JAX, and NaN equals
    NaN in its place. Static fields, such as the number of grains, must be equal, too.

    Raises:
      InputError: JAX traces one of the values.
    """
    if type(value) is not type(other):
        return NotImplemented
    if is_traced(value, other):
        raise InputError(
            f"two values of {type(value).__name__} cannot be compared while JAX traces them: "
            "compare them before or after, or their arrays by jnp.array_equal."
        )
    (leaves, structure), (others, of_other) = jax.tree.flatten(value), jax.tree.flatten(other)
    return structure == of_other and all(map(_equal, leaves, others))


def _equal(leaf: Any, other_leaf: Any) -> bool:
    numbers = all(np.asarray(x).dtype.kind == "f" for x in (leaf, other_leaf))
    return leaf is other_leaf or np.array_equal(leaf, other_leaf, equal_nan=numbers)


def in_numpy(tree: T) -> T:
    """The same with NumPy arrays, whose small sums need no compilation; unchanged where JAX traces
    part of it.
    """
    return tree if is_traced(tree) else jax.tree.map(np.asarray, tree)
