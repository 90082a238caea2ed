"""Advances one replica through time, with the engine that ``dynamics.engine`` selects.

XLA calls the numba engine through its foreign function interface, so ``jit``, ``lax.map`` and
``vmap`` apply to both engines.
"""

from collections.abc import Callable
from functools import cache

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Int

from jaxgran.contact.projected_methods import DEFAULT_SOLVER, ProjectedMethod
from jaxgran.dynamics.batch import checked_batch, over_replicas
from jaxgran.dynamics.batching import with_forward_derivative, with_own_batching
from jaxgran.dynamics.engine import Engine, Numba, Numerics, checked_numerics, select_engine
from jaxgran.dynamics.jax_engine import advance_by_jax, require_advance
from jaxgran.dynamics.tally import Tally
from jaxgran.model.control_flow import in_batch
from jaxgran.model.flow import ShearFlow, flow_of_state
from jaxgran.model.state import State


def advance(
    flow: ShearFlow,
    state: State,
    steps: Int[Array, ""],
    free_flight: bool = True,
    events: int | None = None,
    moving_contacts: bool = False,
    *,
    solver: ProjectedMethod = DEFAULT_SOLVER,
    engine: Engine | None = None,
) -> tuple[State, Tally]:
    """Advance a flow, or a batch of flows, by a number of time steps; ``jit``, ``vmap`` and
    ``lax.map`` apply.

    A batch is a flow or a state whose arrays have a leading (replicas,) axis, as in ``sample``.

    Without an ``engine``, ``Numba`` is taken on a processor, if the solver is a ``BarzilaiBorwein``
    and ``free_flight``, ``events`` and ``moving_contacts`` are left out; otherwise ``Jax``. Both
    engines solve the same steps to the same tolerance, and differ by rounding and within the
    tolerance only; on a processor ``Numba`` is several times faster. Under ``vmap`` without
    ``events``, replicas take a processor in turn by ``Jax``, on all cores by ``Numba``, and an
    accelerator in lockstep, with the same bits as alone. This function does not compile itself:
    call it within ``jax.jit``.

    Forward-mode derivatives (``jax.jvp``, ``jax.jacfwd``) need no further argument. Reverse-mode
    derivatives (``jax.grad``, ``jax.vjp``) need the number of ``events``. Reverse mode stores the
    state and the lists of every event, about 0.6 kB a grain. It computes contacts and impulses
    again in the backward pass.

    Args:
      flow: parameters of the state; or those (replicas,) of a batch.
      state: the flow at the beginning; or a batch of states.
      steps: number of time steps, traced; for a batch also (replicas,).
      free_flight: True jumps over steps without an approaching contact; False visits every step.
        The trajectory is the same.
      events: number of visited steps, static, for a loop of fixed length; ``2 * steps + 1`` is
        always enough, and ``count_events`` counts them. If they are too few, the status is
        ``capacity``, and numbers and derivatives are NaN. None visits as many as needed.
      moving_contacts: whether derivatives include the shift of the contacts in time, see
        ``dynamics.jax_engine``. Values do not change.
      solver: solves the contacts of each step. New numbers in it do not recompile.
      engine: ``Jax()`` or ``Numba()``; None for an automatic choice, see ``dynamics.engine``.

    Returns:
      The state after the last step, and the tally of the steps, with a leading (replicas,) axis for
      a batch. A replica with a number that is not finite stops with the status ``nonfinite``.

    Raises:
      InputError: the axes of a batch differ, or the engine cannot do this.
      NotImplementedError: by JAX, where a derivative in reverse mode lacks ``events``.
    """
    numerics = checked_numerics(solver, engine)
    options = {
        "free_flight=False": not free_flight,
        "events": events is not None,
        "moving_contacts": moving_contacts,
    }
    option = " and ".join(name for name, given in options.items() if given)
    batch = checked_batch(require_advance, flow, state, steps)
    flow = flow_of_state(flow)
    if batch:

        def advance_one(flow: ShearFlow, state: State, steps: Array) -> tuple[State, Tally]:
            return advance(
                flow,
                state,
                steps,
                free_flight,
                events,
                moving_contacts,
                solver=solver,
                engine=engine,
            )

        return over_replicas(advance_one, numerics, batch, option)
    selected = select_engine(flow, numerics, state, option)
    if isinstance(selected, Numba):
        return _numba_engine(flow, numerics.solver, state, jnp.asarray(steps))
    if events is not None or in_batch():
        return advance_by_jax(
            flow, numerics.solver, state, steps, free_flight, events, moving_contacts
        )
    arrays = jax.tree.map(jnp.asarray, (flow, numerics.solver, state, steps, free_flight))
    return _jax_engine(moving_contacts)(*arrays)


def advance_blocks(
    flow: ShearFlow, numerics: Numerics, state: State, steps: Int[Array, " blocks"]
) -> tuple[State, Tally]:
    """Advance a flow by one block of steps after another, with a tally (blocks,) for each.

    The engine ``Jax`` advances by each block as ``advance`` does. The numba engine keeps its list
    of near pairs from one block to the next, so its trajectory differs by rounding from that of one
    call a block, and a batch of replicas meets at the end of all blocks only.
    """
    if isinstance(select_engine(flow, numerics, state), Numba):
        return _numba_blocks(flow, numerics.solver, state, steps)
    if in_batch():
        return _blocks_by_jax(flow, numerics.solver, state, steps)
    arrays = jax.tree.map(jnp.asarray, (flow, numerics.solver, state, steps))
    return _jax_blocks(*arrays)


@cache
def _jax_engine(moving_contacts: bool) -> Callable[..., tuple[State, Tally]]:
    """The engine ``Jax`` with batches and forward derivatives; reverse mode needs ``events``, and
    the plain engine.
    """

    def engine(
        flow: ShearFlow, solver: ProjectedMethod, state: State, steps: Array, free_flight: Array
    ):
        return advance_by_jax(
            flow, solver, state, steps, free_flight, moving_contacts=moving_contacts
        )

    def of_replica(arguments: tuple) -> tuple[State, Tally]:
        return engine(*arguments)

    batched = with_own_batching(of_replica)
    return with_forward_derivative(lambda *arguments: batched(arguments), engine)


def _blocks_by_jax(
    flow: ShearFlow, solver: ProjectedMethod, state: State, steps: Array
) -> tuple[State, Tally]:
    """The same with the engine ``Jax``."""
    return lax.scan(lambda state, steps: advance_by_jax(flow, solver, state, steps), state, steps)


def _advance_by_numba(
    flow: ShearFlow, solver: ProjectedMethod, state: State, steps: Array
) -> tuple[State, Tally]:
    """Advance one replica with the numba engine."""
    end, tally = _blocks_by_numba(flow, solver, state, steps[None])
    return end, jax.tree.map(lambda x: x[0], tally)


def _blocks_by_numba(
    flow: ShearFlow, solver: ProjectedMethod, state: State, steps: Array
) -> tuple[State, Tally]:
    """Advance one replica with the numba engine, by blocks of steps."""
    from jaxgran.dynamics.numba_engine.call import advance_by_numba

    return advance_by_numba(flow, solver, state, steps)


def register_numba() -> None:
    """Register the numba engine with XLA; it is compiled at its first use on a machine."""
    from jaxgran.dynamics.numba_engine import call

    call.register_numba()


_numba_engine = with_forward_derivative(_advance_by_numba, advance_by_jax)
_numba_blocks = with_forward_derivative(_blocks_by_numba, _blocks_by_jax)
_jax_blocks = with_forward_derivative(with_own_batching(_blocks_by_jax), _blocks_by_jax)
