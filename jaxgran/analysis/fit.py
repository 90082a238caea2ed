"""The restitution of grains whose states were seen at the start and at the end of short windows of
a flow.

The misfit is that of ``advance`` from the starts to the ends, in standard deviations of the noise.
Adam (optax) minimises it by derivatives in reverse mode, with contacts that move in time. A grain
that hits another partner is off by many standard deviations, which makes local minima: most
iterations sum log(1 + r²/4) over the grains, not r².
"""

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import lax
from jaxtyping import Array, Float

from jaxgran.contact.projected_methods import BarzilaiBorwein
from jaxgran.dynamics.advance import advance
from jaxgran.dynamics.batch import checked_batch
from jaxgran.dynamics.jax_engine import count_events, require_advance
from jaxgran.model.batches import equal_values
from jaxgran.model.cell import displacement
from jaxgran.model.checks import InputError, require_number, require_untraced, require_whole
from jaxgran.model.choices import MAX_STEPS
from jaxgran.model.flow import ShearFlow
from jaxgran.model.state import State
from jaxgran.model.status import Status

# σ, largest rms of ∂(position)/∂α: beyond it, another α of the same order leads to other collisions
HORIZON = 1.0
_RATE = 0.05  # of Adam at the beginning; it falls to zero
_ROBUST = 0.75  # share of the iterations that minimise the sum of logarithms
_MOST_ITERATIONS = 100_000
_SOLVER = BarzilaiBorwein(tolerance=1e-9, max_steps=20_000)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class TrajectoryFit:
    """A fit of the restitution to windows of a flow.

    ===========  ====================  ====  =======================================================
    field        shape                 unit  meaning
    ===========  ====================  ====  =======================================================
    restitution  ()                    –     α
    stderr       ()                    –     its standard error, from the curvature of the misfit
    misfit       (iterations,)         –     χ² of each iteration over the degrees of freedom
    velocities   (windows, grains, 2)  σ/t   at the start; None unless they were fitted
    positions    (windows, grains, 2)  σ     at the start; None unless they were fitted
    ===========  ====================  ====  =======================================================
    """

    restitution: float
    stderr: float
    misfit: Float[np.ndarray, " iterations"]
    velocities: Float[np.ndarray, "windows grains 2"] | None = None
    positions: Float[np.ndarray, "windows grains 2"] | None = None

    __eq__ = equal_values


def fit_trajectory(
    flow: ShearFlow,
    start: State,
    end: State,
    steps: int,
    position_noise: float,
    velocity_noise: float,
    *,
    velocities: bool = False,
    positions: bool = False,
    events: int | None = None,
    iterations: int = 200,
) -> TrajectoryFit:
    """Infer the restitution of a flow, and where asked the states at the start, from short windows
    of it.

    Args:
      flow: parameters of the flow; its restitution is the first guess. A time step much shorter
        than the noise of the positions over the speeds is best.
      start: states (windows,) seen at the start; exact where they are not fitted.
      end: states (windows,) seen at the end, with independent Gaussian noise of positions and
        velocities.
      steps: time steps of a window.
      position_noise: standard deviation of each coordinate, in σ.
      velocity_noise: standard deviation of each component of the peculiar velocities, in σ/t.
      velocities: whether to fit the velocities at the start, seen with the same noise.
      positions: whether to fit the positions at the start, seen with the same noise.
      events: most steps with contacts in a window, see ``advance``, at least as many as at the
        guess; None for half as many again.
      iterations: of Adam.

    Raises:
      InputError: (a ValueError) the arguments are not windows of this flow; a window is longer than
        the horizon, at which the rms of ∂(position)/∂α of its grains is one diameter; there are
        more ``events``; or the misfit stays above what the noise explains, as in a minimum with
        other collisions, which a noisy start makes likely. Or JAX traces an argument.
    """
    require_untraced("fit_trajectory", "call it with numbers", flow, start, end)
    require_number(
        "restitution",
        flow.restitution,
        lambda x: (x > 0) & (x < 1),
        "one first guess between 0 and 1",
    )
    require_whole("iterations", iterations, 10, _MOST_ITERATIONS)
    for name, noise in (("position_noise", position_noise), ("velocity_noise", velocity_noise)):
        require_number(name, noise, lambda x: (x > 0) & np.isfinite(x), "above 0")
    batch = checked_batch(require_advance, flow, start, steps)
    if (
        batch is None
        or not isinstance(end, State)
        or np.shape(end.positions) != np.shape(start.positions)
    ):
        raise InputError(
            "start and end must be states with the same axis (windows,), such as prepare returns."
        )
    needed = int(np.max(lax.map(lambda x: count_events(*x, solver=_SOLVER), batch)))
    events = 8 + 3 * needed // 2 if events is None else events
    require_whole("events", events, needed, MAX_STEPS, "the most steps of an advance")
    noises = jnp.asarray([position_noise, velocity_noise])
    chosen = [
        name for name, given in (("velocities", velocities), ("positions", positions)) if given
    ]
    unknowns = {name: jnp.zeros_like(start.positions) for name in chosen}
    unknowns["restitution"] = jnp.asarray(flow.restitution, float)
    _require_short(_slopes(events, batch, end, noises, unknowns)[0] * position_noise)
    with jax.numpy_dtype_promotion("standard"):  # which optax needs
        unknowns, misfit, status = _minimised(events, iterations, batch, end, noises, unknowns)
    if np.any(np.asarray(status) == Status.capacity):
        raise InputError(
            f"events must be more than {events}: some window has more steps with contacts."
        )
    size, information = _slopes(events, batch, end, noises, unknowns)
    _require_short(size * position_noise)
    freedom = 2 * start.positions.size - 1
    misfit = np.asarray(misfit) / freedom
    if not misfit[-1] <= 1 + 5 * np.sqrt(2 / freedom):
        raise InputError(
            "the windows must follow from one restitution within the noise, and χ² is "
            f"{misfit[-1]:.3g} per degree of freedom: take shorter windows, another first guess, "
            "more iterations, or the true noise."
        )
    found = _start_of(start, noises, unknowns)
    return TrajectoryFit(
        float(unknowns["restitution"]),
        float(1 / np.sqrt(np.sum(information))),
        misfit,
        np.asarray(found.velocities) if velocities else None,
        np.asarray(found.positions) if positions else None,
    )


