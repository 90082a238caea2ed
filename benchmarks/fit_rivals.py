"""Other ways to find the restitution of tracked discs. All are told the noise, which the fit of jaxgran is not.

``by_hand``: two near discs whose velocities change between two frames, and whose momentum does not; the normal where
straight lines bring them into touch; −u'ₙ/uₙ of each collision, and their mean with weights.

``of_simulations``: frames start runs of the event-driven program, which also made the data, so its model has no error;
the restitution with which the next frames fit best, without derivatives.

``Regression``: numbers that describe a flow, of the tracks and of many simulations. The mean of α at given numbers is
a regression over all simulations, and then over those that are nearest to the tracks.

Sources: M. A. Beaumont, W. Zhang and D. J. Balding, Genetics 162, 2025 (2002), on regression within the nearest
simulations; P. Fearnhead and D. Prangle, J. R. Stat. Soc. B 74, 419 (2012), on a first regression that tells which
these are.
"""

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize, minimize_scalar

import jaxgran as jg
from benchmarks.event_driven import Discs, Law, sheared
from jaxgran.io.tracks import displacements, nearest_image

CHANGE = 5.0  # of a velocity between frames that is taken for a collision, over its noise
MOMENTUM = 3.5  # by which that of a pair may change, over its noise
CLEAR = 5.0  # normal velocity before a collision, over its noise
NEAR = 0.3  # σ, gap between discs that may have met within a frame
GAPS = (-np.inf, 0.02, 0.05, 0.1, 0.2, 0.4)  # σ, between which pairs are counted
TAIL = 2.0  # degrees of freedom of the residuals of a simulation, so that what chaos leads astray weighs little
RIDGES = 10.0 ** np.arange(-2.0, 5.0)
NEAREST = 0.2  # share of the simulations in the last regression


class Noise(NamedTuple):
    """Standard deviations of a component of a velocity and of a position."""

    velocity: float
    position: float


