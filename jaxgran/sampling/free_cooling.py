"""Free cooling: inelastic grains without shear, whose granular temperature falls in collisions.

The engine is that of sheared flows at γ̇ = 0: the same contacts, solves and flights. Nothing sets a unit of time but the
velocities: twice as fast grains with half the time step do the same, bit for bit, in half the time. A homogeneous gas
follows Haff's law, T = T₀/(1 + t/τ)², or T = T₀ exp(−(1 − α²) C/2) in collisions per grain C (P. K. Haff, J. Fluid
Mech. 134, 401, 1983), until shear modes and clusters grow in cells that are large enough for them.
"""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int

from jaxgran.dynamics.advance import advance
from jaxgran.dynamics.tally import Tally
from jaxgran.model.checks import InputError, listed, require, two_digits
from jaxgran.model.flow import MAX_STEPS, ShearFlow
from jaxgran.model.state import State, require_state

_CROSSING = 0.1  # of its diameter that a grain of thermal speed may cross in one step
_ROUNDING_STEPS = 20  # roundings of a position that such a grain must cross in one, at the start


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Cooling:
    """A free cooling; a batch has a leading (replicas,) axis everywhere.

    ===========  ========  ======  ====================================================================
    field        shape     unit    meaning
    ===========  ========  ======  ====================================================================
    times        (times,)  t       since the start, in whole time steps
    temperature  (times,)  mσ²/t²  granular temperature Σ m c²/(2N) at these times
    collisions   (times,)  –       approaching contacts per grain since the start, each grain counting its own
    tally        (times,)  –       sums over the steps since the time before, or since the start
    ===========  ========  ======  ====================================================================
    """

    times: Float[Array, "*b times"]
    temperature: Float[Array, "*b times"]
    collisions: Float[Array, "*b times"]
    tally: Tally

    @property
    def status(self) -> Int[Array, "*b"]:
        """The worst status."""
        return jnp.max(self.tally.status, axis=-1)


def cooling(flow: ShearFlow, state: State, times: ArrayLike) -> tuple[State, Cooling]:
    """Let a flow without shear go for a while, and record how it cools; ``jit``, ``vmap`` and ``lax.map`` apply.

        flow = jg.ShearFlow(256, restitution=0.9, packing_fraction=0.3, timestep=1e-3, shear_rate=0.0)
        state = jg.heated(flow, jax.random.key(0), temperature=1.0)
        state, _ = jg.cooling(replace(flow, restitution=1.0), state, [10.0])  # a gas in equilibrium
        state, cooled = jg.cooling(flow, state, np.geomspace(0.1, 1000, 40))

    The time step stays as it is while the grains slow down; it costs nothing, since steps without a contact are jumped
    over. In float32 a step of slow grains is lost in rounding at last: use float64 for long coolings.

    Args:
      flow: parameters, those of the state, with ``shear_rate`` zero.
      state: the flow at the beginning, best from ``heated`` and some collisions at restitution one.
      times: (times,) increasing times since the beginning at which it is looked at, rounded to whole time steps.

    Returns:
      The state at the last of the times, and the record.

    Raises:
      ValueError: the flow is sheared, the times do not increase by a time step or more, or a grain of thermal speed
        would cross more than a tenth of its diameter in a step.
    """
    require_state(flow, state)
    require("shear_rate", flow.shear_rate, lambda x: x == 0, "0 in free cooling")
    times = _require_times(flow, times)
    _require_slow(flow, state)
    return _cooling(flow, state, times)


@jax.jit
def _cooling(flow: ShearFlow, state: State, times: Float[Array, " times"]) -> tuple[State, Cooling]:
    dtype = state.side.dtype
    edges = jnp.round(times / flow.timestep)
    steps = jnp.diff(edges, prepend=0).astype(jnp.int32)

    def part(now: State, steps: Array) -> tuple[State, tuple[Array, Tally]]:
        now, tally = advance(flow, now, steps)
        return now, (_temperature(now), tally)

    state, (temperature, tally) = lax.scan(part, state, steps)
    collisions = 2 * jnp.cumsum(tally.collisions) / flow.grains
    return state, Cooling((edges * flow.timestep).astype(dtype), temperature, collisions, tally)


def _temperature(state: State) -> Float[Array, ""]:
    return jnp.sum(state.grains.masses[:, None] * state.velocities**2) / (2 * state.grains.masses.size)


def _require_times(flow: ShearFlow, times: Any) -> Array:
    """The times as an array; an InputError unless they are positive and each is a step or more after the last."""
    if isinstance(times, Tracer):
        return times
    values = listed(times)
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
    return jnp.asarray(values)


def _require_slow(flow: ShearFlow, state: State) -> None:
    if any(isinstance(x, Tracer) for x in (flow.timestep, *jax.tree.leaves(state))):
        return
    diameters, masses = 2 * np.asarray(state.grains.radii), np.asarray(state.grains.masses)
    speeds = np.sqrt(2 * float(_temperature(state)) / masses)
    rounding = float(np.finfo(state.positions.dtype).eps * np.max(np.asarray(state.side)))
    if float(np.asarray(flow.timestep) * np.max(speeds)) < _ROUNDING_STEPS * rounding:
        raise InputError(
            f"timestep must be longer for positions in {state.positions.dtype}, or a step would be lost in their "
            'rounding: use a longer one, or float64 (jax.config.update("jax_enable_x64", True)).'
        )
    with np.errstate(divide="ignore"):
        longest = _CROSSING * float(np.min(diameters / speeds))
    if float(np.asarray(flow.timestep)) > longest:
        raise InputError(
            f"timestep must be at most {two_digits(longest, up=False)} at this temperature, or grains would cross more "
            "than a tenth of a diameter in one step."
        )
