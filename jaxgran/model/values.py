"""Values: frozen dataclasses that are pytrees of arrays, and batches of them, whose arrays have
leading axes of replicas.
"""

from contextlib import suppress
from dataclasses import fields
from functools import cache, partial
from typing import Any, Self, TypeVar

import jax
import numpy as np
from jax.tree_util import GetAttrKey, register_pytree_with_keys

from jaxgran.model.checks import InputError, is_traced
from jaxgran.model.display import text_of

T = TypeVar("T")


@cache
def _names(cls: Any) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The names of the fields with leaves, and of the static ones."""
    static = tuple(f.name for f in fields(cls) if f.metadata.get("static"))
    return tuple(f.name for f in fields(cls) if f.name not in static), static


def _fields_of(value: Any) -> dict[str, Any]:
    return {f.name: getattr(value, f.name) for f in fields(value)}


def _flatten(value: Any) -> tuple[list, tuple]:
    names, static = _names(type(value))
    return [getattr(value, name) for name in names], tuple(getattr(value, x) for x in static)


def _flatten_with_keys(value: Any) -> tuple[list, tuple]:
    leaves, static = _flatten(value)
    return list(zip(map(GetAttrKey, _names(type(value))[0]), leaves, strict=True)), static


def _unflatten(cls: type, static: tuple, leaves: Any) -> Any:
    value, names = object.__new__(cls), _names(cls)
    vars(value).update(zip((*names[0], *names[1]), (*leaves, *static), strict=True))
    return value


def register_fields(cls: type) -> None:
    """Make a dataclass a pytree by its fields, which are read when a value is first flattened."""
    register_pytree_with_keys(cls, _flatten_with_keys, partial(_unflatten, cls), _flatten)


class Value:
    """Base of dataclasses that are pytrees by their fields, but for those with the metadata
    ``static``.

    Subclasses are ``@dataclass(frozen=True, eq=False, repr=False)``. JAX makes values of any
    leaves, such as tracers, axes and placeholders, so without ``__post_init__``.
    """

    def __init_subclass__(cls) -> None:
        register_fields(cls)

    def __eq__(self, other: object) -> bool:
        """Whether two values are of one class and hold equal numbers of equal shapes.

        Libraries, precisions and NaN do not matter: an array of NumPy equals one of JAX, and NaN
        equals NaN in its place. Static fields, such as the number of grains, must be equal, too.

        Raises:
          InputError: JAX traces one of the values.
        """
        if type(self) is not type(other):
            return NotImplemented
        if is_traced(self, other):
            raise InputError(
                f"two values of {type(self).__name__} cannot be compared while JAX traces them: "
                "compare them before or after, or their arrays by jnp.array_equal."
            )
        leaves, structure = jax.tree.flatten(self)
        others, other_structure = jax.tree.flatten(other)
        return structure == other_structure and all(map(_equal, leaves, others))

    def __hash__(self) -> int:
        leaves, structure = jax.tree.flatten(self)
        return hash((structure, *leaves))

    def __repr__(self) -> str:
        shown = _fields_of(self)
        with suppress(Exception):  # JAX fills values with axes and placeholders, too
            shown = shown if is_traced(self) else self._shown()
        return text_of(type(self).__name__, shown)

    def _shown(self) -> dict[str, Any]:
        """What ``repr`` shows by name, see ``text_of``."""
        return _fields_of(self)


class Indexable(Value):
    """Base of values that may be batches, or series: they are indexed, sliced and counted along
    their first axis.
    """

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
            raise InputError(f"this is one {type(self).__name__}, not a batch, and has no index.")
        if not is_traced(place):
            np.broadcast_to(0, self._axes)[place]  # JAX clamps an index that is out of range
        index = np.asarray(place) if isinstance(place, list) else place  # JAX refuses lists
        return jax.tree.map(lambda leaf: leaf[index], self)

    def __len__(self) -> int:
        """How many a batch or series holds; TypeError for a single value."""
        if not self._axes:
            raise TypeError(f"this is one {type(self).__name__}, not a batch, and has no length.")
        return self._axes[0]

    def __bool__(self) -> bool:
        return True  # a single value has no length


def in_numpy(tree: T) -> T:
    """The same with NumPy arrays, whose small sums need no compilation; unchanged where JAX traces
    part of it.
    """
    return tree if is_traced(tree) else jax.tree.map(np.asarray, tree)


def _equal(leaf: Any, other_leaf: Any) -> bool:
    floats = all(np.asarray(x).dtype.kind == "f" for x in (leaf, other_leaf))
    return leaf is other_leaf or np.array_equal(leaf, other_leaf, equal_nan=floats)
