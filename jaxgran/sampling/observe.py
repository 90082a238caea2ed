"""A user's function that observes every time step of a sample: its evaluation, its checks and its
digest.
"""

import hashlib
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array

from jaxgran.cache.persistent_jit import persistent_jit
from jaxgran.contact.network import MOST_CONTACTS
from jaxgran.dynamics.advance import advance_replica
from jaxgran.dynamics.batch import predicted_cost, run_batch
from jaxgran.dynamics.engine import Numerics
from jaxgran.dynamics.numba_engine.call import register
from jaxgran.dynamics.observer import Observe, nothing_observed, observe_at, without_contacts
from jaxgran.dynamics.tally import Tally
from jaxgran.model.flow import ShearFlow
from jaxgran.model.grains import Grains
from jaxgran.model.state import State

# An AdvanceBatch is ``advance_batch`` or does the same; an AdvanceWrapper adds reports or records,
# and leaves the states alone.
AdvanceBatch = Callable[..., tuple[State, Tally]]
AdvanceWrapper = Callable[[AdvanceBatch], AdvanceBatch]


def advance_batch(
    flow: ShearFlow,
    numerics: Numerics,
    state: State,
    steps: Array | np.ndarray,
    observe: Observe | None = None,
    threads: int = 1,
) -> tuple[State, Tally]:
    """Advance each replica of a batch by its number of time steps.

    Args:
      flow, state, steps: with a leading (replicas,) axis.
      numerics: the same for all replicas.
      observe: a function of a ``Snapshot``, see ``sample``; its sums are in ``Tally.observed``.
      threads: most threads on a processor, see ``run_batch``.

    Raises:
      InputError: the engine cannot do this.
    """
    strain = np.asarray(steps) * np.asarray(flow.timestep) * np.asarray(flow.shear_rate)
    costs = predicted_cost(flow) * strain if threads > 1 else None
    run = partial(run_batch, batch=(flow, state, steps), costs=costs, threads=threads)
    if observe is None:
        return run(_advance_replica, shared=(numerics,))
    return run(_observe_replica, shared=(numerics,), static=(observe,))


def reporting(
    advance: AdvanceBatch, report: Callable[[ArrayLike, ArrayLike], None]
) -> AdvanceBatch:
    """The same advance with a report of time step and number of steps of each replica after each
    call.
    """

    def advance_and_report(flow: ShearFlow, *others: Any, **observed: Any) -> tuple[State, Tally]:
        state, tally = advance(flow, *others, **observed)
        report(flow.timestep, tally.steps)
        return state, tally

    return advance_and_report


_advance_replica = persistent_jit(advance_replica, register)
_observe_replica = jax.jit(advance_replica, static_argnames="observe")


def observed_shapes(observe: Observe, flow: ShearFlow) -> Any:
    """Shape and dtype of the sums of what a function observes in a flow, a pytree of
    ``jax.ShapeDtypeStruct``.

    Raises:
      InputError: the function does not return real numbers, or does not sum over contacts.
    """

    def sums(state: State) -> Any:
        now = observe_at(observe, flow, state)
        return nothing_observed(now, MOST_CONTACTS * flow.grains, state.positions.dtype).sums

    return jax.eval_shape(sums, _abstract_state(flow.grains))


def dimensions_of(name: str, shape: tuple[int, ...]) -> tuple[str, ...]:
    """The dimensions in a dataset of what a function observes by this name."""
    return tuple(f"{name}_dim_{k}" for k in range(len(shape)))


def digest_of(observe: Observe, flow: ShearFlow) -> str:
    """A hash of what a function computes in a flow, with the constants of it and of what it calls:
    of the program that JAX compiles.
    """

    def without(state: State) -> Any:
        return without_contacts(observe_at(observe, flow, state), state.positions.dtype)

    program = jax.jit(without).lower(_abstract_state(flow.grains))
    text = f"{program.as_text()} {program.out_tree}"
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _abstract_state(grains: int) -> State:
    """The shapes of a state of so many grains, in JAX's default precision."""

    def array(*shape: int) -> Any:
        return jax.ShapeDtypeStruct(shape, jnp.result_type(float))

    return State(
        Grains(array(grains), array(grains)), array(grains, 2), array(grains, 2), array(), array()
    )
