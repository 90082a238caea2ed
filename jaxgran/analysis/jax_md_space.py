"""The sheared cell of a state as jax-md knows a space, so that its functions apply to our
states.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxgran.model.cell import displacement, wrap
from jaxgran.model.checks import InputError, short_repr
from jaxgran.model.state import State


class JaxMdSpace(NamedTuple):
    """A space of jax-md.

    ============  ==================  ==============================================================
    field         called or shaped    meaning
    ============  ==================  ==============================================================
    displacement  (to, origin)        shortest separation ``to − origin`` in the sheared cell, σ
    shift         (positions, steps)  the positions after the steps, wrapped into the cell, σ
    box           (2, 2)              its columns are the lattice vectors (ℓ, 0) and (tilt·ℓ, ℓ), σ
    ============  ==================  ==============================================================
    """

    displacement: Callable[..., Array]
    shift: Callable[..., Array]
    box: Float[Array, "2 2"]


def jax_md_space(state: State) -> JaxMdSpace:
    """Displacement and shift functions of the sheared cell of a state, and its box, for jax-md.

    Positions are those of the state, in σ, not fractions of the cell. Both functions take ``box=``,
    for a cell that has been sheared on, and the displacement also ``perturbation=``, by which
    jax-md's ``quantity.stress`` deforms the cell. Separations are exact below half the side.
    ``jit``, ``vmap`` and derivatives apply, also those with respect to side and tilt, which
    jax-md's ``periodic_general`` gets wrong.

    Neighbour lists in these coordinates compare all pairs: give ``disable_cell_list=True``. An
    update does not see a shear of the box, so allocate the list anew, or update it with a
    ``dr_threshold`` of zero.

    Args:
      state: gives side and tilt; it may be traced, but is one replica.

    Raises:
      InputError: (a ValueError) this is no state, or a batch.

    Examples:
      >>> from jaxgran.model.grains import Grains
      >>> grains = Grains(jnp.full(2, 0.5), jnp.ones(2))
      >>> positions = jnp.asarray([[0.5, 9.5], [0.5, 0.5]])
      >>> side, tilt = jnp.asarray(10.0), jnp.asarray(0.25)
      >>> state = State(grains, positions, jnp.zeros((2, 2)), side, tilt)
      >>> displacement, shift, box = jax_md_space(state)
      >>> displacement(*positions).tolist(), box.tolist()
      ([-2.5, -1.0], [[10.0, 2.5], [0.0, 10.0]])
    """
    if not isinstance(state, State) or jnp.ndim(state.side):
        raise InputError(f"state must be one State, best from prepare, not {short_repr(state)}.")

    def side_and_tilt(box: Array | None) -> tuple[Array, Array]:
        return (state.side, state.tilt) if box is None else (box[1, 1], box[0, 1] / box[1, 1])

    def displacement_in(
        to: Array, origin: Array, box: Any = None, perturbation: Any = None, **_: Any
    ) -> Array:
        separation = displacement(to, origin, *side_and_tilt(box))
        if perturbation is None:
            return separation
        return separation @ perturbation.T if jnp.ndim(perturbation) else perturbation * separation

    def shift(positions: Array, steps: Array, box: Any = None, **_: Any) -> Array:
        return wrap(positions + steps, *side_and_tilt(box))

    box = state.side * jnp.eye(2, dtype=state.side.dtype).at[0, 1].set(state.tilt)
    return JaxMdSpace(displacement_in, shift, box)
