"""The restitution of discs from their tracks, by maximum likelihood with noise in all observations.

Each binary collision has five unknowns of its own (``collision_model``), estimated together with α: errors in
variables. Its misfit at a trial α is the minimum of χ² over these five.

The loss is the sum of −2 ln(exp(−χ²/2) + exp(−c/2)) over the collisions, so that candidates with χ² above c, which are
not binary collisions, contribute a constant. It is minimised over α by Gauss-Newton steps. The interval is that of the
profile likelihood: all α whose loss is at most 3.84 above the minimum.

The search for collisions is run twice: flights of the second one end at the other collisions of the first, which
straight lines alone would not reveal in noisy positions. In between, the error of the diameters is estimated.

Masses cancel, and only the two discs of a collision matter: discs may be missing, and the cell need not be known.

Sources: W. A. Fuller, Measurement Error Models (1987), chapter 3; S. A. Murphy and A. W. van der Vaart, J. Am. Stat.
Assoc. 95, 449 (2000), on profile likelihood.
"""

import warnings
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import numpy as np
from scipy.optimize import brentq
from scipy.special import chdtri

from jaxgran.inference.collision_model import Collisions, Fitted
from jaxgran.inference.collisions import (
    Flights,
    Noise,
    candidates,
    flights_of,
    lasting_share,
    measured_noise,
    relative_step,
    with_masses,
)
from jaxgran.inference.selection import FEWEST, largest_misfit, of_two_discs, struck_windows, without_repeats
from jaxgran.io.tracks import Tracks
from jaxgran.model.batches import equal_values
from jaxgran.model.checks import InputError, require_number, require_untraced, short_repr

TRIALS = (0.1, 0.3, 0.5, 0.7, 0.9)  # starting restitutions, of which the best is used
DIAMETER_NOISE = 0.01  # initial guess, in diameters
LEAST_NOISE = 1e-5  # of positions and velocities, in the units of the fit; the size of rounding and time-step errors
LONGEST_STEP = 0.5  # relative displacement of neighbours between frames, in diameters; beyond it, collisions overlap
_BETTER_TRACKS = "take more frames in the same time, or give the noise if it is known."
_LARGEST_MISFIT = 9.0  # of χ² over that expected: the noise is then three times that assumed
_LASTING = (0.22, 0.4)  # largest share of lasting changes, without and with velocities; twice that of hard discs
_LARGEST_STEP = 0.2  # of α in one Gauss-Newton step
_MOST_STEPS = 50
_CHOOSING = 10  # steps after which the set of used collisions is fixed
_CONVERGED = 1e-3  # step, in standard errors, at which the iteration ends
_LEVEL = chdtri(1, 0.05)  # 95 % quantile of χ² with one degree of freedom


@dataclass(frozen=True)
class RestitutionFit:
    """A restitution inferred from tracks.

    ==============  ====  =======================================================================================
    field           unit  meaning
    ==============  ====  =======================================================================================
    restitution     –     α
    stderr          –     standard error of α
    low, high       –     ends of the 95 % interval of the profile likelihood
    collisions      –     number of binary collisions used
    rejected        –     number of velocity changes of nearby discs that are not binary collisions within the
                          noise: a third disc took part, or an id changed
    position_noise  ℓ     standard deviation of a component of a position
    velocity_noise  ℓ/t   standard deviation of a component of a velocity; NaN without velocities
    diameter_noise  ℓ     standard error of the contact distance
    misfit          –     median χ² over that expected; above 1, errors are scaled by its square root
    ==============  ====  =======================================================================================
    """

    restitution: float
    stderr: float
    low: float
    high: float
    collisions: int
    rejected: int
    position_noise: float
    velocity_noise: float
    diameter_noise: float
    misfit: float

    __eq__ = equal_values


