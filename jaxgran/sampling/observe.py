"""A user's function that observes every time step of a sample: its evaluation, its checks and its
digest.
"""

import hashlib
import re
import traceback
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal
from jax.typing import ArrayLike
from jaxtyping import Array

from jaxgran.contact.network import MOST_CONTACTS, Contacts
from jaxgran.dynamics.advance import advance
from jaxgran.dynamics.batch import predicted_cost, run_batch
from jaxgran.dynamics.engine import Numerics
from jaxgran.dynamics.observed_advance import advance_observed
from jaxgran.dynamics.observer import nothing_observed, without_contacts
from jaxgran.dynamics.snapshots import Snapshot, snapshot_of
from jaxgran.dynamics.tally import Tally
from jaxgran.model.checks import InputError, short_repr
from jaxgran.model.flow import ShearFlow
from jaxgran.model.grains import Grains
from jaxgran.model.state import State
from jaxgran.model.status import Status

_NEEDS_VALUES = (jax.errors.JAXTypeError, jax.errors.JAXIndexError)
Observe = Callable[[Snapshot], Any]  # returns a pytree of arrays to average

# Advances each replica of a batch by its number of steps, (replicas,), and a wrapper that adds
# reports or records and leaves the states alone.
AdvanceBatch = Callable[[ShearFlow, Numerics, State, Array | np.ndarray], tuple[State, Tally]]
AdvanceWrapper = Callable[[AdvanceBatch], AdvanceBatch]
# Called with time step and number of steps of each replica.
Report = Callable[[ArrayLike, ArrayLike], None]


class ObserveBatch(Protocol):
    """An ``AdvanceBatch`` that can observe the replicas while it advances them."""

    def __call__(
        self,
        flow: ShearFlow,
        numerics: Numerics,
        state: State,
        steps: Array | np.ndarray,
        observe: Observe | None = None,
    ) -> tuple[State, Tally]: ...


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
    strain = np.asarray(steps) * np.asarray(flow.timestep)
    costs = predicted_cost(flow) * strain if threads > 1 else None
    run = partial(run_batch, batch=(flow, state, steps), costs=costs, threads=threads)
    if observe is None:
        return run(_advance_replica, shared=(numerics,))
    return run(_observe_replica, shared=(numerics,), static=(observe,))


def reporting(advance: ObserveBatch, report: Report) -> ObserveBatch:
    """The same advance with a report after each call."""

    def advance_and_report(
        flow: ShearFlow,
        numerics: Numerics,
        state: State,
        steps: Array | np.ndarray,
        observe: Observe | None = None,
    ) -> tuple[State, Tally]:
        state, tally = advance(flow, numerics, state, steps, observe)
        report(flow.timestep, tally.steps)
        return state, tally

    return advance_and_report


def advance_and_observe(
    flow: ShearFlow,
    state: State,
    steps: Array,
    numerics: Numerics,
    observe: Observe | None = None,
) -> tuple[State, Tally]:
    """``advance``, with the sums of what a function observes in ``Tally.observed``."""
    if observe is None:
        return advance(flow, state, steps, solver=numerics.solver, engine=numerics.engine)
    end, tally, sums = advance_observed(
        flow, numerics, state, steps, partial(_observe_step, observe)
    )
    return end, replace(tally, observed=sums)


_advance_replica = jax.jit(advance_and_observe)
_observe_replica = jax.jit(advance_and_observe, static_argnames="observe")


def observed_shapes(observe: Observe, flow: ShearFlow) -> Any:
    """Shape and dtype of the sums of what a function observes in a flow, a pytree of
    ``jax.ShapeDtypeStruct``.

    Raises:
      InputError: the function does not return real numbers, or does not sum over contacts.
    """

    def sums(state: State) -> Any:
        now = partial(_observe_step, observe, flow, state)
        return nothing_observed(now, MOST_CONTACTS * flow.grains, state.positions.dtype).sums

    return jax.eval_shape(sums, _abstract_state(flow.grains))


def dimensions_of(name: str, shape: tuple[int, ...]) -> tuple[str, ...]:
    """The dimensions in a dataset of what a function observes by this name."""
    return tuple(f"{name}_dim_{k}" for k in range(len(shape)))


def digest_of(observe: Observe, flow: ShearFlow) -> str:
    """A hash of what a function computes in a flow: jaxpr, constants of it and of what it calls,
    and results.
    """

    def without(state: State) -> Any:
        return without_contacts(partial(_observe_step, observe, flow, state), state.positions.dtype)

    jaxpr, results = jax.make_jaxpr(without, return_shape=True)(_abstract_state(flow.grains))
    text = re.sub(" at 0x[0-9a-f]+", "", f"{jaxpr} {results}")  # addresses of functions
    digest = hashlib.sha256(text.encode())
    for constant in _constants(jaxpr):
        digest.update(f"{constant.dtype} {constant.shape}".encode() + constant.tobytes())
    return digest.hexdigest()[:16]


def _constants(part: Any) -> Iterator[np.ndarray]:
    """The arrays in a jaxpr, in the jaxprs of its equations and in their other parameters."""
    if isinstance(part, ClosedJaxpr):
        yield from (np.asarray(constant) for constant in part.consts)
        yield from _constants(part.jaxpr)
    elif isinstance(part, Jaxpr):
        for equation in part.eqns:
            yield from (np.asarray(x.val) for x in equation.invars if isinstance(x, Literal))
            for _, parameter in sorted(equation.params.items()):
                yield from _constants(parameter)
        yield from (np.asarray(x.val) for x in part.outvars if isinstance(x, Literal))
    elif isinstance(part, (tuple, list)):
        for element in part:
            yield from _constants(element)
    elif isinstance(part, (np.ndarray, jax.Array)):
        yield np.asarray(part)


def _observe_step(
    observe: Observe, flow: ShearFlow, state: State, contacts: Contacts, impulses: Array
) -> Any:
    """The result of ``observe`` for the contacts and impulses of one step."""
    snapshot = snapshot_of(flow, state, contacts, impulses, jnp.int32(Status.ok))
    try:
        return observe(snapshot)
    except _NEEDS_VALUES as error:
        raise InputError(
            "observe must compute with jax.numpy, since JAX traces its snapshot, and "
            f"{_line_of(observe, error)} needs the values: jnp.sum and jnp.where take the place of "
            "functions of NumPy, float() and if."
        ) from None


def _line_of(observe: Observe, error: Exception) -> str:
    """The line of a user's function that raised an error; "it" where that is not known."""
    file = getattr(getattr(observe, "__code__", None), "co_filename", "")
    lines = [frame for frame in traceback.extract_tb(error.__traceback__) if frame.filename == file]
    return f"line {lines[-1].lineno}, {short_repr(lines[-1].line)}," if lines else "it"


def _abstract_state(grains: int) -> State:
    """The shapes of a state of so many grains, in JAX's default precision."""

    def array(*shape: int) -> Any:
        return jax.ShapeDtypeStruct(shape, jnp.result_type(float))

    return State(
        Grains(array(grains), array(grains)), array(grains, 2), array(grains, 2), array(), array()
    )
