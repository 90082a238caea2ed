"""The restitution of grains from their observed motion.

A trajectory is cut into windows from each frame to the next. Every window is run from the frame it begins with, at a
trial restitution α, and its end is compared with the next frame: the residuals are the differences of the velocities.
A window has a few collisions, so the residuals are nearly linear in α, and their derivatives come with the run (forward
mode, with contacts that move in time). α follows by Gauss-Newton steps with the weights of Cauchy's law: a grain that
meets another one in the run and not in the observation, since the velocities it starts with are noisy, counts little.
The noise is measured from the grains that do not collide, which are most of a short window.

Its standard error is that of the sum over windows, from the scatter of their contributions (the "sandwich" estimate),
so that it holds whatever the law of the residuals.

Source: P. J. Huber and E. M. Ronchetti, Robust Statistics, 2nd ed. (2009), chapters 6 and 7.
"""

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from jaxgran.dynamics.plain import advance
from jaxgran.model.checks import InputError, require_number, shown
from jaxgran.model.flow import MAX_STEPS, ShearFlow
from jaxgran.model.state import State
from jaxgran.model.status import Status

TRIALS = (0.1, 0.3, 0.5, 0.7, 0.9)
_STRIDE = 0.003  # mean grain diameters that a grain moves in a time step of ours, at the root mean square velocity
_FEWEST_STEPS = 10  # of a window
_LARGEST_STEP, _LEAST_STEP, _MOST_STEPS = 0.2, 1e-9, 50
_SETTLED = 1e-2  # standard errors
_CAUCHY = 2.385  # in noises: 95 % as efficient as least squares where the noise is Gaussian
_LEAST_NOISE = 1e-4  # of the root mean square velocity: an exact trajectory has none
_TOLERANCE = 1e-9


@dataclass(frozen=True)
class RestitutionFit:
    """The restitution inferred from a trajectory.

    ===========  ====  ==================================================================================
    field        unit  meaning
    ===========  ====  ==================================================================================
    restitution  –     α
    stderr       –     its standard error
    noise        σγ̇    standard deviation of the noise of a component of an observed velocity
    windows      –     pairs of successive frames that were compared
    collisions   –     collisions in them, in the runs
    outliers     –     share of the components of velocity that are further off than 7 times the noise, as
                       after collisions that a run and the observation do not have in common
    ===========  ====  ==================================================================================
    """

    restitution: float
    stderr: float
    noise: float
    windows: int
    collisions: float
    outliers: float


def fit_restitution(
    strain: Float[np.ndarray, " frames"], states: State, shear_rate: float = 1.0, timestep: float | None = None
) -> RestitutionFit:
    """The restitution with which the observed grains collide, whatever time step they were made with, or none.

    Args:
      strain: strain of each frame, increasing. Between two frames a grain should collide once at most, on average.
      states: the frames, with a leading (frames,) axis. Positions should be good to a few 1e-3 σ; the noise of the
        velocities may be several per cent.
      shear_rate: γ̇ of the observation, in the unit of its velocities.
      timestep: dt of the runs, or None for one in which grains move 0.003 diameters.

    Returns:
      The restitution with its standard error.

    Raises:
      ValueError: the frames are fewer than two, out of order or not finite, or no grains collide between them.
      RuntimeError: the runs fail, or the restitution does not settle.
    """
    strain, count = _judged(strain, states, shear_rate)
    speed = float(np.sqrt(np.mean(np.square(states.velocities))))
    intervals = np.diff(strain) / shear_rate
    if timestep is None:
        timestep = min(_STRIDE / max(speed, float(np.max(shear_rate))), float(intervals.min()) / _FEWEST_STEPS)
    require_number("timestep", timestep, lambda x: (x > 0) & (x * shear_rate <= 0.1), "positive, and 0.1/γ̇ at most")
    steps = np.maximum(1, np.round(intervals / timestep))
    if steps.max() > MAX_STEPS:
        raise InputError(f"timestep must be at least {intervals.max() / MAX_STEPS:g}, not {shown(timestep)}.")
    starts, ends = (jax.tree.map(lambda x, part=part: x[part], states) for part in (slice(None, -1), slice(1, None)))
    flow = ShearFlow(count, 0.5, 0.5, 0.1 / shear_rate, shear_rate, tolerance=_TOLERANCE, max_iterations=20_000)
    windows = (starts, ends, jnp.asarray(intervals / steps), jnp.asarray(steps, jnp.int32))
    least_noise = _LEAST_NOISE * speed

    def compare(alpha: float) -> _Comparison:
        residuals, slopes, collisions, status = _compared(flow, *windows, jnp.asarray(alpha, float))
        worst = Status(int(np.max(status)))
        if worst > Status.deep_overlap:
            raise RuntimeError(
                f"the runs from the frames ended as {worst.name}; positions and radii must be in one unit."
            )
        return _Comparison(alpha, np.asarray(residuals), np.asarray(slopes), float(np.sum(collisions)))

    at = min((compare(alpha) for alpha in TRIALS), key=lambda at: at.loss(least_noise))
    for _ in range(_MOST_STEPS):
        step, error = at.step(least_noise)
        at = compare(float(np.clip(at.restitution + step, 0, 1)))
        if abs(step) <= max(_SETTLED * error, _LEAST_STEP):
            break
    else:
        raise RuntimeError(f"the restitution did not settle: it was last {at.restitution:.3g}.")
    noise = at.noise(least_noise)
    outliers = float(np.mean(np.abs(at.residuals) > 3 * _CAUCHY * noise))
    return RestitutionFit(
        at.restitution, at.step(least_noise)[1], noise / np.sqrt(2), len(steps), at.collisions, outliers
    )


