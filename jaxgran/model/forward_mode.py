"""A gate that lets derivatives in forward mode pass and refuses those in reverse mode at once.

JAX differentiates a ``while`` loop in forward mode only. It finds that out after it has traced the whole loop, which
takes half a minute for the loop of an engine. The gate stands before the loop. In reverse mode JAX linearises: tangents
are then of one type, by which the gate knows it.
"""

from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax.core import Tracer
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jax.interpreters.partial_eval import JaxprTracer

from jaxgran.model.checks import InputError, is_traced

T = TypeVar("T")


def forward_only(values: T, words: str) -> T:
    """The values unchanged; a derivative in reverse mode through them is an InputError with these words."""

    def gated(leaf: Any) -> Any:
        real = isinstance(leaf, Tracer) and jnp.issubdtype(leaf.dtype, jnp.floating)
        return _gate.bind(leaf, words=words) if real else leaf

    return jax.tree.map(gated, values) if is_traced(values) else values


def _refuse(*_: Any, words: str) -> Any:
    raise InputError(words)


def _jvp(primals: tuple, tangents: tuple, words: str) -> tuple:
    if isinstance(tangents[0], JaxprTracer):
        _refuse(words=words)
    change = tangents[0] if isinstance(tangents[0], ad.Zero) else _gate.bind(tangents[0], words=words)
    return _gate.bind(primals[0], words=words), change


_gate = Primitive("jaxgran_forward_only")
_gate.def_impl(lambda value, words: value)
_gate.def_abstract_eval(lambda value, words: value)
mlir.register_lowering(_gate, lambda _, value, words: [value])
batching.primitive_batchers[_gate] = lambda values, axes, words: (_gate.bind(*values, words=words), axes[0])
ad.primitive_jvps[_gate] = _jvp
ad.primitive_transposes[_gate] = _refuse  # where it is not seen before, as inside of ``jax.checkpoint``