class Seen(NamedTuple):
    """Tracks as these methods need them, with all pairs i < j.

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


def seen_of(tracks: jg.Tracks) -> Seen:
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
    return Seen(tracks, velocities, peculiar, i, j, apart, slide, gaps)


def by_hand(seen: Seen, noise: Noise, averaged: int = 3) -> float:
    """The restitution by single collisions; NaN where there are none.

    Args:
      averaged: most frames before and after, of whose velocities a mean is taken, none of them past a collision.
    """
    v, masses, frames = seen.velocities, seen.tracks.masses, len(seen.velocities)
    changed = np.linalg.norm(np.diff(v, axis=0), axis=-1) > CHANGE * np.sqrt(2) * noise.velocity
    lost = weight = 0.0
    near = (np.minimum(seen.gaps[:-1], seen.gaps[1:]) < NEAR) & changed[:, seen.first] & changed[:, seen.second]
    for k, pair in zip(*np.nonzero(near), strict=True):
        i, j = seen.first[pair], seen.second[pair]
        of_pair = changed[:, i] | changed[:, j]
        before = min(averaged, next((n for n in range(1, k + 1) if of_pair[k - n]), k + 1))
        after = min(averaged, next((n for n in range(1, frames - 1 - k) if of_pair[k + n]), frames - 1 - k))
        first, second = v[k + 1 - before : k + 1].mean(axis=0), v[k + 1 : k + 1 + after].mean(axis=0)
        gained = masses[i] * (second[i] - first[i]) + masses[j] * (second[j] - first[j])
        spread = noise.velocity * np.sqrt((masses[i] ** 2 + masses[j] ** 2) * (1 / before + 1 / after))
        if np.linalg.norm(gained) > MOMENTUM * spread:
            continue
        image, apart = np.array([seen.slide[k, pair], 0.0]), seen.separations[k, pair]
        u, w = first[i] - first[j] - image, second[i] - second[j] - image
        touch = np.linalg.norm(apart) - seen.gaps[k, pair]
        contact = apart + u * min(_until(apart, u, touch), seen.tracks.time[k + 1] - seen.tracks.time[k])
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


def of_simulations(
    seen: Seen, noise: Noise, contact_duration: float, window: int, every: int = 1, scales: bool = False
) -> tuple[float, int]:
    """The restitution whose simulations fit best, and how many values were tried.

    Args:
      window: frames of each simulation, past the one that starts it.
      every: frames from one start to the next.
      scales: whether two factors of the noise are unknown too (Nelder–Mead over three unknowns); else Brent over α.
    """
    tracks, tried = seen.tracks, 0
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
                *fixed, tracks.positions[k].copy(), seen.peculiar[k].copy(), never.copy(), side, offset / side
            )
            for m in range(1, min(window, frames - 1 - k) + 1):
                discs, _ = sheared(discs, law, interval)
                moved = nearest_image(discs.positions - tracks.positions[k + m], tracks.cell[k + m])
                # The start has the noise too, and carries that of its velocity into the position
                errors = noise.position * np.sqrt(2) + m * interval * noise.velocity, noise.velocity * np.sqrt(2)
                found.append(np.stack([moved / errors[0], (discs.velocities - seen.peculiar[k + m]) / errors[1]]))
        return np.array(found)

    def loss(alpha: float, of_positions: float = 0.0, of_velocities: float = 0.0) -> float:
        nonlocal tried
        tried += 1
        if not 0 <= alpha <= 1:
            return np.inf
        logs = np.array([of_positions, of_velocities])
        scaled = residuals(alpha) * np.exp(-logs)[:, None, None]
        # Student's t in two dimensions
        return float(np.mean((TAIL / 2 + 1) * np.log1p(np.sum(scaled**2, axis=-1) / TAIL)) + np.sum(logs))

    if scales:
        start = np.array([[0.5, 0, 0], [0.8, 0, 0], [0.5, 0.3, 0], [0.5, 0, 0.3]])
        options = {"initial_simplex": start, "xatol": 1e-4, "fatol": 1e-6, "maxiter": 60}
        return float(minimize(lambda x: loss(*x), start[0], method="Nelder-Mead", options=options).x[0]), tried
    return float(minimize_scalar(loss, bounds=(0.0, 1.0), method="bounded", options={"xatol": 1e-5}).x), tried


def sums_of(seen: Seen, noise: Noise) -> np.ndarray:
    """Sums over the discs and the pairs of each frame, (frames, sums), of which ``statistics`` makes its numbers."""
    mass, c = seen.tracks.masses, seen.peculiar
    energies = mass * np.sum(c**2, axis=-1)
    change = np.diff(seen.velocities, axis=0, prepend=seen.velocities[:1])
    size = np.linalg.norm(change, axis=-1)
    struck = size > CHANGE * np.sqrt(2) * noise.velocity
    of_discs = [energies, mass * c[..., 0] ** 2, mass * c[..., 0] * c[..., 1], energies**2]
    of_discs += [struck, struck * size, struck * mass * size**2]
    sums = [x.sum(axis=1) for x in of_discs]

    frame, pair = np.nonzero(seen.gaps < GAPS[-1])
    i, j, apart, gap = seen.first[pair], seen.second[pair], seen.separations[frame, pair], seen.gaps[frame, pair]
    u = seen.velocities[frame, i] - seen.velocities[frame, j]
    u[:, 0] -= seen.slide[frame, pair]
    normal = np.sum(u * apart, axis=-1) / np.linalg.norm(apart, axis=-1)

    def added(values: np.ndarray) -> np.ndarray:
        return np.bincount(frame, values, len(c))

    met = struck[frame, i] & struck[frame, j]
    given = (mass[i, None] * change[frame, i] - mass[j, None] * change[frame, j]) / 2 * met[:, None]
    sums += [added(np.sum(given * apart, axis=-1)), added(given[:, 0] * apart[:, 1])]
    reduced, turned = mass[i] * mass[j] / (mass[i] + mass[j]), change[frame, i] - change[frame, j]
    sums += [added(met * reduced * (np.sum(u**2, axis=-1) - np.sum((u - turned) ** 2, axis=-1)))]
    for least, most in pairwise(GAPS):
        inside = (gap >= least) & (gap < most)
        for side in (inside & (normal < 0), inside & (normal > 0)):
            sums += [added(side), added(side * np.abs(normal)), added(side * normal**2)]
    return np.stack(sums, axis=-1)


def statistics(sums: np.ndarray) -> np.ndarray:
    """What describes a flow, of the mean of its sums over the frames, (..., sums).

    Granular temperature, anisotropy, kinetic shear stress, kurtosis; collisions, changes of velocity and their squares,
    contact pressure, shear stress and dissipation, each without the unit of time; and in shells of the gap between
    discs, how many approach and recede, how fast, and the ratios of both. As many recede as approach in a time, so near
    contact the sums of squared normal velocities have the ratio α, but for the noise.
    """
    small = 1e-9
    energy, along, across, fourth, struck, jumps, squares, pressure, shear, dissipated = np.moveaxis(
        sums[..., :10], -1, 0
    )
    speed = np.sqrt(energy + small)
    parts = [np.log(energy + small), along / energy, across / energy, fourth / energy**2, struck, jumps / speed]
    parts += [squares / energy, pressure / speed, shear / speed, dissipated / energy]
    shells = sums[..., 10:].reshape(*sums.shape[:-1], len(GAPS) - 1, 2, 3)
    for k in range(len(GAPS) - 1):
        (n, u, uu), (m, w, ww) = (np.moveaxis(shells[..., k, side, :], -1, 0) for side in (0, 1))
        parts += [n, m / (n + 0.1), u / speed, (w + small) / (u + w + small), (ww + small) / (uu + ww + small)]
    return np.stack(parts, axis=-1)


class Regression:
    """The mean of α at given statistics, by simulations with a restitution of each."""

    def __init__(self, restitutions: np.ndarray, found: np.ndarray):
        self.middle, self.spread = found.mean(axis=0), found.std(axis=0) + 1e-12
        self.restitutions, self.found = restitutions, self._scaled(found)
        self.weights = _ridge(_quadratic(self.found), restitutions)
        self.first = _quadratic(self.found) @ self.weights

    def restitution(self, found: np.ndarray) -> float:
        """α of tracks, by a regression over the simulations to which the first one gives about the same value."""
        x = self._scaled(found[None])
        away = np.abs(self.first - (_quadratic(x) @ self.weights)[0])
        nearest = np.argsort(away)[: int(NEAREST * len(away))]
        near = np.column_stack([np.ones(len(nearest)), self.first[nearest], self.found[nearest]])
        here = np.concatenate([[1.0], _quadratic(x) @ self.weights, x[0]])
        return float(np.clip(here @ _ridge(near, self.restitutions[nearest]), 0, 1))

    def _scaled(self, found: np.ndarray) -> np.ndarray:
        return np.clip((found - self.middle) / self.spread, -4, 4)


def _quadratic(x: np.ndarray) -> np.ndarray:
    i, j = np.triu_indices(x.shape[1])
    return np.column_stack([np.ones(len(x)), x, x[:, i] * x[:, j]])


def _ridge(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Weights of a ridge regression, whose penalty has the least error on what is left out (generalised)."""
    shift = y.mean()
    left, values, right = np.linalg.svd(x, full_matrices=False)
    projected, best = left.T @ (y - shift), (np.inf, None)
    for ridge in RIDGES:
        shrunk = values**2 / (values**2 + ridge)
        rest = (y - shift) - left @ (shrunk * projected)
        score = np.sum(rest**2) / (len(y) - np.sum(shrunk)) ** 2
        if score < best[0]:
            best = score, right.T @ (shrunk / np.maximum(values, 1e-12) * projected)
    weights = best[1]
    weights[0] += shift
    return weights
