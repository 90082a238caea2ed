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
from jax.scipy.sparse.linalg import cg
from jaxtyping import Array, Float

from jaxgran.contact.projected_methods import BarzilaiBorwein
from jaxgran.dynamics.advance import advance, count_events, require_advance
from jaxgran.dynamics.batch import checked_batch
from jaxgran.dynamics.engine import Jax
from jaxgran.model.cell import displacement
from jaxgran.model.checks import InputError, require_number, require_untraced, require_whole
from jaxgran.model.choices import MAX_STEPS
from jaxgran.model.flow import ShearFlow
from jaxgran.model.state import State
from jaxgran.model.status import Status
from jaxgran.model.values import Value

# σ, largest rms of ∂(position)/∂α: beyond it, another α of the same order leads to other collisions
HORIZON = 1.0
_RATE = 0.05  # of Adam at the beginning; it falls to zero
_ROBUST = 0.75  # share of the iterations that minimise the sum of logarithms
_MOST_ITERATIONS = 100_000
_SOLVED = 1e-8  # residual of conjugate gradients, over the right-hand side
_SOLVER = BarzilaiBorwein(tolerance=1e-9, max_steps=20_000)


@dataclass(frozen=True, eq=False, repr=False)
class TrajectoryFit(Value):
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

    It recovers one α for all windows. In ``tests/test_fit.py``, three windows of 32 grains over a
    strain of 0.05, with noise of 1e-3 σ and 1e-2 σ/t, give α = 0.73 from a first guess of 0.5 with
    errors of 0.001 to 0.003 in four sets. Fitted starts come back with 0.7 of the noise with which
    they were seen, but two of four such fits are refused: noise leads to other collisions. Windows
    in which α changes who collides, and sizes and masses, cannot be fitted.

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
    first_guess = "one first guess between 0 and 1"
    require_number("restitution", flow.restitution, lambda x: (x > 0) & (x < 1), first_guess)
    require_whole("iterations", iterations, 10, _MOST_ITERATIONS)
    for name, noise in (("position_noise", position_noise), ("velocity_noise", velocity_noise)):
        require_number(name, noise, lambda x: (x > 0) & np.isfinite(x), "above 0")
    batch = checked_batch(require_advance, flow, start, steps)
    shape = np.shape(start.positions) if batch else None
    if not isinstance(end, State) or np.shape(end.positions) != shape:
        raise InputError(
            "start and end must be states with the same axis (windows,), such as prepare returns."
        )
    needed = int(np.max(lax.map(lambda x: count_events(*x, solver=_SOLVER), batch)))
    events = 8 + 3 * needed // 2 if events is None else events
    require_whole("events", events, needed, MAX_STEPS, "the most steps of an advance")
    noises = {"positions": jnp.asarray(position_noise), "velocities": jnp.asarray(velocity_noise)}
    windows = batch, end
    fitted = {"velocities": velocities, "positions": positions}
    offsets = {name: jnp.zeros(shape) for name, chosen in fitted.items() if chosen}
    unknowns = jnp.asarray(flow.restitution, float), offsets
    _information(events, windows, noises, unknowns)
    with jax.numpy_dtype_promotion("standard"):  # which optax needs
        unknowns, misfit, status = _minimised(events, iterations, windows, noises, unknowns)
    if np.any(np.asarray(status) == Status.capacity):
        raise InputError(
            f"events must be more than {events}: some window has more steps with contacts."
        )
    information = _information(events, windows, noises, unknowns)
    freedom = 2 * start.positions.size - 1
    misfit = np.asarray(misfit) / freedom
    if not misfit[-1] <= 1 + 5 * np.sqrt(2 / freedom):
        raise InputError(
            "the windows must follow from one restitution within the noise, and χ² is "
            f"{misfit[-1]:.3g} per degree of freedom: take shorter windows, another first guess, "
            "more iterations, or the true noise."
        )
    restitution, offsets = unknowns
    moved = _moved(start, noises, offsets)
    return TrajectoryFit(
        float(restitution),
        float(1 / np.sqrt(information)),
        misfit,
        **{name: np.asarray(getattr(moved, name)) for name in offsets},
    )


def _moved(state: State, noises: dict[str, Array], offsets: dict[str, Array]) -> State:
    """The states at other starts, by offsets in standard deviations of the noise."""
    moved = {name: getattr(state, name) + noises[name] * x for name, x in offsets.items()}
    return replace(state, **moved)


