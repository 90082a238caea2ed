"""The restitution of discs from their tracks, by a likelihood that knows the noise of what was seen.

Each collision of two discs alone is modelled with five unknowns of its own (``collision_model``), which are estimated
with α: errors in variables. The misfit of a collision at a trial α is the least χ² over these five.

The loss of α is the sum of −2 ln(exp(−χ²/2) + exp(−c/2)) over the collisions: what fits worse than c is no collision of
these two discs alone, and counts as a constant. The least loss gives α, by Gauss-Newton steps with the derivative of
the misfit by α at the five unknowns. The interval is that of the profile likelihood: all α with a loss of at most 3.84
above the least.

The collisions are found twice: flights of the second search end where the first has found another collision, which
straight lines alone would not show in positions with noise. In between, the error of the diameters is estimated.

Masses cancel, and so does everything that happens elsewhere. So discs may be missing, and the cell need not be seen.

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
    lasting,
    measured_noise,
    relative_step,
    weighed,
)
from jaxgran.inference.selection import FEWEST, largest_misfit, of_two_discs, struck_windows, without_repeats
from jaxgran.io.tracks import Tracks
from jaxgran.model.checks import InputError, require_number, require_untraced, short_repr

TRIALS = (0.1, 0.3, 0.5, 0.7, 0.9)  # restitutions, the best of which starts the iteration
DIAMETER_NOISE = 0.01  # of a diameter, with which the search for collisions begins
LEAST_NOISE = 1e-5  # of positions and velocities, in the units of the fit; rounding and time steps make as much
LONGEST_STEP = 0.5  # diameters by which neighbours move apart between frames; at more, a disc meets several others
_BETTER_TRACKS = "take more frames in the same time, or give the noise if it is known."
_LARGEST_MISFIT = 9.0  # above it, the noise that was measured or given is a third of what it would have to be
_LASTING = (0.22, 0.4)  # share of lasting changes without and with velocities; hard discs in clusters have half of it
_LARGEST_STEP = 0.2  # of α in one Gauss-Newton step
_MOST_STEPS = 50
_CHOOSING = 10  # steps, after which the collisions that are used stay the same
_SETTLED = 1e-3  # step in standard errors, at which the iteration ends
_LEVEL = chdtri(1, 0.05)  # the value of χ² that a share of 0.05 exceeds


@dataclass(frozen=True)
class RestitutionFit:
    """The restitution inferred from tracks.

    ==============  ====  =======================================================================================
    field           unit  meaning
    ==============  ====  =======================================================================================
    restitution     –     α
    stderr          –     standard error of α
    low, high       –     ends of the 95 % interval of the profile likelihood
    collisions      –     number of collisions of two discs that were used
    rejected        –     number of changes of velocity between near discs that are no such collision, within the
                          noise: a third disc took part, or an id changed
    position_noise  ℓ     standard deviation of a component of a position
    velocity_noise  ℓ/t   standard deviation of a component of a velocity; NaN without velocities
    diameter_noise  ℓ     standard error of the distance at contact
    misfit          –     median χ² of the collisions over that expected; above 1, the errors were enlarged by its root
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


def fit_restitution(
    tracks: Tracks,
    *,
    position_noise: float | None = None,
    velocity_noise: float | None = None,
    diameter_noise: float | None = None,
) -> RestitutionFit:
    """The restitution with which the discs of tracks collide, by their binary collisions.

    Args:
      tracks: as ``read_tracks`` and ``tracks_of_states`` return. Between two frames a disc should collide at most once,
        on average, and move by a fraction of its diameter. Without velocities, a disc should be seen in three frames
        or more between two collisions.
      position_noise: standard deviation of a component of a position, in the unit of the tracks; None to estimate it.
      velocity_noise: the same of a velocity.
      diameter_noise: standard error of the distance at contact, which two diameters share; None to estimate it.

    Returns:
      The restitution with its standard error and its 95 % interval. A warning says where the interval may not hold:
      more changes of velocity were left out than used.

    Raises:
      InputError: (a ValueError) too few collisions can be told from the noise, they are outside of it, or contacts
        outlast the time between frames; the message says what would help.
      RuntimeError: the restitution does not settle.
    """
    if not isinstance(tracks, Tracks):
        raise InputError(
            f"tracks must be Tracks, as read_tracks and tracks_of_states return, not {short_repr(tracks)}."
        )
    words = "it iterates in Python, so call it for each trajectory"
    require_untraced("fit_restitution", words, *vars(tracks).values())
    given = {"position_noise": position_noise, "velocity_noise": velocity_noise, "diameter_noise": diameter_noise}
    for name, value in given.items():
        if value is not None:
            require_number(name, value, lambda x: (x >= 0) & np.isfinite(x), "a number of at least 0")
    flights, length, duration = flights_of(tracks)
    in_units = {"position_noise": length, "velocity_noise": length / duration, "diameter_noise": length}
    known = {name: None if value is None else float(value) / in_units[name] for name, value in given.items()}
    position, velocity = measured_noise(flights)
    noise = Noise(
        max(position if known["position_noise"] is None else known["position_noise"], LEAST_NOISE),
        max(velocity if known["velocity_noise"] is None else known["velocity_noise"], LEAST_NOISE),
        max(DIAMETER_NOISE if known["diameter_noise"] is None else known["diameter_noise"], LEAST_NOISE),
    )
    step = relative_step(flights)
    if np.isnan(step):
        raise InputError("tracks must show two discs or more in two frames that follow each other, and they do not.")
    if not step <= LONGEST_STEP:
        raise InputError(
            f"tracks must show discs that move by {LONGEST_STEP} diameters at most between frames, and neighbours "
            f"move apart by {step:.2g}: take more frames in the same time."
        )
    share = lasting(flights, noise)
    if share > _LASTING[int(np.isfinite(noise.velocity))]:
        every = 1 + int(np.ceil(share / (1 - share))) if share < 1 else 10
        raise InputError(
            "tracks must show contacts that are shorter than the time between frames, and "
            f"{100 * share:.0f} % of the changes of velocity go on in the next frame: leave frames out, by "
            f"every={every} of read_tracks or --stride {every}."
        )
    flights = weighed(flights, noise)
    with jax.enable_x64(True):
        best = _found(flights, noise, None)
        if diameter_noise is None:
            noise = noise._replace(diameter=_diameter_noise(best, noise.diameter))
        struck = struck_windows(best.collisions, best.fitted, best.used, *flights.positions.shape[:2])
        best = _found(flights, noise, struck)
        if best.misfit > _LARGEST_MISFIT:
            raise InputError(
                "tracks must show collisions within their noise, and misfit it by a factor of "
                f"{best.misfit:.2g}: {_BETTER_TRACKS}"
            )
        low, high = _interval(best)
    fit = RestitutionFit(
        restitution=best.restitution,
        stderr=best.stderr,
        low=low,
        high=high,
        collisions=int(best.used.sum()),
        rejected=best.rejected,
        position_noise=noise.position * length,
        velocity_noise=noise.velocity * length / duration if np.isfinite(noise.velocity) else np.nan,
        diameter_noise=noise.diameter * length,
        misfit=best.misfit,
    )
    if words := caution(fit):
        warnings.warn(words, stacklevel=2)
    return fit


