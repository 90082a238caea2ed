"""The advance in use: the fastest that there is for a flow here and now.

==================  ==========================================================================================
on                  what advances a replica
==================  ==========================================================================================
a processor         machine code (``event_loop``), in double precision, unless a batch has a named axis
an NVIDIA GPU       a thread block (``thread_block``), up to 1024 grains, in single or double precision
anything else       the plain ``dynamics.advance``; so too derivatives, and every method of the contact solve but the
                    default
==================  ==========================================================================================

All three solve the same steps to the same tolerance. XLA calls the machine code through its foreign function interface,
and the thread block as a kernel of Pallas, so ``jit``, ``lax.map`` and ``vmap`` apply to them as to everything else.
"""

import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Int

from jaxgran.dynamics import plain as plain_module
from jaxgran.dynamics.plain import ended, require_advance
from jaxgran.dynamics.tally import NUMBERS, Tally, sums_from_row
from jaxgran.model.cell import wrap
from jaxgran.model.control_flow import in_batch
from jaxgran.model.flow import ShearFlow
from jaxgran.model.state import State

MOST_GRAINS = 1024  # of a thread block: the threads that it can have
_SOLVER = ShearFlow.__dataclass_fields__["solver"].default
Engine = Callable[[ShearFlow, State, Array], tuple[State, Tally]]


def advance(
    flow: ShearFlow,
    state: State,
    steps: Int[Array, ""],
    free_flight: bool = True,
    events: int | None = None,
    moving_contacts: bool = False,
) -> tuple[State, Tally]:
    """Advance one replica by a number of time steps.

    On a processor or an NVIDIA GPU, with the default solver and no more arguments than these three, this is a loop of
    compiled code that solves the same steps to the same tolerance as the plain advance, see ``native``; on a processor
    it is typically 5 to 7 times faster. Nothing but rounding and what the tolerance leaves open tells them apart.

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
    """
    require_advance(flow, state, steps)
    plain = not free_flight or events is not None or moving_contacts
    by = None if plain else engine(flow, state)
    if by is None:
        return plain_module.advance(flow, state, steps, free_flight, events, moving_contacts)
    return _advance(by, flow, state, steps)


def engine(flow: ShearFlow, state: State) -> Engine | None:
    """What advances a flow here and now: ``machine_code``, ``thread_block``, or None for the plain advance."""
    dtypes = {x.dtype for x in jax.tree.leaves(state)}
    if flow.solver != _SOLVER or len(dtypes) > 1:
        return None
    (dtype,) = dtypes
    device = jax.config.jax_default_device  # pyright: ignore[reportAttributeAccessIssue]  # of ``jax.default_device``
    device = jax.devices(device)[0] if device is None or isinstance(device, str) else device
    if device.platform == "cpu":
        return machine_code if dtype == jnp.float64 and not in_batch() else None
    fits = device.platform == "gpu" and flow.grains <= MOST_GRAINS
    return (
        thread_block if fits and _kernel_runs(flow.grains, dtype, device, jax.config.read("jax_enable_x64")) else None
    )


@cache
def _kernel_runs(grains: int, dtype: jnp.dtype, device: Any, x64: bool) -> bool:
    """Whether the kernel compiles and keeps the laws of contacts on a device: tried once."""

    def trial() -> None:
        from jaxgran.dynamics.thread_block import kernel

        with jax.default_device(device), jax.enable_x64(x64):
            kernel.trial(grains, dtype)

    try:
        with ThreadPoolExecutor(1) as other:  # what is being traced here is not traced there
            other.submit(trial).result()
    except Exception as error:  # of a compiler, a driver or a device: there is no saying which
        problem = f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
        warnings.warn(f"flows take the plain advance: the kernel for GPUs does not run here ({problem}).", stacklevel=2)
        return False
    return True


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _advance(by: Engine, flow: ShearFlow, state: State, steps: Array) -> tuple[State, Tally]:
    return by(flow, state, steps)


@_advance.defjvp
def _advance_jvp(by: Engine, primals: tuple, tangents: tuple) -> tuple[tuple[State, Tally], tuple[State, Tally]]:
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