def _residuals(
    events: int, noises: dict[str, Array], window: Any, restitution: Array, offsets: Any
) -> tuple[Float[Array, "grains 4"], Array]:
    """Deviations of a window at its end in standard deviations, positions first; and its status."""
    (flow, state, steps), end = window
    later, start = replace(flow, restitution=restitution), _moved(state, noises, offsets)
    engine = Jax(events=events, moving_contacts=True)
    after, tally = advance(later, start, steps, solver=_SOLVER, engine=engine)
    apart = displacement(after.positions, end.positions, after.side, after.tilt)
    faster = after.velocities - end.velocities
    residuals = [apart / noises["positions"], faster / noises["velocities"]]
    return jnp.concatenate(residuals, axis=-1), tally.status


@partial(jax.jit, static_argnums=(0, 1))
def _minimised(
    events: int, iterations: int, windows: Any, noises: dict[str, Array], unknowns: Any
) -> tuple[Any, Array, Array]:
    """The unknowns at the minimum, and χ² and the worst status of each iteration."""

    def objective(unknowns: Any, robust: Array) -> tuple[Array, tuple[Array, Array]]:
        restitution, offsets = unknowns
        residuals, status = lax.map(
            lambda x: _residuals(events, noises, x[0], restitution, x[1]), (windows, offsets)
        )
        squares = jnp.sum(residuals**2, axis=-1)
        known = sum(jnp.sum(x**2) for x in offsets.values())
        value = jnp.sum(jnp.where(robust, 4 * jnp.log1p(squares / 4), squares)) + known
        return value, (jnp.sum(squares) + known, jnp.max(status))

    optimiser = optax.adam(optax.cosine_decay_schedule(_RATE, iterations))

    def step(carry: Any, iteration: Array) -> tuple[Any, Any]:
        unknowns, memory = carry
        robust = iteration < int(_ROBUST * iterations)
        slopes, misfit_and_status = jax.grad(objective, has_aux=True)(unknowns, robust)
        updates, memory = optimiser.update(slopes, memory, unknowns)
        moved: Any = optax.apply_updates(unknowns, updates)
        restitution, offsets = moved
        return ((jnp.clip(restitution, 0, 1), offsets), memory), misfit_and_status

    begin = unknowns, optimiser.init(unknowns)
    (unknowns, _), (misfit, status) = lax.scan(step, begin, jnp.arange(iterations))
    return unknowns, misfit, status


def _information(events: int, windows: Any, noises: dict[str, Array], unknowns: Any) -> float:
    """The information about α of all windows; an InputError if one is longer than the horizon."""
    sizes, information = _sensitivities(events, windows, noises, unknowns)
    longest = float(np.max(sizes))
    if not longest <= HORIZON:
        raise InputError(
            f"steps must be fewer: in some window the rms of ∂(position)/∂α is {longest:.2g} "
            f"diameters, and beyond {HORIZON:g} derivatives lose their meaning."
        )
    return float(np.sum(information))


@partial(jax.jit, static_argnums=0)
def _sensitivities(
    events: int, windows: Any, noises: dict[str, Array], unknowns: Any
) -> tuple[Float[Array, " windows"], Float[Array, " windows"]]:
    """The rms over the grains of ∂(position)/∂α, and the information about α, of each window.

    With deviations r, their slopes J by α and S by the start, which is known to one standard
    deviation, the information is Jᵀ (1 + S Sᵀ)⁻¹ J: half of the curvature of the misfit where the
    start follows. Conjugate gradients solve it with products of S and Sᵀ.
    """
    restitution, offsets = unknowns

    def of_window(x: Any) -> tuple[Array, Array]:
        window, offsets = x

        def residuals(restitution: Array, offsets: dict[str, Array]) -> Array:
            return _residuals(events, noises, window, restitution, offsets)[0]

        by_alpha = jax.jacfwd(residuals)(restitution, offsets)
        size = jnp.sqrt(jnp.mean(jnp.sum(by_alpha[:, :2] ** 2, axis=-1))) * noises["positions"]
        if not offsets:
            return size, jnp.sum(by_alpha**2)
        _, by_start = jax.linearize(partial(residuals, restitution), offsets)
        transposed = jax.linear_transpose(by_start, offsets)
        explained, _ = cg(lambda r: r + by_start(*transposed(r)), by_alpha, tol=_SOLVED)
        return size, jnp.vdot(by_alpha, explained)

    return lax.map(of_window, (windows, offsets))
