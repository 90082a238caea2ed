"""Free cooling: inelastic grains without shear, whose granular temperature falls by collisions.

The engines are those of sheared flows at γ̇ = 0, with the same contacts, solves and flights. Only the velocities set the
unit of time: doubled velocities with half the time step give the same motion, bit for bit, in half the time.

A homogeneous gas follows Haff's law, T = T₀/(1 + t/τ)². In collisions per grain C it is T = T₀ exp(−(1 − α²) C/2)
(P. K. Haff, J. Fluid Mech. 134, 401, 1983). It ends when shear modes and clusters grow, in cells that are large enough.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int

from jaxgran.contact.projected_methods import DEFAULT_SOLVER, ProjectedMethod
from jaxgran.dynamics.advance import advance
from jaxgran.dynamics.engine import Engine, Numerics, checked_numerics
from jaxgran.dynamics.interruption import waited
from jaxgran.dynamics.replicas import checked_batch, over_replicas
from jaxgran.dynamics.tally import Tally
from jaxgran.model.batches import equal_values
from jaxgran.model.checks import InputError, as_array, is_traced, require, two_digits
from jaxgran.model.choices import MAX_STEPS
from jaxgran.model.flow import ShearFlow
from jaxgran.model.state import State, require_match, require_state

_LARGEST_CROSSING = 0.1  # largest motion in one step of a grain of thermal speed, in its diameters
_SMALLEST_CROSSING = 20  # smallest motion in one step of such a grain at the start, in roundings of a position


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Cooling:
    """The record of a free cooling; a batch has a leading (replicas,) axis everywhere.

    ===========  ========  ======  ====================================================================
    field        shape     unit    meaning
    ===========  ========  ======  ====================================================================
    times        (times,)  t       time since the start, in whole time steps
    temperature  (times,)  mσ²/t²  granular temperature Σ m c²/(2N) at these times
    collisions   (times,)  –       approaching contacts per grain since the start, each grain counting its own
    tally        (times,)  –       sums over the steps since the previous time, or since the start
    ===========  ========  ======  ====================================================================
    """

    times: Float[Array, "*b times"]
    temperature: Float[Array, "*b times"]
    collisions: Float[Array, "*b times"]
    tally: Tally

    __eq__ = equal_values

    @property
    def status(self) -> Int[Array, "*b"]:
        """The worst status of all times."""
        return jnp.max(self.tally.status, axis=-1)


def cooling(
    flow: ShearFlow,
    state: State,
    times: ArrayLike,
    *,
    solver: ProjectedMethod = DEFAULT_SOLVER,
    engine: Engine | None = None,
) -> tuple[State, Cooling]:
    """Advance a flow without shear, or a batch of them, and record how it cools; ``jit`` and ``vmap`` apply.

        flow = jg.ShearFlow(256, restitution=0.9, packing_fraction=0.3, timestep=1e-3, shear_rate=0.0)
        state = jg.heated(flow, jax.random.key(0), temperature=1.0)
        state, _ = jg.cooling(replace(flow, restitution=1.0), state, [10.0])  # a gas in equilibrium
        state, cooled = jg.cooling(flow, state, np.geomspace(0.1, 1000, 40))

    The time step is constant while the grains slow down. This costs little, since steps without a contact are jumped
    over. In float32 the motion of slow grains in one step falls below the rounding of positions: use float64 for long
    coolings.

    Args:
      flow: parameters of the state, with ``shear_rate`` zero; or those (replicas,) of a batch, as in ``sample``.
      state: the flow at the beginning, usually from ``heated`` and some collisions at restitution one; or a batch.
      times: (times,) increasing times of the record, in t since the beginning, rounded to whole time steps; the same
        for all replicas.
      solver, engine: as in ``sample``.

    Returns:
      The state at the last of the times, and the record.

    Raises:
      InputError: (a ValueError) the axes of a batch differ, the flow is sheared, the state has another packing fraction
        or polydispersity, the times do not increase by a time step or more, a grain of thermal speed would cross more
        than a tenth of its diameter in one step, positions cannot resolve a step, or the engine cannot do this.
    """
    numerics = checked_numerics(solver, engine)
    batch = checked_batch(partial(_require_cooling, times), flow, state)
    at = times if isinstance(times, Tracer) else jnp.asarray(np.asarray(times, float))
    return waited(_cooling_replicas(numerics, *batch, at) if batch else _cooling(flow, numerics, state, at))


def _require_cooling(times: ArrayLike, flow: ShearFlow, state: State) -> None:
    """Raise an InputError unless the state can cool at these times."""
    require_state(flow, state)
    require("shear_rate", flow.shear_rate, lambda x: x == 0, "0 in free cooling")
    _require_times(flow, times)
    _require_slow(flow, state)
    require_match(flow, state)


@jax.jit
def _cooling_replicas(numerics: Numerics, flow: ShearFlow, state: State, times: Array) -> tuple[State, Cooling]:
    return over_replicas(lambda flow, state: _cooling(flow, numerics, state, times), numerics, (flow, state))


@jax.jit
def _cooling(flow: ShearFlow, numerics: Numerics, state: State, times: Float[Array, " times"]) -> tuple[State, Cooling]:
    dtype = state.side.dtype
    edges = jnp.round(times / flow.timestep)
    steps = jnp.diff(edges, prepend=0).astype(jnp.int32)

    def interval(state: State, steps: Array) -> tuple[State, tuple[Array, Tally]]:
        state, tally = advance(flow, state, steps, solver=numerics.solver, engine=numerics.engine)
        return state, (_temperature(state), tally)

    state, (temperature, tally) = lax.scan(interval, state, steps)
    collisions = 2 * jnp.cumsum(tally.collisions) / flow.grains
    return state, Cooling((edges * flow.timestep).astype(dtype), temperature, collisions, tally)


def _temperature(state: State) -> Float[Array, ""]:
    """Granular temperature Σ m c²/(2N), in mσ²/t²."""
    return jnp.sum(state.grains.masses[:, None] * state.velocities**2) / (2 * state.grains.masses.size)


def _require_times(flow: ShearFlow, times: Any) -> None:
    """Raise an InputError unless the times are positive and increase by a time step or more; traced ones pass."""
    if isinstance(times, Tracer):
        return
    values = as_array(times)
    words = "a list of positive times that increase"
    require("times", values, lambda x: (x.ndim == 1) & (x > 0) & np.isfinite(x), words)
    values = np.asarray(values, float)
    if not isinstance(flow.timestep, Tracer):
        step = float(np.asarray(flow.timestep))
        gaps = np.diff(np.round(values / step), prepend=0)
        if np.any(gaps < 1):
            raise InputError(f"times must increase by a time step, {step:g}, or more.")
        if np.any(gaps > MAX_STEPS):
            raise InputError(f"times must be at most {MAX_STEPS} time steps, {MAX_STEPS * step:g}, apart.")


def _require_slow(flow: ShearFlow, state: State) -> None:
    """Raise an InputError if a grain of thermal speed moves too far or too little in one step."""
    if is_traced(flow.timestep, state):
        return
    diameters, masses = 2 * np.asarray(state.grains.radii), np.asarray(state.grains.masses)
    temperature = np.sum(masses[:, None] * np.asarray(state.velocities) ** 2) / (2 * masses.size)
    speeds = np.sqrt(2 * temperature / masses)
    rounding = float(np.finfo(state.positions.dtype).eps * np.max(np.asarray(state.side)))
    if float(np.asarray(flow.timestep) * np.max(speeds)) < _SMALLEST_CROSSING * rounding:
        raise InputError(
            f"timestep must be longer for positions in {state.positions.dtype}, or a step would be lost in their "
            'rounding: use a longer one, or float64 (jax.config.update("jax_enable_x64", True)).'
        )
    with np.errstate(divide="ignore"):
        longest = _LARGEST_CROSSING * float(np.min(diameters / speeds))
    if float(np.asarray(flow.timestep)) > longest:
        raise InputError(
            f"timestep must be at most {two_digits(longest, up=False)} at this temperature, or grains would cross more "
            "than a tenth of a diameter in one step."
        )
