"""How fast the derivatives of a flow grow with strain, and how near a run comes to points without a derivative.

Colliding discs are chaotic: the effect of a change of the restitution on the state grows exponentially with strain.
The derivative of the state is exact, but it is useless beyond the strain at which it exceeds the size of the state.

Within the fixed time steps of a run the state is a smooth function of its parameters, except at two kinds of points. At
one kind a contact of the solve neither presses nor parts. At the other a pair becomes a contact exactly at the end of a
step. There left and right derivatives differ, and the derivative returned is that of the contacts found.
"""

from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from jaxgran.contact.delassus import delassus_product, diagonal
from jaxgran.contact.network import first_contact_time
from jaxgran.contact.projected_methods import BarzilaiBorwein, ProjectedMethod, require_solver
from jaxgran.dynamics.jax_engine import advance_by_jax
from jaxgran.dynamics.snapshots import Snapshot
from jaxgran.model.cell import displacement, relative_velocity
from jaxgran.model.checks import require_whole
from jaxgran.model.flow import ShearFlow, require_strain
from jaxgran.model.state import State, require_match, require_state

_EXACT = BarzilaiBorwein(tolerance=1e-8)
_MOST_POINTS = 10**6  # of a growth curve, which is held in memory


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Growth:
    """Growth of ∂(state)/∂α along a flow.

    ==========  =========  ====  ==================================================================
    field       shape      unit  meaning
    ==========  =========  ====  ==================================================================
    strain      (points,)  –     strain since the beginning, where the derivative is zero
    derivative  (points,)  –     root mean square over the grains of |∂(position)/∂α| in σ and
                                 |∂(velocity)/∂α| in σγ̇, together
    status      (points,)  –     worst status since the beginning
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
    """The derivative of a flow with respect to its restitution at equal intervals of strain.

    Args:
      flow: parameters of the state.
      state: the flow at the beginning.
      strain: total strain.
      count: number of points, static.
      moving_contacts: whether the derivative lets contacts move in time, see ``dynamics.jax_engine``.
      solver: solves the contacts of each step; derivatives want a tolerance of 1e-8 or less.

    Raises:
      InputError: (a ValueError) the strain is shorter than a time step for each point.
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
    steps = jnp.round(strain / (flow.shear_rate * flow.timestep))
    edges = jnp.round(steps * jnp.arange(count + 1, dtype=steps.dtype) / count)

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
    _, (sizes, status) = lax.scan(interval, ((state, zero), jnp.int32(0)), jnp.diff(edges).astype(jnp.int32))
    return Growth(edges[1:] * flow.shear_rate * flow.timestep, sizes, status)


def lyapunov_exponent(strain: np.ndarray, derivative: np.ndarray) -> tuple[float, float]:
    """Rate λ of |∂(state)/∂α| ∝ exp(λ γ), per unit strain γ, with its standard error.

    The rate of each run is the least-squares slope over the last three quarters of its strain, because the derivative
    is zero at the beginning. The error is that of the mean over runs.

    Args:
      strain: (points,).
      derivative: (runs, points), of two or more runs, as in ``Growth``.
    """
    later = strain >= strain[-1] / 4
    slopes = np.polyfit(strain[later], np.log(derivative[:, later]).T, 1)[0]
    return float(slopes.mean()), float(slopes.std(ddof=1) / np.sqrt(len(slopes)))


class Margins(NamedTuple):
    """How far each step of a run is from a change of its contacts; zero at a point without a derivative.

    ==========  ========  ====  ============================================================================
    field       shape     unit  meaning
    ==========  ========  ====  ============================================================================
    pressing    (times,)  –     for each contact the larger of W_kk p_k and the velocity at which it parts;
                                the smallest of these over the root mean square velocity of approach;
                                infinite without contacts
    activation  (times,)  dt    for each pair the time between its touching and the end of the look-ahead
                                that makes it a contact; the smallest of these
    ==========  ========  ====  ============================================================================
    """

    pressing: Float[Array, " times"]
    activation: Float[Array, " times"]


@partial(jax.jit, static_argnums=0)
def margins(activation_fraction: float, series: Snapshot) -> Margins:
    """Margins of the steps of a run, from a snapshot of every step (``snapshot_series`` with a count of its steps).

    All pairs of grains are compared, so memory and time grow as N².

    Args:
      activation_fraction: look-ahead of the flow in time steps, static.
      series: snapshots with a leading (times,) axis.
    """

    def one(seen: Snapshot) -> tuple[Array, Array]:
        state, contacts = seen.state, seen.contacts
        count = state.grains.radii.size
        impulses = seen.impulses / (1 + seen.restitution)
        pressing = diagonal(contacts, count) * impulses
        parting = delassus_product(contacts, impulses, count) + contacts.approach
        used = jnp.sum(contacts.used.astype(pressing.dtype))
        scale = jnp.sqrt(jnp.sum(contacts.approach**2) / jnp.maximum(1, used))
        strict = jnp.where(contacts.used, jnp.maximum(pressing, parting), jnp.inf)
        i, j = jnp.triu_indices(count, 1)
        separations = displacement(state.positions[i], state.positions[j], state.side, state.tilt)
        velocities = relative_velocity(state.velocities, i, j, separations, seen.shear_rate)
        time, _ = first_contact_time(separations, velocities, state.grains.radii[i] + state.grains.radii[j])
        late = jnp.abs(time / seen.timestep - activation_fraction)
        return jnp.min(strict) / jnp.where(scale > 0, scale, 1), jnp.min(late)

    return Margins(*lax.map(one, series))
