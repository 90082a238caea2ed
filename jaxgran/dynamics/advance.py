"""Advances one replica through time, with the engine that ``dynamics.engine`` selects.

XLA calls the numba engine through its foreign function interface, so ``jit``, ``lax.map`` and
``vmap`` apply to both engines.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Int

from jaxgran.contact.projected_methods import DEFAULT_SOLVER, ProjectedMethod
from jaxgran.dynamics.batch import checked_batch, over_replicas
from jaxgran.dynamics.batching import with_forward_derivative, with_own_batching
from jaxgran.dynamics.engine import Engine, Numba, Numerics, checked_numerics, select_engine
from jaxgran.dynamics.jax_engine import advance_by_jax, ended, require_advance
from jaxgran.dynamics.tally import NUMBERS, RunningSums, Tally, sums_from_row
from jaxgran.model.checks import InputError
from jaxgran.model.control_flow import in_batch
from jaxgran.model.flow import ShearFlow, flow_of_state
from jaxgran.model.state import State, kinetic_energy, status_at_start


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


def register_numba() -> None:
    """Register the numba engine with XLA; it is compiled at its first use on a machine."""
    from jaxgran.dynamics.numba_engine import ffi

    ffi.register()


def _advance_by_numba(
    flow: ShearFlow, solver: ProjectedMethod, state: State, steps: Array
) -> tuple[State, Tally]:
    """Advance one replica with the numba engine."""
    return _end_of(state, call_numba(flow, solver, state, steps[None]))


def _blocks_by_numba(
    flow: ShearFlow, solver: ProjectedMethod, state: State, steps: Array
) -> tuple[State, Tally]:
    """Advance one replica with the numba engine, by blocks of steps."""
    call = call_numba(flow, solver, state, steps)
    energies = jnp.concatenate([kinetic_energy(state.grains, state.velocities)[None], call.kinetic])
    tallies = jax.vmap(lambda sums, **ends: sums.tally(**ends))(
        call.sums, energy_change=jnp.diff(energies), momentum_drift=call.drift
    )
    end, last = _end_of(state, call)  # with the energy change of all blocks
    last = replace(last, energy_change=last.energy_change - (energies[-2] - energies[0]))
    return end, jax.tree.map(lambda all_blocks, x: all_blocks.at[-1].set(x), tallies, last)


def _blocks_by_jax(
    flow: ShearFlow, solver: ProjectedMethod, state: State, steps: Array
) -> tuple[State, Tally]:
    """The same with the engine ``Jax``."""
    return lax.scan(lambda state, steps: advance_by_jax(flow, solver, state, steps), state, steps)


def _end_of(state: State, call: "NumbaCall") -> tuple[State, Tally]:
    """The state at the end of a call from a state, and the tally of its last block, with the whole
    energy change.
    """
    sums = jax.tree.map(lambda x: x[-1], call.sums)
    return ended(state, call.end.positions, call.end.tilt, call.end.velocities, sums)


class NumbaCall(NamedTuple):
    """What a call of the numba engine returns.

    =========  ===============  ====================================================================
    field      shape            meaning
    =========  ===============  ====================================================================
    end        State            the state at the end, unless the call is suspended
    sums       RunningSums      (blocks,) the running sums, with those of the calls that it resumes
    kinetic    (blocks,)        kinetic energy at the end of each block but the last one
    drift      (blocks,)        relative momentum then
    suspended  ()               where the call is suspended; 0 if it is finished
    recorded   ()               number of records
    records    (room, numbers)  see ``numba_engine.records``
    memory     (words,)         memory of the engine, from which another call resumes; (0,) without
                                records
    =========  ===============  ====================================================================
    """

    end: State
    sums: RunningSums
    kinetic: Array
    drift: Array
    suspended: Array
    recorded: Array
    records: Array
    memory: Array


def numba_memory(flow: ShearFlow) -> jax.ShapeDtypeStruct:
    """The memory of the numba engine for one replica."""
    from jaxgran.dynamics.numba_engine import layout

    return jax.ShapeDtypeStruct(
        (1 + layout.WORDS + layout.WORDS_PER_GRAIN * flow.grains,), jnp.float64
    )


_numba_engine = with_forward_derivative(_advance_by_numba, advance_by_jax)
_numba_blocks = with_forward_derivative(_blocks_by_numba, _blocks_by_jax)
_jax_blocks = with_forward_derivative(with_own_batching(_blocks_by_jax), _blocks_by_jax)


def call_numba(
    flow: ShearFlow,
    solver: ProjectedMethod,
    state: State,
    steps: Array,
    room: int = 0,
    suspended: Array | int = 0,
    memory: Array | None = None,
) -> NumbaCall:
    """Run the numba engine once.

    Args:
      flow, solver, state: as in ``advance``.
      steps: (blocks,) numbers of time steps.
      room: number of records, static, for one block. The call is suspended where there is no room
        for more; 0 records nothing.
      suspended, memory: those of an earlier call with the same arguments, to resume it; 0 to begin.
    """
    from jaxgran.dynamics.numba_engine import layout
    from jaxgran.dynamics.numba_engine.ffi import TARGET

    register_numba()
    dtype, grains = state.positions.dtype, state.grains
    inputs = layout.Inputs(
        side=state.side,
        tilt=state.tilt,
        restitution=flow.restitution,
        timestep=flow.timestep,
        shear_rate=flow.shear_rate,
        tolerance=solver.tolerance,
        activation=flow.activation,
        max_steps=solver.max_steps,
        status=status_at_start(flow, state),
        resume_at=suspended,
    )
    shapes = [
        state.positions.shape,
        state.positions.shape,
        (*steps.shape, layout.RESULTS),
        numba_memory(flow).shape if room > 0 else (0,),  # without records no call is resumed
        (room, layout.record_numbers(flow.grains)),
    ]
    results = [jax.ShapeDtypeStruct(shape, dtype) for shape in shapes]
    aliases = None if memory is None else {layout.MEMORY_GIVEN: layout.MEMORY}
    call = jax.ffi.ffi_call(
        TARGET, results, vmap_method="broadcast_all", input_output_aliases=aliases
    )
    operands = (
        state.positions,
        state.velocities,
        grains.radii,
        grains.masses,
        jnp.stack([jnp.asarray(x).astype(dtype) for x in inputs]),
        steps.astype(dtype),
        *(() if memory is None else (memory,)),
    )
    kinds = {x.dtype.name for x in operands}
    if kinds != {"float64"}:  # the engine reads doubles whatever it is given
        raise InputError(f"the engine numba must be given float64 only, not {sorted(kinds)}.")
    positions, velocities, blocks, memory, records = call(*operands)
    last = blocks[-1]
    end = State(grains, positions, velocities, state.side, last[layout.TILT])
    sums = jax.vmap(sums_from_row)(blocks[:, :NUMBERS], blocks[:, layout.STATUS].astype(jnp.int32))
    recorded = last[layout.RECORDED].astype(jnp.int32)
    kinetic, drift = blocks[:, layout.KINETIC], blocks[:, layout.DRIFT]
    return NumbaCall(end, sums, kinetic, drift, last[layout.SUSPENDED], recorded, records, memory)