def caution(fit: RestitutionFit) -> str | None:
    """What to know of an interval that may not hold; None where nothing speaks against it."""
    if fit.rejected < fit.collisions:
        return None
    return (
        f"the interval may not hold, as {fit.rejected} changes of velocity were left out and {fit.collisions} used: "
        "discs collide in clusters, or not all alike. Take more frames in the same time, or give a larger noise."
    )


class _Best(NamedTuple):
    collisions: Collisions
    fitted: Fitted
    used: np.ndarray
    restitution: float
    stderr: float
    misfit: float
    rejected: int


def _found(flights: Flights, noise: Noise, struck: np.ndarray | None) -> _Best:
    """The collisions in flights and their restitution; an InputError where they are too few."""
    seen = candidates(flights, noise, struck)
    if seen is None:
        raise InputError(_nothing(0, 0))
    best = _settled(Collisions(seen, noise))
    if best.used.sum() < FEWEST:
        raise InputError(_nothing(int(best.used.sum()), len(seen.window)))
    return best


def _diameter_noise(best: _Best, assumed: float) -> float:
    """The error of the distance at contact, by the median of what it differs by, over what noise alone explains."""
    gap, variance = best.fitted.gap[best.used], best.fitted.gap_variance[best.used]
    told = variance < 0.9 * assumed**2  # by more than the assumption
    if told.sum() < FEWEST:
        return assumed
    variance = 1 / (1 / variance[told] - 1 / assumed**2)
    free = gap[told] * (1 + variance / assumed**2)

    def excess(error: float) -> float:
        return float(np.median(free**2 / (error**2 + variance)) - chdtri(1, 0.5))

    if excess(LEAST_NOISE) <= 0:
        return LEAST_NOISE
    if excess(1.0) >= 0:
        return assumed
    found: Any = brentq(excess, LEAST_NOISE, 1.0)
    return float(found)


def _nothing(collisions: int, changes: int) -> str:
    """What would help where too few collisions are found."""
    found = f"tracks must show {FEWEST} or more collisions of two discs, and {collisions} can be told from noise"
    if changes > 10 * FEWEST:
        return f"{found} among {changes} changes of velocity: take more frames in the same time, or a looser flow."
    return f"{found}: take more frames or follow more discs, with less noise if there is much."


def _settled(collisions: Collisions) -> _Best:
    """The restitution of the least loss, by Gauss-Newton steps.

    Errors begin as large as the misfit of the best trial says, and shrink with it, at most to the noise.
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
        if k >= _CHOOSING and step * last < 0:  # the misfit bends more than its linear part says
            damping /= 2
        last = damping * step
        now, error = float(np.clip(alpha + last, 0, 1)), float(np.sqrt(scale / information))
        alpha, moved = now, abs(now - alpha)
        if moved <= _SETTLED * error and k > 1:
            rejected = int(without_repeats(collisions, fitted, alone).sum() - used.sum())
            return _Best(collisions, fitted, used, alpha, error, scale, max(rejected, 0))
    raise RuntimeError(f"the restitution did not settle, and was {alpha:.3g} last: {_BETTER_TRACKS}")


def _interval(best: _Best) -> tuple[float, float]:
    """Where the loss is 3.84 above its least, within [0, 1]."""
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
