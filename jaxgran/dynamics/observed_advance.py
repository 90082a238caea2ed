"""Advances one replica and sums what a user's function observes, with the engine ``Numba`` or
``Jax``.

The numba engine does not call the function, but records the steps that it visits, to which JAX
applies the function, see ``numba_engine.observed``.
"""

from functools import partial
from typing import Any

import jax
from jax.core import Tracer
from jaxtyping import Array, Int

from jaxgran.contact.network import MOST_CONTACTS
from jaxgran.contact.projected_methods import ProjectedMethod
from jaxgran.dynamics.engine import Jax, Numerics, select_engine
from jaxgran.dynamics.jax_engine import observe_by_jax
from jaxgran.dynamics.observer import Observe, nothing_observed, without_contacts
from jaxgran.dynamics.tally import Tally
from jaxgran.model.flow import ShearFlow
from jaxgran.model.state import State


def advance_observed(
    flow: ShearFlow, numerics: Numerics, state: State, steps: Int[Array, ""], observe: Observe
) -> tuple[State, Tally, Any]:
    """``advance``, and the sum over all its time steps of what a function finds in them, see
    ``observer``.

    Raises:
      InputError: the engine asked for cannot do this, or the function returns something else than
        sums.
    """
    engine = select_engine(flow, numerics, state, "observe")
    if isinstance(engine, Jax) or _depends_on_traced(observe, flow, state):
        return observe_by_jax(flow, numerics.solver, state, steps, observe)
    return _recorded(observe, flow, numerics.solver, state, steps)


def _depends_on_traced(observe: Observe, flow: ShearFlow, state: State) -> bool:
    """Whether the function uses values from outside that JAX traces, whose derivatives
    ``_recorded`` would not see.
    """

    def observation(flow: ShearFlow, state: State) -> Any:
        return without_contacts(partial(observe, flow, state), state.positions.dtype)

    # First what it returns is judged: other things than numbers cannot be traced.
    nothing_observed(
        partial(observe, flow, state), MOST_CONTACTS * flow.grains, state.positions.dtype
    )
    return any(isinstance(x, Tracer) for x in jax.make_jaxpr(observation)(flow, state).consts)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _recorded(
    observe: Observe, flow: ShearFlow, solver: ProjectedMethod, state: State, steps: Array
) -> tuple[State, Tally, Any]:
    """``advance_observed`` with the numba engine; its derivatives are those of the engine
    ``Jax``.
    """
    from jaxgran.dynamics.numba_engine.observed import observe_by_numba

    return observe_by_numba(observe, flow, solver, state, steps)


@_recorded.defjvp
def _recorded_jvp(observe: Observe, primals: tuple, tangents: tuple) -> tuple:
    return jax.jvp(partial(observe_by_jax, observe=observe), primals, tangents)
