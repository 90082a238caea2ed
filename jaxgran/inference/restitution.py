"""The restitution of grains from their observed motion.

A trajectory is cut into windows, each from one frame to the next. Every window is run from its first frame at a trial
restitution α, and its end is compared with the next frame. The residuals are the differences of the velocities. A
window has few collisions, so the residuals are nearly linear in α. Their derivatives are computed with the run (forward
mode, with contacts that move in time).

α follows from Gauss-Newton steps with Cauchy weights. The initial velocities are noisy, so a grain may collide in the
run but not in the observation. Such a grain has a small weight. The noise is estimated from the grains that do not
collide, which are the majority in a short window.

The standard error is that of the sum over windows, from the scatter of their contributions (the "sandwich" estimate).
It is therefore valid for any distribution of the residuals.

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
from jaxgran.model.checks import InputError, require_number, require_untraced, shown
from jaxgran.model.choices import MAX_STEPS
from jaxgran.model.flow import ShearFlow
from jaxgran.model.state import State
from jaxgran.model.status import Status

TRIALS = (0.1, 0.3, 0.5, 0.7, 0.9)  # restitutions, the best of which starts the iteration
_STRIDE = 0.003  # σ that a grain moves in a time step of the runs, at the root mean square velocity
_FEWEST_STEPS = 10  # time steps of a window
_LARGEST_STEP = 0.2  # of α in one Gauss-Newton step
_LEAST_STEP = 1e-9  # of α, at which the iteration ends in any case
_MOST_STEPS = 50  # Gauss-Newton steps
_SETTLED = 1e-2  # step in standard errors, at which the iteration ends
_CAUCHY = 2.385  # width of Cauchy's law over the noise: 95 % as efficient as least squares for Gaussian noise
_LEAST_NOISE = 1e-4  # over the root mean square velocity: an exact trajectory has no noise
_TOLERANCE = 1e-9  # of the contact solve


@dataclass(frozen=True)
class RestitutionFit:
    """The restitution inferred from a trajectory.

    ===========  ====  ==================================================================================
    field        unit  meaning
    ===========  ====  ==================================================================================
    restitution  –     α
    stderr       –     standard error of α
    noise        σγ̇    standard deviation of the noise of a component of an observed velocity
    windows      –     number of pairs of successive frames that were compared
    collisions   –     number of collisions in the runs of these windows
    outliers     –     share of the components of velocity with a residual above 7 times its noise, as after
                       a collision that is only in the run or only in the observation
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
    """The restitution with which the observed grains collide, for a simulation with any time step or an experiment.

    Args:
      strain: (frames,), strain of each frame, increasing. Between two frames a grain should collide at most once, on
        average.
      states: the frames, with a leading (frames,) axis. Positions should be accurate to a few 1e-3 σ. The noise of the
        velocities may be several per cent.
      shear_rate: γ̇ of the observation, in the time unit of its velocities.
      timestep: dt of the runs, in the same time unit, or None for one in which grains move 0.003 diameters.

    Returns:
      The restitution with its standard error.

    Raises:
      ValueError: the frames are fewer than two, out of order or not finite, or no grains collide between them.
      RuntimeError: the runs fail, or the restitution does not settle.
    """
    strain, count = _checked(strain, states, shear_rate)
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
        residuals, slopes, collisions, status = _residuals(flow, *windows, jnp.asarray(alpha, float))
        worst = Status(int(np.max(status)))
        if worst > Status.deep_overlap:
            raise RuntimeError(
                f"the runs from the frames ended as {worst.name}; positions and radii must be in one unit."
            )
        return _Comparison(alpha, np.asarray(residuals), np.asarray(slopes), float(np.sum(collisions)))

    current = min((compare(alpha) for alpha in TRIALS), key=lambda trial: trial.loss(least_noise))
    for _ in range(_MOST_STEPS):
        step, error = current.step(least_noise)
        current = compare(float(np.clip(current.restitution + step, 0, 1)))
        if abs(step) <= max(_SETTLED * error, _LEAST_STEP):
            break
    else:
        raise RuntimeError(f"the restitution did not settle: it was last {current.restitution:.3g}.")
    noise = current.noise(least_noise)  # of a residual: the difference of two noisy velocities
    return RestitutionFit(
        restitution=current.restitution,
        stderr=current.step(least_noise)[1],
        noise=noise / np.sqrt(2),
        windows=len(steps),
        collisions=current.collisions,
        outliers=float(np.mean(np.abs(current.residuals) > 3 * _CAUCHY * noise)),
    )


def _checked(strain: Any, states: Any, shear_rate: float) -> tuple[np.ndarray, int]:
    """The strains as an array and the number of grains; an InputError where the trajectory cannot be fitted."""
    require_untraced(
        "fit_restitution", "it iterates in Python, so call it for each trajectory", strain, states, shear_rate
    )
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
def _residuals(flow: ShearFlow, starts: State, ends: State, timesteps: Array, steps: Int[Array, " windows"], alpha):
    """Residuals of the velocities at the end of each window and their derivatives by α, collisions and status.

    Residuals and derivatives are (windows, grains, 2); collisions and status are (windows,).
    """

    def window(given):
        start, end, timestep, count = given

        def run(alpha):
            trial = replace(flow, restitution=alpha, timestep=timestep)
            final, tally = advance(trial, start, count, moving_contacts=True)
            return final.velocities - end.velocities, (tally.collisions, tally.status)

        residual, slope, (collisions, status) = jax.jvp(run, (alpha,), (jnp.ones_like(alpha),), has_aux=True)
        return residual, slope, collisions, status

    return lax.map(window, (starts, ends, timesteps, steps))


class _Comparison(NamedTuple):
    """Runs at one restitution compared with the observation.

    ===========  =====================  ====  ====================================
    restitution  ()                     –     α of the runs
    residuals    (windows, grains, 2)   σγ̇    velocities of the runs less observed
    slopes       (windows, grains, 2)   σγ̇    derivatives of the residuals by α
    collisions   ()                     –     in all windows
    ===========  =====================  ====  ====================================
    """

    restitution: float
    residuals: np.ndarray
    slopes: np.ndarray
    collisions: float

    def noise(self, least: float) -> float:
        """Standard deviation of the residuals without collisions, from their median absolute value."""
        return max(1.4826 * float(np.median(np.abs(self.residuals))), least)

    def loss(self, least_noise: float) -> float:
        """Negative log-likelihood of Cauchy's law with its fitted width; the smallest is the best restitution."""
        noise = self.noise(least_noise)
        return float(np.sum(np.log(noise) + np.log1p((self.residuals / (_CAUCHY * noise)) ** 2)))

    def step(self, least_noise: float) -> tuple[float, float]:
        """Gauss-Newton step of the restitution, and its standard error."""
        weights = 1 / (1 + (self.residuals / (_CAUCHY * self.noise(least_noise))) ** 2)
        curvature = np.sum(weights * self.slopes**2)
        if not curvature > 0:
            raise InputError("states must have collisions between the frames, and no grains collide.")
        gradients = np.sum(weights * self.slopes * self.residuals, axis=(1, 2))  # of the windows
        step = np.clip(-np.sum(gradients) / curvature, -_LARGEST_STEP, _LARGEST_STEP)
        return float(step), float(np.sqrt(np.sum(gradients**2)) / curvature)
