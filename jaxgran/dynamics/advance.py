"""The public advance of one replica, by the engine that ``engine`` selects.

XLA calls the machine code through its foreign function interface, and the thread block as a kernel of Pallas, so
``jit``, ``lax.map`` and ``vmap`` apply to them as to everything else.
"""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Int

from jaxgran.dynamics import plain as plain_module
from jaxgran.dynamics.engine import select_engine
from jaxgran.dynamics.plain import ended, require_advance
from jaxgran.dynamics.tally import NUMBERS, Tally, sums_from_row
from jaxgran.model.cell import wrap
from jaxgran.model.flow import ShearFlow
from jaxgran.model.state import State

_Compiled = Callable[[ShearFlow, State, Array], tuple[State, Tally]]


def advance(
    flow: ShearFlow,
    state: State,
    steps: Int[Array, ""],
    free_flight: bool = True,
    events: int | None = None,
    moving_contacts: bool = False,
) -> tuple[State, Tally]:
    """Advance one replica by a number of time steps.

    The ``engine`` of the flow says what runs. With "auto" it is the fastest that can: on a processor or an NVIDIA GPU,
    with the default solver and no more arguments than these three, a loop of compiled code that solves the same steps
    to the same tolerance as the engine jax. On a processor it is typically 5 to 7 times faster. Nothing but rounding
    and what the tolerance leaves open tells them apart.

    Forward-mode derivatives (``jax.jvp``, ``jax.jacfwd``) go through it as it is; for those in reverse mode
    (``jax.grad``, ``jax.vjp``) the number of ``events`` must be given. Reverse mode stores the state and the lists of
    every event, about 0.7 kB for each grain, and finds its contacts and impulses again on the way back.

    Args:
      flow: parameters; all numbers of one replica.
      state: the flow at the beginning.
      steps: number of time steps, traced.
      free_flight: whether steps without an approaching contact are jumped over. ``False`` visits every step;
        the trajectory is the same.
      events: None for as many evaluations as it takes, or the number of them, static, in a loop of fixed length: one
        for each step that is visited, ``steps + 1`` at most, see ``count_events``. Where they do not suffice the
        status is ``capacity``.
      moving_contacts: whether derivatives include that a contact moves in time, see ``dynamics``. Values do not change.

    Returns:
      The state after the last step, and the tally of the steps. A replica that is no longer finite stops with
      the status ``nonfinite``; so does, on a GPU, one whose lists have no room, with ``capacity``.

    Raises:
      InputError: the flow names an engine that cannot do what is asked.
    """
    require_advance(flow, state, steps)
    asked = {"free_flight=False": not free_flight, "events": events is not None, "moving_contacts": moving_contacts}
    engine = select_engine(flow, state, " and ".join(name for name, wanted in asked.items() if wanted))
    if engine == "jax":
        return plain_module.advance(flow, state, steps, free_flight, events, moving_contacts)
    return _advance(machine_code if engine == "machine_code" else thread_block, flow, state, steps)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _advance(by: _Compiled, flow: ShearFlow, state: State, steps: Array) -> tuple[State, Tally]:
    return by(flow, state, steps)


@_advance.defjvp
def _advance_jvp(by: _Compiled, primals: tuple, tangents: tuple) -> tuple[tuple[State, Tally], tuple[State, Tally]]:
    return jax.jvp(plain_module.advance, primals, tangents)


def machine_code(flow: ShearFlow, state: State, steps: Array) -> tuple[State, Tally]:
    """Advance one replica by the machine code."""
    from jaxgran.dynamics.machine_code import ffi, loop

    ffi.register()
    dtype, grains = state.positions.dtype, state.grains
    numbers = (state.side, state.tilt, flow.restitution, flow.timestep, flow.shear_rate, flow.tolerance)
    numbers = (*numbers, flow.activation_fraction, flow.max_iterations, steps)
    shapes = [jax.ShapeDtypeStruct(shape, dtype) for shape in (*[state.positions.shape] * 2, (loop.RESULTS,))]
    call = jax.ffi.ffi_call(ffi.TARGET, shapes, vmap_method="sequential")
    packed = jnp.stack([jnp.asarray(x).astype(dtype) for x in numbers])
    positions, velocities, results = call(state.positions, state.velocities, grains.radii, grains.masses, packed)
    status, tilt = results[loop.STATUS], results[loop.TILT]
    sums = sums_from_row(results[:NUMBERS], status.astype(jnp.int32))
    return ended(state, wrap(positions, state.side, tilt), tilt, velocities, sums)


def thread_block(flow: ShearFlow, state: State, steps: Array) -> tuple[State, Tally]:
    """Advance one replica by the kernel of ``thread_block``, and plainly where this is compiled for another device."""
    from jaxgran.dynamics.thread_block.kernel import advance

    return lax.platform_dependent(flow, state, steps, cuda=advance, default=plain_module.advance)
