"""``jax.vmap`` of functions that decide in Python what to compute, and so need the values of their arguments.

A primitive gathers the replicas and calls the function once with all of them. ``jax.jit`` and derivatives have no
values to decide by: they raise an InputError.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.core import Tracer
from jax.extend.core import Primitive
from jax.interpreters import ad, batching

from jaxgran.model.checks import InputError


def vmapped_in_python(of_batch: Callable[..., Any], words: str, *arguments: Any) -> Any:
    """``of_batch`` of the replicas that ``jax.vmap`` traces.

    Args:
      of_batch: a function of the arguments with a leading (replicas,) axis each, whose results have it too.
      words: the sentence that refuses ``jax.jit`` and derivatives.
      arguments: pytrees of those of one replica.
    """
    leaves, structure = jax.tree.flatten(arguments)
    function = _FromLeaves(of_batch, structure)
    leaves = [leaf if isinstance(leaf, Tracer) else jnp.asarray(leaf) for leaf in leaves]
    found = _call.bind(*leaves, function=function, words=words, axes=0)
    return jax.tree.unflatten(function.results, found)


class _FromLeaves:
    """The function of a batch by its leaves; it remembers the structure of its results."""

    def __init__(self, of_batch: Callable[..., Any], structure: Any):
        self.of_batch, self.structure = of_batch, structure
        self.results: Any = None

    def __call__(self, *leaves: Any) -> list[Any]:
        found, self.results = jax.tree.flatten(self.of_batch(*jax.tree.unflatten(self.structure, leaves)))
        return found


def _in_python(*leaves: Any, function: _FromLeaves, words: str, axes: int) -> list[Any]:
    """The function of the leaves of a batch with so many axes of replicas, which it sees as one."""
    del words
    shape = leaves[0].shape[:axes]
    found = function(*(leaf.reshape(-1, *leaf.shape[axes:]) for leaf in leaves))
    return [leaf.reshape(*shape, *leaf.shape[1:]) for leaf in found]


def _batched(leaves: tuple, mapped: tuple, **parameters: Any) -> tuple[list[Any], list[int]]:
    size = next(leaf.shape[axis] for leaf, axis in zip(leaves, mapped, strict=True) if axis is not None)
    gathered = [
        jnp.broadcast_to(leaf, (size, *leaf.shape)) if axis is None else jnp.moveaxis(leaf, axis, 0)
        for leaf, axis in zip(leaves, mapped, strict=True)
    ]
    found = _call.bind(*gathered, **parameters | {"axes": parameters["axes"] + 1})
    return found, [0] * len(found)


def _refuse(*_: Any, words: str, **__: Any) -> Any:
    raise InputError(words)


_call = Primitive("jaxgran_in_python")
_call.multiple_results = True
_call.def_impl(_in_python)
_call.def_abstract_eval(_refuse)
batching.primitive_batchers[_call] = _batched
ad.primitive_jvps[_call] = _refuse
