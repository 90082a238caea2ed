"""How fast the derivatives of a flow grow with strain.

Colliding discs are chaotic: the effect of a change of the restitution on the state grows exponentially with strain.
The derivative of the state is exact, but useless beyond the strain at which it exceeds the size of the state.

At fixed time steps the state is a smooth function of its parameters except where a contact of the solve neither presses
nor separates, or where a pair becomes a contact exactly at the end of a step. There the left and right derivatives
differ, and the one returned is that of the contacts in the solve.
"""

from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from jaxgran.contact.projected_methods import BarzilaiBorwein, ProjectedMethod, require_solver
from jaxgran.dynamics.jax_engine import advance_by_jax
from jaxgran.model.checks import require_whole
from jaxgran.model.flow import ShearFlow, require_strain, steps_of_blocks, steps_of_strain
from jaxgran.model.state import State, require_match, require_state

_EXACT = BarzilaiBorwein(tolerance=1e-8)
_MOST_POINTS = 10**6  # of a growth curve, held in memory


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Growth:
    """Growth of ∂(state)/∂α with strain.

    ==========  =========  ====  ==================================================================
    field       shape      unit  meaning
    ==========  =========  ====  ==================================================================
    strain      (points,)  –     strain since the start, where the derivative is zero
    derivative  (points,)  –     root mean square over the grains of |∂(position)/∂α| in σ and
                                 |∂(velocity)/∂α| in σγ̇, together
    status      (points,)  –     worst status since the start
    ==========  =========  ====  ==================================================================
    """

    strain: Float[Array, "*b points"]
    derivative: Float[Array, "*b points"]
    status: Int[Array, "*b points"]


def growth(
    flow: ShearFlow,
    state: State,
    strain: float | Array,
    count: int,
    moving_contacts: bool = True,
    *,
    solver: ProjectedMethod = _EXACT,
) -> Growth:
    """Size of the derivative of a flow with respect to its restitution, at equal intervals of strain.

    Args:
      flow: parameters of the state.
      state: initial state of the flow.
      strain: total strain.
      count: number of points, static.
      moving_contacts: whether the derivative includes the change of contact times, see ``dynamics.jax_engine``.
      solver: solves the contacts of each step, with a tolerance of 1e-8 or less.

    Raises:
      InputError: the strain is shorter than ``count`` time steps.
    """
    require_state(flow, state)
    require_whole("count", count, 1, _MOST_POINTS, "as memory is limited")
    require_strain(flow, strain, count)
    require_match(flow, state)
    require_solver(solver)
    return _growth(flow, solver, state, strain, count, moving_contacts)


@partial(jax.jit, static_argnames=("count", "moving_contacts"))
def _growth(
    flow: ShearFlow, solver: ProjectedMethod, state: State, strain: Array, count: int, moving_contacts: bool
) -> Growth:
    steps = steps_of_blocks(steps_of_strain(flow, strain), count)

    def interval(carry, steps: Array):
        (now, change), status = carry

        def run(alpha, positions, velocities, tilt):
            start = State(now.grains, positions, velocities, now.side, tilt)
            changed = replace(flow, restitution=alpha)
            end, tally = advance_by_jax(changed, solver, start, steps, moving_contacts=moving_contacts)
            return (end.positions, end.velocities, end.tilt), tally.status

        alpha = jnp.asarray(flow.restitution, now.side.dtype)
        start = (alpha, now.positions, now.velocities, now.tilt)
        (x, c, tilt), (dx, dc, dtilt), worst = jax.jvp(run, start, (jnp.ones_like(alpha), *change), has_aux=True)
        status = jnp.maximum(status, worst)
        size = jnp.sqrt(jnp.mean(jnp.sum(dx**2 + (dc / flow.shear_rate) ** 2, axis=-1)))
        return ((State(now.grains, x, c, now.side, tilt), (dx, dc, dtilt)), status), (size, status)

    zero = (jnp.zeros_like(state.positions), jnp.zeros_like(state.velocities), jnp.zeros_like(state.tilt))
    _, (sizes, status) = lax.scan(interval, ((state, zero), jnp.int32(0)), steps)
    return Growth(jnp.cumsum(steps).astype(state.side.dtype) * flow.shear_rate * flow.timestep, sizes, status)


def lyapunov_exponent(strain: np.ndarray, derivative: np.ndarray) -> tuple[float, float]:
    """Rate λ of |∂(state)/∂α| ∝ exp(λ γ), per unit strain γ, with its standard error.

    The rate of a run is the least-squares slope over the last three quarters of its strain, since the derivative starts
    from zero. The error is that of the mean over runs.

    Args:
      strain: (points,).
      derivative: (runs, points), of two or more runs, as in ``Growth``.
    """
    later = strain >= strain[-1] / 4
    slopes = np.polyfit(strain[later], np.log(derivative[:, later]).T, 1)[0]
    return float(slopes.mean()), float(slopes.std(ddof=1) / np.sqrt(len(slopes)))
