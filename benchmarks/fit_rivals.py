"""Two other ways to find the restitution of tracked discs. Both get the noise, which the fit of jaxgran does not.

``by_hand``: two near discs whose velocities change between two frames, and whose momentum does not; the normal where
straight lines bring them into touch; −u'ₙ/uₙ of each collision, and their weighted mean.

``by_simulations``: frames start runs of the event-driven program, which also made the data, so its model has no error;
the restitution with which the next frames fit best, without derivatives.
"""

from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar

import jaxgran as jg
from benchmarks.event_driven import Discs, Law, sheared
from jaxgran.io.tracks import displacements, nearest_image

CHANGE = 5.0  # of a velocity between frames that is taken for a collision, over its noise
MOMENTUM = 3.5  # by which that of a pair may change, over its noise
CLEAR = 5.0  # normal velocity before a collision, over its noise
NEAR = 0.3  # σ, gap between discs that may have met within a frame
TAIL = 2.0  # degrees of freedom of the residuals of a simulation, so that what chaos leads astray weighs little


class Noise(NamedTuple):
    """Standard deviations of a component of a velocity and of a position."""

    velocity: float
    position: float


class Pairs(NamedTuple):
    """Tracks with the relative motion of all pairs i < j.

    ===========  ===================  ========================================================================
    velocities   (frames, grains, 2)  of the laboratory, without jumps through the sides of the cell
    peculiar     (frames, grains, 2)  less the shear
    first        (pairs,)             the disc i
    second       (pairs,)             the disc j
    separations  (frames, pairs, 2)   of i from the nearest image of j
    slide        (frames, pairs)      along x, by which that image is faster than j
    gaps         (frames, pairs)      distance less that at contact
    ===========  ===================  ========================================================================
    """

    tracks: jg.Tracks
    velocities: np.ndarray
    peculiar: np.ndarray
    first: np.ndarray
    second: np.ndarray
    separations: np.ndarray
    slide: np.ndarray
    gaps: np.ndarray


def pairs_of(tracks: jg.Tracks) -> Pairs:
    """What follows from tracks in which no disc is missing."""
    y, rate = tracks.positions[..., 1], tracks.shear_rate
    heights = y[0] + np.concatenate([0 * y[:1], np.cumsum(displacements(tracks)[..., 1], axis=0)])
    velocities, peculiar = tracks.velocities.copy(), tracks.velocities.copy()
    velocities[..., 0] += rate * (heights - y)
    peculiar[..., 0] -= rate * y
    i, j = np.triu_indices(len(tracks.diameters), 1)
    apart = nearest_image(tracks.positions[:, i] - tracks.positions[:, j], tracks.cell[:, None])
    slide = rate * (heights[:, i] - heights[:, j] - apart[..., 1])
    gaps = np.linalg.norm(apart, axis=-1) - (tracks.diameters[i] + tracks.diameters[j]) / 2
    return Pairs(tracks, velocities, peculiar, i, j, apart, slide, gaps)


def by_hand(pairs: Pairs, noise: Noise, averaged: int = 3) -> float:
    """The restitution by single collisions; NaN where there are none.

    Args:
      averaged: most frames before and after, of whose velocities a mean is taken, none of them past a collision.
    """
    v, masses, frames = pairs.velocities, pairs.tracks.masses, len(pairs.velocities)
    changed = np.linalg.norm(np.diff(v, axis=0), axis=-1) > CHANGE * np.sqrt(2) * noise.velocity
    lost = weight = 0.0
    near = (np.minimum(pairs.gaps[:-1], pairs.gaps[1:]) < NEAR) & changed[:, pairs.first] & changed[:, pairs.second]
    for k, pair in zip(*np.nonzero(near), strict=True):
        i, j = pairs.first[pair], pairs.second[pair]
        of_pair = changed[:, i] | changed[:, j]
        before = min(averaged, next((n for n in range(1, k + 1) if of_pair[k - n]), k + 1))
        after = min(averaged, next((n for n in range(1, frames - 1 - k) if of_pair[k + n]), frames - 1 - k))
        first, second = v[k + 1 - before : k + 1].mean(axis=0), v[k + 1 : k + 1 + after].mean(axis=0)
        gained = masses[i] * (second[i] - first[i]) + masses[j] * (second[j] - first[j])
        spread = noise.velocity * np.sqrt((masses[i] ** 2 + masses[j] ** 2) * (1 / before + 1 / after))
        if np.linalg.norm(gained) > MOMENTUM * spread:
            continue
        image, apart = np.array([pairs.slide[k, pair], 0.0]), pairs.separations[k, pair]
        u, w = first[i] - first[j] - image, second[i] - second[j] - image
        touch = np.linalg.norm(apart) - pairs.gaps[k, pair]
        contact = apart + u * min(_until(apart, u, touch), pairs.tracks.time[k + 1] - pairs.tracks.time[k])
        normal = contact / np.linalg.norm(contact)
        approach, recession = -u @ normal, w @ normal
        error = noise.velocity * np.sqrt(2 / before)
        if approach > CLEAR * error:
            share = 1 / (1 / before + 1 / after)
            lost += share * approach * recession
            weight += share * approach**2
    return lost / weight if weight else np.nan


def _until(apart: np.ndarray, u: np.ndarray, touch: float) -> float:
    """The time until two points are at a distance, or else closest; 0 where they recede."""
    closing, square = -(apart @ u), u @ u
    if closing <= 0:
        return 0.0
    return max(0.0, (closing - np.sqrt(max(0.0, closing**2 - square * (apart @ apart - touch**2)))) / square)


def by_simulations(
    pairs: Pairs, noise: Noise, contact_duration: float, window: int, every: int = 1
) -> tuple[float, int]:
    """The restitution whose simulations fit best, and how many values were tried.

    Args:
      window: frames of each simulation, past the one that starts it.
      every: frames from one start to the next.
    """
    tracks, tried = pairs.tracks, 0
    interval, rate = float(np.diff(tracks.time).mean()), tracks.shear_rate
    never = np.full(len(tracks.diameters), -np.inf)
    frames = len(tracks.time)
    starts = range(0, frames - 1, every)
    fixed = tracks.diameters / 2, tracks.masses

    def residuals(alpha: float) -> np.ndarray:
        law, found = Law(alpha, contact_duration, rate), []
        for k in starts:
            side, _, offset = tracks.cell[k]
            discs = Discs(
                *fixed, tracks.positions[k].copy(), pairs.peculiar[k].copy(), never.copy(), side, offset / side
            )
            for m in range(1, min(window, frames - 1 - k) + 1):
                discs, _ = sheared(discs, law, interval)
                moved = nearest_image(discs.positions - tracks.positions[k + m], tracks.cell[k + m])
                # The start has the noise too, and carries that of its velocity into the position
                errors = noise.position * np.sqrt(2) + m * interval * noise.velocity, noise.velocity * np.sqrt(2)
                found.append(np.stack([moved / errors[0], (discs.velocities - pairs.peculiar[k + m]) / errors[1]]))
        return np.array(found)

    def loss(alpha: float) -> float:
        """Minus the mean log likelihood of residuals of Student's t in two dimensions."""
        nonlocal tried
        tried += 1
        return float(np.mean((TAIL / 2 + 1) * np.log1p(np.sum(residuals(alpha) ** 2, axis=-1) / TAIL)))

    return float(minimize_scalar(loss, bounds=(0.0, 1.0), method="bounded", options={"xatol": 1e-5}).x), tried