def _require_short(sizes: Array) -> None:
    worst = float(np.max(sizes))
    if not worst <= HORIZON:
        raise InputError(
            f"steps must be fewer: in some window the rms of ∂(position)/∂α is {worst:.2g} "
            f"diameters, and beyond {HORIZON:g} derivatives lose their meaning."
        )


def _start_of(state: State, noises: Array, unknowns: dict[str, Array]) -> State:
    """The states with the fitted starts, which are unknowns in standard deviations of the noise."""
    order = {"positions": noises[0], "velocities": noises[1]}
    moved = {
        name: getattr(state, name) + order[name] * x
        for name, x in unknowns.items()
        if name in order
    }
    return replace(state, **moved)


def _residuals(
    events: int, batch: Any, end: State, noises: Array, unknowns: dict[str, Array]
) -> tuple[Array, Array]:
    """Deviations of a window (grains, 4) at its end in standard deviations, positions first; and
    its status.
    """
    flow, state, steps = batch
    later = replace(flow, restitution=unknowns["restitution"])
    state = _start_of(state, noises, unknowns)
    after, tally = advance(later, state, steps, events=events, moving_contacts=True, solver=_SOLVER)
    moved = displacement(after.positions, end.positions, after.side, after.tilt)
    return jnp.concatenate(
        [moved / noises[0], (after.velocities - end.velocities) / noises[1]], -1
    ), tally.status


@partial(jax.jit, static_argnums=(0, 1))
def _minimised(
    events: int, iterations: int, batch: Any, end: State, noises: Array, unknowns: dict[str, Array]
) -> tuple[dict[str, Array], Array, Array]:
    """The unknowns at the minimum, and χ² and the worst status of each iteration."""

    def objective(unknowns: dict[str, Array], robust: Array) -> tuple[Array, tuple[Array, Array]]:
        def of_window(window: Any) -> tuple[Array, Array]:
            batch, end, starts = window
            shared = {"restitution": unknowns["restitution"], **starts}
            return _residuals(events, batch, end, noises, shared)

        starts = {name: x for name, x in unknowns.items() if name != "restitution"}
        residuals, status = lax.map(of_window, (batch, end, starts))
        squares = jnp.sum(residuals**2, axis=-1)
        known = sum(jnp.sum(x**2) for x in starts.values())
        value = jnp.sum(jnp.where(robust, 4 * jnp.log1p(squares / 4), squares)) + known
        return value, (jnp.sum(squares) + known, jnp.max(status))

    optimiser = optax.adam(optax.cosine_decay_schedule(_RATE, iterations))

    def step(carry: Any, iteration: Array) -> tuple[Any, Any]:
        unknowns, memory = carry
        slopes, seen = jax.grad(objective, has_aux=True)(
            unknowns, iteration < int(_ROBUST * iterations)
        )
        updates, memory = optimiser.update(slopes, memory, unknowns)
        moved: Any = optax.apply_updates(unknowns, updates)
        return (moved | {"restitution": jnp.clip(moved["restitution"], 0, 1)}, memory), seen

    (unknowns, _), (misfit, status) = lax.scan(
        step, (unknowns, optimiser.init(unknowns)), jnp.arange(iterations)
    )
    return unknowns, misfit, status


@partial(jax.jit, static_argnums=0)
def _slopes(
    events: int, batch: Any, end: State, noises: Array, unknowns: dict[str, Array]
) -> tuple[Float[Array, " windows"], Float[Array, " windows"]]:
    """The rms over the grains of ∂(position)/∂α in units of the noise, and the information about α,
    of each window.

    With deviations r, their slopes J by α and S by the start, which is known to one standard
    deviation, the information is Jᵀ (1 + S Sᵀ)⁻¹ J: half of the curvature of the misfit where the
    start follows.
    """

    def of_window(window: Any) -> tuple[Array, Array]:
        batch, end, starts = window

        def deviations(unknowns: dict[str, Array]) -> Array:
            return _residuals(events, batch, end, noises, unknowns)[0]

        slopes = jax.jacfwd(deviations)({"restitution": unknowns["restitution"], **starts})
        by_alpha = slopes["restitution"]
        spread = jnp.eye(by_alpha.size)
        for name in starts:
            by_start = slopes[name].reshape(by_alpha.size, -1)
            spread = spread + by_start @ by_start.T
        size = jnp.sqrt(jnp.mean(jnp.sum(by_alpha[:, :2] ** 2, axis=-1)))
        return size, by_alpha.ravel() @ jnp.linalg.solve(spread, by_alpha.ravel())

    starts = {name: x for name, x in unknowns.items() if name != "restitution"}
    return lax.map(of_window, (batch, end, starts))