def _judged(strain: Any, states: Any, shear_rate: float) -> tuple[np.ndarray, int]:
    """The strains as an array and the number of grains, of a trajectory that can be fitted."""
    require_number("shear_rate", shear_rate, lambda x: (x > 0) & np.isfinite(x), "a positive number")
    strain, shape = np.asarray(strain, float), states.velocities.shape if isinstance(states, State) else ()
    if strain.ndim != 1 or len(strain) < 2 or len(shape) != 3 or shape[0] != len(strain):
        raise InputError(
            "states must be two or more frames of one flow, with the strain of each, "
            f"not {len(np.atleast_1d(strain))} strains and velocities of shape {shape}."
        )
    if not np.all(np.isfinite(strain)) or np.any(np.diff(strain) <= 0):
        raise InputError("strain must be finite and increase from frame to frame.")
    if not all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(states)):
        raise InputError("states must have finite positions, velocities, radii and masses.")
    return strain, shape[1]


@jax.jit
def _compared(flow: ShearFlow, starts: State, ends: State, timesteps: Array, steps: Int[Array, " windows"], alpha):
    """Residuals (windows, grains, 2) of the velocities at the end of each window, their derivatives with respect to
    the restitution, the collisions of each window, and its status."""

    def window(given):
        start, end, timestep, count = given

        def run(alpha):
            made, tally = advance(
                replace(flow, restitution=alpha, timestep=timestep), start, count, moving_contacts=True
            )
            return made.velocities - end.velocities, (tally.collisions, tally.status)

        residual, slope, (collisions, status) = jax.jvp(run, (alpha,), (jnp.ones_like(alpha),), has_aux=True)
        return residual, slope, collisions, status

    return lax.map(window, (starts, ends, timesteps, steps))


class _Comparison(NamedTuple):
    """Runs at one restitution beside the observation; residuals and slopes are (windows, grains, 2)."""

    restitution: float
    residuals: np.ndarray
    slopes: np.ndarray
    collisions: float

    def noise(self, least: float) -> float:
        """Standard deviation of most of the residuals."""
        return max(1.4826 * float(np.median(np.abs(self.residuals))), least)

    def loss(self, least_noise: float) -> float:
        """Cauchy's negative log-likelihood, its width included: it compares restitutions."""
        noise = self.noise(least_noise)
        return float(np.sum(np.log(noise) + np.log1p((self.residuals / (_CAUCHY * noise)) ** 2)))

    def step(self, least_noise: float) -> tuple[float, float]:
        """Gauss-Newton step of the restitution, and its standard error."""
        weights = 1 / (1 + (self.residuals / (_CAUCHY * self.noise(least_noise))) ** 2)
        curvature = np.sum(weights * self.slopes**2)
        if not curvature > 0:
            raise InputError("states must have collisions between the frames, and no grains collide.")
        pulls = np.sum(weights * self.slopes * self.residuals, axis=(1, 2))
        step = np.clip(-np.sum(pulls) / curvature, -_LARGEST_STEP, _LARGEST_STEP)
        return float(step), float(np.sqrt(np.sum(pulls**2)) / curvature)