def fit_restitution(
    tracks: Tracks,
    *,
    position_noise: float | None = None,
    velocity_noise: float | None = None,
    diameter_noise: float | None = None,
) -> RestitutionFit:
    """Infer the restitution of tracked discs from their binary collisions.

    Args:
      tracks: from ``read_tracks`` or ``tracks_of_states``. Between two frames a disc should move by a fraction of its
        diameter and collide once at most, on average. Without velocities, it should be present in three or more
        frames between collisions.
      position_noise: standard deviation of a component of a position, in the unit of the tracks; None to estimate it.
      velocity_noise: the same for a velocity.
      diameter_noise: standard error of the contact distance, the mean of two diameters; None to estimate it.

    Returns:
      The restitution with its standard error and 95 % interval. A warning is issued if more velocity changes were
      rejected than used, so that the interval may under-cover.

    Raises:
      InputError: (a ValueError) too few collisions stand out from the noise, they misfit it, or contacts outlast the
        time between frames; the message says what would help.
      RuntimeError: the iteration did not converge.
    """
    if not isinstance(tracks, Tracks):
        raise InputError(f"tracks must come from read_tracks or tracks_of_states, not {short_repr(tracks)}.")
    require_untraced("fit_restitution", "it iterates in Python, so call it for each trajectory", *vars(tracks).values())
    given = {"position_noise": position_noise, "velocity_noise": velocity_noise, "diameter_noise": diameter_noise}
    for name, value in given.items():
        if value is not None:
            require_number(name, value, lambda x: (x >= 0) & np.isfinite(x), "a number of at least 0")
    flights, length, duration = flights_of(tracks)
    units = np.array([length, length / duration, length])
    assumed = (*measured_noise(flights), DIAMETER_NOISE)
    pairs = zip(given.values(), units.tolist(), assumed, strict=True)
    noise = Noise(*(max(default if x is None else float(x) / unit, LEAST_NOISE) for x, unit, default in pairs))
    _require_resolved(flights, noise)
    flights = with_masses(flights, noise)
    with jax.enable_x64(True):
        best = _best(flights, noise, None)
        if diameter_noise is None:
            noise = noise._replace(diameter=_diameter_noise(best, noise.diameter))
        struck = struck_windows(best.collisions, best.fitted, best.used, *flights.positions.shape[:2])
        best = _best(flights, noise, struck)
        if best.misfit > _LARGEST_MISFIT:
            raise InputError(
                "tracks must show collisions within their noise, and these misfit it by a factor of "
                f"{best.misfit:.2g}: {_BETTER_TRACKS}"
            )
        low, high = _interval(best)
    position, velocity, diameter = (np.array(noise) * units).tolist()
    fit = RestitutionFit(
        restitution=best.restitution,
        stderr=best.stderr,
        low=low,
        high=high,
        collisions=int(best.used.sum()),
        rejected=best.rejected,
        position_noise=position,
        velocity_noise=velocity if np.isfinite(velocity) else np.nan,
        diameter_noise=diameter,
        misfit=best.misfit,
    )
    if message := caution(fit):
        warnings.warn(message, stacklevel=2)
    return fit


def _require_resolved(flights: Flights, noise: Noise) -> None:
    """Raise an InputError unless frames are close enough in time, but not closer than contacts are short."""
    step = relative_step(flights)
    if np.isnan(step):
        raise InputError("tracks must show two discs or more in two successive frames, and they do not.")
    if not step <= LONGEST_STEP:
        raise InputError(
            f"tracks must show discs that move by {LONGEST_STEP} diameters at most between frames, and neighbours "
            f"move apart by {step:.2g}: take more frames in the same time."
        )
    share = lasting_share(flights, noise)
    if share > _LASTING[int(np.isfinite(noise.velocity))]:
        stride = 1 + int(np.ceil(share / (1 - share))) if share < 1 else 10
        raise InputError(
            "tracks must show contacts that are shorter than the time between frames, and "
            f"{100 * share:.0f} % of the velocity changes continue in the next frame: read with stride={stride}."
        )


def caution(fit: RestitutionFit) -> str | None:
    """Warning if the interval may under-cover, else None."""
    if fit.rejected < fit.collisions:
        return None
    return (
        f"the interval may be too narrow, as {fit.rejected} velocity changes were rejected and {fit.collisions} used: "
        "discs collide in clusters, or restitutions differ. Take more frames in the same time, or give a larger noise."
    )


class _Best(NamedTuple):
    collisions: Collisions
    fitted: Fitted
    used: np.ndarray
    restitution: float
    stderr: float
    misfit: float
    rejected: int


def _best(flights: Flights, noise: Noise, struck: np.ndarray | None) -> _Best:
    """The collisions in flights and their restitution; an InputError if they are too few."""
    pairs = candidates(flights, noise, struck)
    if pairs is None:
        raise InputError(_too_few(0, 0))
    best = _minimised(Collisions(pairs, noise))
    if best.used.sum() < FEWEST:
        raise InputError(_too_few(int(best.used.sum()), len(pairs.window)))
    return best


