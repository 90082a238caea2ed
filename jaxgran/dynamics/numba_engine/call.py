"""The numba engine as a function of JAX: one call of XLA's foreign function."""

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from jaxgran.contact.projected_methods import ProjectedMethod
from jaxgran.dynamics.jax_engine import ended
from jaxgran.dynamics.numba_engine import layout
from jaxgran.dynamics.tally import NUMBERS, RunningSums, Tally
from jaxgran.model.checks import InputError
from jaxgran.model.flow import ShearFlow
from jaxgran.model.state import State, kinetic_energy, status_at_start


def register_numba() -> None:
    """Register the numba engine with XLA; it is compiled at its first use on a machine."""
    from jaxgran.dynamics.numba_engine import ffi

    ffi.register()


def advance_by_numba(
    flow: ShearFlow, solver: ProjectedMethod, state: State, steps: Int[Array, "*blocks"]
) -> tuple[State, Tally]:
    """Advance one replica by a number of steps, or by one block of steps after another with a tally
    (blocks,) for each.
    """
    if jnp.ndim(steps) == 0:
        end, tally = advance_by_numba(flow, solver, state, jnp.asarray(steps)[None])
        return end, jax.tree.map(lambda x: x[0], tally)
    call = call_numba(flow, solver, state, steps)
    energies = jnp.concatenate([kinetic_energy(state.grains, state.velocities)[None], call.kinetic])
    tallies = jax.vmap(lambda sums, **ends: sums.tally(**ends))(
        call.sums, energy_change=jnp.diff(energies), momentum_drift=call.drift
    )
    end, last = _end_of(state, call)  # with the energy change of all blocks
    last = replace(last, energy_change=last.energy_change - (energies[-2] - energies[0]))
    return end, jax.tree.map(lambda all_blocks, x: all_blocks.at[-1].set(x), tallies, last)


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
    return jax.ShapeDtypeStruct(
        (1 + layout.WORDS + layout.WORDS_PER_GRAIN * flow.grains,), jnp.float64
    )


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
    sums = RunningSums(blocks[:, :NUMBERS], blocks[:, layout.STATUS].astype(jnp.int32))
    recorded = last[layout.RECORDED].astype(jnp.int32)
    kinetic, drift = blocks[:, layout.KINETIC], blocks[:, layout.DRIFT]
    return NumbaCall(end, sums, kinetic, drift, last[layout.SUSPENDED], recorded, records, memory)
