"""Reductions in the form that XLA compiles well on a processor; on other backends they are as good
as any.
"""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

_LANES = 32


def largest(values: Float[Array, " n"]) -> Float[Array, ""]:
    """Largest entry of a vector, see ``smallest``."""
    return -smallest(-values)


def smallest(values: Float[Array, " n"]) -> Float[Array, ""]:
    """Smallest entry of a vector.

    XLA's CPU backend runs a minimum over one long axis as a serial chain of comparisons; folded
    into rows of 32 it is a vector operation. The halves are folded apart so that the entries are
    computed once, in a loop of their own.
    """
    rows = 2 * -(-values.size // (2 * _LANES))
    padded = jnp.pad(values, (0, rows * _LANES - values.size), constant_values=jnp.inf)
    upper, lower = jnp.split(padded.reshape(rows, _LANES), 2)
    columns = jnp.minimum(jnp.min(upper, axis=0), jnp.min(lower, axis=0))
    return jnp.min(jnp.minimum(columns[: _LANES // 2], columns[_LANES // 2 :]))


@jax.custom_jvp
def sums_of(vectors: tuple[Array, ...]) -> list[Array]:
    """The sum of each vector, in one pass over all: one reduction each takes two to four times as
    long.
    """
    zeros = [jnp.zeros((), vectors[0].dtype)] * len(vectors)
    return lax.reduce(
        list(vectors), zeros, lambda a, b: [x + y for x, y in zip(a, b, strict=True)], (0,)
    )


@sums_of.defjvp
def _sums_of_jvp(primals: tuple, tangents: tuple) -> tuple[list[Array], list[Array]]:
    return sums_of(*primals), [jnp.sum(tangent) for tangent in tangents[0]]