def _diameter_noise(best: _Best, assumed: float) -> float:
    """The error of the contact distance, from the median of its deviations beyond those explained by noise."""
    gap, variance = best.fitted.gap[best.used], best.fitted.gap_variance[best.used]
    informative = variance < 0.9 * assumed**2  # observed better than assumed
    if informative.sum() < FEWEST:
        return assumed
    variance = 1 / (1 / variance[informative] - 1 / assumed**2)
    free = gap[informative] * (1 + variance / assumed**2)

    def excess(error: float) -> float:
        return float(np.median(free**2 / (error**2 + variance)) - chdtri(1, 0.5))

    if excess(LEAST_NOISE) <= 0:
        return LEAST_NOISE
    if excess(1.0) >= 0:
        return assumed
    root: Any = brentq(excess, LEAST_NOISE, 1.0)
    return float(root)


def _too_few(collisions: int, changes: int) -> str:
    """Error message for too few collisions."""
    problem = f"tracks must show {FEWEST} or more binary collisions, and {collisions} stand out from the noise"
    if changes > 10 * FEWEST:
        return f"{problem} among {changes} velocity changes: take more frames in the same time, or a looser flow."
    return f"{problem}: take more frames, follow more discs, or reduce the noise."


def _minimised(collisions: Collisions) -> _Best:
    """The restitution that minimises the loss, by Gauss-Newton steps.

    The noise is scaled up by the misfit of the best trial at first, and less as the misfit falls.
    """
    cut, middle = largest_misfit(collisions), chdtri(collisions.freedom, 0.5)
    trials = [(alpha, collisions.fitted(alpha)) for alpha in TRIALS]

    def loss(fitted: Fitted) -> float:
        return float(np.sum(np.log1p(fitted.misfit / cut)[of_two_discs(collisions, fitted)]))

    alpha, fitted = min(trials, key=lambda trial: loss(trial[1]))
    alone, scale = of_two_discs(collisions, fitted), 1.0
    used = without_repeats(collisions, fitted, alone)
    last, damping = 0.0, 1.0
    for k in range(_MOST_STEPS):
        fitted = collisions.fitted(alpha, fitted.unknowns)
        if k < _CHOOSING:
            scale = max(1.0, float(np.median((fitted.misfit / middle)[used]))) if used.any() else 1.0
            alone = of_two_discs(collisions, fitted)
            used = without_repeats(collisions, fitted, alone & (fitted.misfit < scale * cut))
        weights = np.where(used, 1 / (1 + np.exp(np.clip((fitted.misfit / scale - cut) / 2, -50, 50))), 0)
        information = np.sum(weights * fitted.curvature)
        if used.sum() < FEWEST or not information > 0:
            return _Best(collisions, fitted, used, alpha, np.inf, scale, 0)
        step = float(np.clip(-np.sum(weights * fitted.gradient) / information, -_LARGEST_STEP, _LARGEST_STEP))
        if k >= _CHOOSING and step * last < 0:  # damp an oscillation
            damping /= 2
        last = damping * step
        now, error = float(np.clip(alpha + last, 0, 1)), float(np.sqrt(scale / information))
        alpha, moved = now, abs(now - alpha)
        if moved <= _CONVERGED * error and k > 1:
            rejected = int(without_repeats(collisions, fitted, alone).sum() - used.sum())
            return _Best(collisions, fitted, used, alpha, error, scale, max(rejected, 0))
    raise RuntimeError(f"the restitution did not converge, and was {alpha:.3g} last: {_BETTER_TRACKS}")


def _interval(best: _Best) -> tuple[float, float]:
    """Where the loss is 3.84 above its minimum, within [0, 1]."""
    part = best.collisions.part(best.used)
    cut = largest_misfit(part)
    unknowns = best.fitted.unknowns[best.used]

    def loss(alpha: float) -> float:
        misfit = part.fitted(alpha, unknowns).misfit / best.misfit
        return -2 * float(np.sum(np.logaddexp(-misfit / 2, -cut / 2)))

    least = loss(best.restitution)

    def end(sign: int) -> float:
        far = best.restitution
        for _ in range(12):
            near, far = far, float(np.clip(far + sign * 2.5 * best.stderr, 0, 1))
            if loss(far) - least > _LEVEL:
                crossing: Any = brentq(lambda alpha: loss(alpha) - least - _LEVEL, near, far, xtol=1e-3 * best.stderr)
                return float(crossing)
            if far in (0.0, 1.0):
                return far
        return far

    return end(-1), end(1)
