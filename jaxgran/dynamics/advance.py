"""Advances a flow, or a batch of flows, through time, with an engine of ``dynamics.engine``."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from jaxgran.contact.projected_methods import DEFAULT_SOLVER, ProjectedMethod, require_solver
from jaxgran.dynamics.batch import checked_batch, over_replicas
from jaxgran.dynamics.engine import Engine, Jax, Numba, Numerics, checked_numerics, select_engine
from jaxgran.dynamics.jax_engine import events_by_jax
from jaxgran.dynamics.observer import Observe, uses_traced_values
from jaxgran.dynamics.tally import Tally
from jaxgran.model.checks import refused, require, require_static_function
from jaxgran.model.choices import MAX_STEPS
from jaxgran.model.flow import ShearFlow, flow_of_state
from jaxgran.model.state import State, require_state


def advance(
    flow: ShearFlow,
    state: State,
    steps: Int[Array, "*blocks"],
    observe: Observe | None = None,
    *,
    solver: ProjectedMethod = DEFAULT_SOLVER,
    engine: Engine | None = None,
) -> tuple[State, Tally]:
    """Advance a flow, or a batch of flows, by a number of time steps; ``jit``, ``vmap`` and
    ``lax.map`` apply.

    A batch is a flow or a state whose arrays have a leading (replicas,) axis, as in ``sample``.

    Without an ``engine``, ``Numba`` is taken on a processor in double precision, if the solver is a
    ``BarzilaiBorwein``; otherwise ``Jax``. Both engines solve the same steps to the same tolerance,
    and differ by rounding and within the tolerance only; on a processor ``Numba`` is several times
    faster. Under ``vmap``, ``Jax`` runs replicas one after another on a processor and in lockstep
    on an accelerator, and ``Numba`` on all cores, with the same bits as alone. This function does
    not compile itself: call it within ``jax.jit``.

    Forward-mode derivatives (``jax.jvp``, ``jax.jacfwd``) need no further argument; reverse-mode
    derivatives (``jax.grad``, ``jax.vjp``) need ``engine=Jax(events=...)``. Both are derivatives of
    the engine ``Jax``, of which ``jvp`` also returns the values.

    Args:
      flow: parameters of the state; or those (replicas,) of a batch.
      state: the flow at the beginning; or a batch of states.
      steps: number of time steps, traced; for a batch also (replicas,). One flow also takes
        (blocks,) of them, which follow each other and have a tally each.
      observe: a function of a ``Snapshot`` whose sums over all time steps are then in
        ``Tally.observed``, see ``sample``.
      solver: solves the contacts of each step. New numbers in it do not recompile.
      engine: ``Jax()`` or ``Numba()``; None for an automatic choice, see ``dynamics.engine``.

    Returns:
      The state after the last step, and the tally of the steps, with a leading (replicas,) axis for
      a batch. A replica with a number that is not finite stops with the status ``nonfinite``.

    Raises:
      InputError: the axes of a batch differ, or the engine cannot do this.
      ValueError: by JAX, where a derivative in reverse mode lacks ``events``.

    Examples:
      How the energy after ten steps follows from the restitution:

      >>> from dataclasses import replace
      >>> import jaxgran as jg
      >>> flow = ShearFlow(grains=16, restitution=0.5, packing_fraction=0.6, timestep=1e-3)
      >>> state = jg.heated(flow, jax.random.key(0))
      >>> def energy(restitution, engine):
      ...     changed = replace(flow, restitution=restitution)
      ...     end, _ = advance(changed, state, jnp.int32(10), engine=engine)
      ...     return jnp.sum(end.velocities**2)
      >>> forward = jax.jit(jax.jacfwd(energy), static_argnums=1)(0.5, Jax())
      >>> backward = jax.jit(jax.grad(energy), static_argnums=1)(0.5, Jax(events=21))
      >>> bool(jnp.isclose(forward, backward))
      True
    """
    numerics = checked_numerics(solver, engine)
    require_static_function("observe", observe)
    batch = checked_batch(require_advance, flow, state, steps)

    def of_replica(flow: ShearFlow, state: State, steps: Array) -> tuple[State, Tally]:
        return advance_replica(flow_of_state(flow), state, steps, numerics, observe)

    return over_replicas(of_replica, numerics, batch) if batch else of_replica(flow, state, steps)


def require_advance(flow: ShearFlow, state: State, steps: Any) -> None:
    """Raise an InputError unless this is one flow, one state of it and numbers of time steps."""
    require_state(flow, state)
    words = f"a whole number of 0 to {MAX_STEPS}"
    require("steps", steps, lambda x: (x.dtype.kind in "iu") & (x >= 0) & (x <= MAX_STEPS), words)


def advance_replica(
    flow: ShearFlow, state: State, steps: Array, numerics: Numerics, observe: Observe | None = None
) -> tuple[State, Tally]:
    """``advance`` for one replica, without checks."""
    engine = engine_of(flow, numerics, state, observe)
    # Copies: JAX refuses batches of NumPy numbers, over which vmap maps, in its custom rules.
    flow, solver, state = jax.tree.map(jnp.array, (flow, numerics.solver, state))
    return engine.advance(flow, solver, state, jnp.array(steps, jnp.int32), observe)


def engine_of(
    flow: ShearFlow, numerics: Numerics, state: State, observe: Observe | None = None
) -> Engine:
    """The engine that advances a replica: ``select_engine``, or ``Jax`` where a function to observe
    uses values from outside that JAX traces, whose derivatives and batches the other would not see.
    """
    engine = select_engine(numerics, state)
    if isinstance(engine, Numba) and observe is not None:
        return Jax() if uses_traced_values(observe, flow, state) else engine
    return engine


def count_events(
    flow: ShearFlow,
    state: State,
    steps: Int[Array, ""],
    *,
    solver: ProjectedMethod = DEFAULT_SOLVER,
) -> Int[Array, ""]:
    """Steps that an advance by the engine ``Jax`` visits: its ``events``, for reverse mode.

    They are those of these numbers only: with another restitution, as in an optimisation, an
    advance may visit more. Leave room, such as half as many again; ``2 * steps + 1`` are always
    enough. Arguments and errors are those of ``advance``, for one flow and one number of steps.
    """
    require_advance(flow, state, steps)
    require_solver(solver)
    if np.shape(steps):
        raise refused("steps", steps, "must be one number")
    flow, solver, state = jax.tree.map(jnp.array, (flow, solver, state))
    return events_by_jax(flow, solver, state, jnp.array(steps, jnp.int32))
