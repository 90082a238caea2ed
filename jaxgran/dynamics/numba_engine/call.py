"""The numba engine as a function of JAX: one call of XLA's foreign function."""

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from jaxgran.contact.projected_methods import ProjectedMethod
from jaxgran.dynamics.jax_engine import end_of_advance
from jaxgran.dynamics.numba_engine import ffi, layout
from jaxgran.dynamics.numba_engine.team import handler
from jaxgran.dynamics.tally import NUMBERS, RunningSums, Tally
from jaxgran.environment import on_processor
from jaxgran.model.checks import InputError
from jaxgran.model.flow import ShearFlow
from jaxgran.model.state import State, kinetic_energy, status_at_start


def advance_unobserved(
    flow: ShearFlow, solver: ProjectedMethod, state: State, steps: Int[Array, " blocks"]
) -> tuple[State, Tally]:
    """Advance one replica by one block of steps after another, with a tally (blocks,) for each."""
    call = call_numba(flow, solver, state, steps, first_row(flow, state))
    rows = call.blocks
    energy = kinetic_energy(state.grains, state.velocities)
    energies = jnp.concatenate([energy[None], rows[:, layout.KINETIC]])
    tallies = jax.vmap(lambda sums, **ends: sums.tally(**ends))(
        sums_of_row(rows), energy_change=jnp.diff(energies), momentum_drift=rows[:, layout.DRIFT]
    )
    moved = replace(state, positions=call.positions, velocities=call.velocities)
    end, last = ended_by_numba(state, moved, rows[-1])  # with the energy change of all blocks
    last = replace(last, energy_change=last.energy_change - (energies[-2] - energies[0]))
    return end, jax.tree.map(lambda all_blocks, x: all_blocks.at[-1].set(x), tallies, last)


def ended_by_numba(state: State, moved: State, row: Array) -> tuple[State, Tally]:
    """The state at the end of an advance from a state, and the tally of a row of results."""
    return end_of_advance(
        state, moved.positions, row[layout.TILT], moved.velocities, sums_of_row(row)
    )


def first_row(flow: ShearFlow, state: State) -> Array:
    """The row with which a call begins that does not go on with another."""
    dtype = state.positions.dtype
    status = status_at_start(flow, state).astype(dtype)
    row = jnp.zeros(layout.RESULTS, dtype)
    return row.at[layout.STATUS].set(status).at[layout.TILT].set(state.tilt)


def sums_of_row(row: Array) -> RunningSums:
    """The running sums in a row of results, or in those of several blocks."""
    return RunningSums(row[..., :NUMBERS], row[..., layout.STATUS].astype(jnp.int32))


def register() -> None:
    """Load the engine for JAX's default device, or compile it, and register it with XLA; once in a
    process.

    Raises:
      InputError: see ``ffi.register``.
    """
    if on_processor():
        ffi.register()
    else:
        handler.register()


class NumbaCall(NamedTuple):
    """What a call of the numba engine returns.

    =====================  =================  ======================================================
    field                  shape              meaning
    =====================  =================  ======================================================
    positions, velocities  (grains, 2)        of the state at the end; of an unfinished call in the
                                              laboratory, as the next one takes them
    blocks                 (blocks, RESULTS)  sums and results of each block, see ``layout``
    records                (room, numbers)    see ``records``
    =====================  =================  ======================================================
    """

    positions: Array
    velocities: Array
    blocks: Array
    records: Array


def call_numba(
    flow: ShearFlow,
    solver: ProjectedMethod,
    state: State,
    steps: Array,
    begin: Array,
    room: int = 0,
) -> NumbaCall:
    """Run the numba engine once.

    Args:
      flow, solver, state: as in ``advance``; of the state the positions and velocities that an
        unfinished call has left, to go on with it.
      steps: (blocks,) numbers of time steps.
      begin: ``first_row``, or the last row of the call to go on with.
      room: number of records, static, for one block; 0 records nothing. With records the call ends
        unfinished where its list of near pairs ends, or the room.

    On a CUDA device the records are the memory of the loop, and ``room`` must be 0.
    """
    register()
    dtype, grains = state.positions.dtype, state.grains
    records = (room, layout.record_numbers(flow.grains))
    if not on_processor():
        records = (1, handler.words_of_memory(flow.grains))
    inputs = layout.Inputs(
        side=state.side,
        restitution=flow.restitution,
        timestep=flow.timestep,
        shear_rate=flow.shear_rate,
        tolerance=solver.tolerance,
        activation=flow.activation,
        max_steps=solver.max_steps,
    )
    shapes = [state.positions.shape, state.positions.shape, (*steps.shape, layout.RESULTS), records]
    results = [jax.ShapeDtypeStruct(shape, dtype) for shape in shapes]
    operands = (
        state.positions,
        state.velocities,
        grains.radii,
        grains.masses,
        jnp.stack([jnp.asarray(x).astype(dtype) for x in inputs]),
        steps.astype(dtype),
        begin,
    )
    kinds = {x.dtype.name for x in operands}
    if kinds != {"float64"}:  # the engine reads doubles whatever it is given
        raise InputError(f"the engine numba must be given float64 only, not {sorted(kinds)}.")
    call = jax.ffi.ffi_call(ffi.TARGET, results, vmap_method="broadcast_all")
    return NumbaCall(*call(*operands))
