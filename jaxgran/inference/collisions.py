"""Binary collisions in tracks: pairs of discs that fly straight, collide once, and fly straight again.

Between collisions a disc moves on a straight line in the laboratory frame. For each pair of nearby discs and each
window between successive frames that contain both, the flights before and after the window extend as far as straight
lines describe them within the noise. The pair is a candidate if its relative velocity changes in the window by more
than the noise. Its centre of mass must move straight throughout, which excludes collisions with a third disc, observed
or not.

Only this criterion needs masses. Unknown masses are taken as the power of the diameter for which most centres of mass
move straight.

Lengths are in mean diameters, times in units of the time in which a disc moves by one diameter.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree
from scipy.special import chdtri  # χ² of a probability to be exceeded; as in scipy.stats, which loads slowly

from jaxgran.io.tracks import Tracks, displacements, nearest_image

LONGEST = 8  # frames of a flight, besides those of its window
_RARE = 1e-3  # significance level for a bent centre-of-mass flight
_BEND = 0.02  # significance level for the end of a flight
_LEAST_CHANGE = 3.0  # of the relative velocity of a candidate, in standard errors
_POWERS = (2, 3, 0)  # mass as a power of the diameter: discs, spheres, equal masses
_FRAMES_FOR_MASSES = 100
_REACH = 3.0  # relative steps of fast pairs, within which a pair is near
_QUICK = 0.9  # quantile of these steps
_CLEAR_CHANGE = 5.0  # of a velocity from frame to frame, in standard errors
_ALONG = 0.95  # least cosine of the angle between two changes of one contact
_FEWEST_CHANGES = 20  # for a meaningful share
_MOST_PAIRS = 20_000  # near pairs per batch; each takes some kilobytes
_BENT = np.append(np.inf, chdtri(np.arange(1, 8 * (LONGEST + 1) + 1), _BEND))  # χ² of a bend, by degrees of freedom


class Noise(NamedTuple):
    """Standard deviations of a component of an observed position, of a velocity, and of an observed diameter."""

    position: float
    velocity: float
    diameter: float


class Flights(NamedTuple):
    """Unwrapped tracks, in the units of the fit."""

    time: Float[np.ndarray, " frames"]
    positions: Float[np.ndarray, "frames grains 2"]  # on a straight line between collisions; NaN if missing
    velocities: Float[np.ndarray, "frames grains 2"]  # along that line; NaN if unknown
    places: Float[np.ndarray, "frames grains 2"]  # observed positions, in the cell
    cell: Float[np.ndarray, "frames 3"]  # as in ``Tracks``
    shear_rate: float
    diameters: Float[np.ndarray, " grains"]
    masses: Float[np.ndarray, " grains"]  # NaN if unknown


class Candidates(NamedTuple):
    """Pairs that may have collided in a window, with the observations in the frames around it."""

    window: Int[np.ndarray, " pairs"]  # frame before the collision
    grains: Int[np.ndarray, "pairs 2"]  # the discs i and j
    reach: Float[np.ndarray, " pairs"]  # contact distance from the diameters
    time: Float[np.ndarray, "pairs frames"]  # from the start of the window
    separation: Float[np.ndarray, "pairs frames 2"]  # of disc i from the image of disc j
    velocity: Float[np.ndarray, "pairs frames 2"]  # its rate of change; 0 if unknown
    has_velocity: Bool[np.ndarray, "pairs frames"]
    before: Bool[np.ndarray, "pairs frames"]  # whether a frame belongs to the flight before the collision
    after: Bool[np.ndarray, "pairs frames"]
    duration: Float[np.ndarray, " pairs"]  # of the window
    guess: Float[np.ndarray, "pairs 5"]  # separation at contact (2), time of contact, velocity before (2)
    drift: Float[np.ndarray, " pairs"]  # χ² of a straight flight of the centre of mass
    drift_freedom: Float[np.ndarray, " pairs"]  # its degrees of freedom


def flights_of(tracks: Tracks) -> tuple[Flights, float, float]:
    """Unwrapped tracks in the units of the fit, and these units of length and time."""
    length = float(np.mean(tracks.diameters))
    moved = displacements(tracks)
    speeds = np.linalg.norm(moved, axis=-1) / np.diff(tracks.time)[:, None]
    speed = float(np.nanmedian(speeds)) if np.isfinite(speeds).any() else 0.0
    duration = length / speed if speed > 0 else float(np.median(np.diff(tracks.time)))
    positions = _unwrapped(tracks)
    lifted = positions[..., 1] - tracks.positions[..., 1]
    velocities = tracks.velocities.copy()
    velocities[..., 0] += tracks.shear_rate * lifted
    flights = Flights(
        tracks.time / duration,
        positions / length,
        velocities * duration / length,
        tracks.positions / length,
        tracks.cell / length,
        tracks.shear_rate * duration,
        tracks.diameters / length,
        tracks.masses,
    )
    return flights, length, duration


def _unwrapped(tracks: Tracks) -> np.ndarray:
    """Positions that follow each disc through the sides of the cell, even across frames without it.

    A disc that left through the upper side is observed as an image in a row that slides relative to it.
    """
    positions = tracks.positions.copy()
    place, follows = positions[0].copy(), positions[0].copy()
    last = np.full(len(tracks.diameters), tracks.time[0])
    for k in range(1, len(positions)):
        now = tracks.positions[k]
        step = nearest_image(now - place, tracks.cell[k])
        step[:, 0] += tracks.shear_rate * (follows - place)[:, 1] * (tracks.time[k] - last)
        follows_now = np.where(np.isfinite(place), follows + step, now)
        present = np.isfinite(now)
        positions[k] = np.where(present, follows_now, np.nan)
        place, follows = np.where(present, now, place), np.where(present, follows_now, follows)
        last = np.where(present[:, 0], tracks.time[k], last)
    return positions


def measured_noise(flights: Flights) -> tuple[float, float]:
    """Noise of positions and velocities, from the quarter of the discs whose motion changes least between frames."""
    x, v, during = flights.positions, flights.velocities, np.diff(flights.time)[:, None, None]
    if not np.isfinite(v).any():
        bend = np.diff(x[1:], axis=0) - np.diff(x[:-1], axis=0) * during[1:] / during[:-1]
        ratio = during[1:] / during[:-1]
        return _least_spread(bend / np.sqrt(1 + ratio**2 + (1 + ratio) ** 2)), np.inf
    velocity = _least_spread(np.diff(v, axis=0)) / np.sqrt(2)
    excess = (
        _least_spread(np.diff(x, axis=0) - during * (v[1:] + v[:-1]) / 2) ** 2 - np.mean(during**2) * velocity**2 / 2
    )
    return float(np.sqrt(max(excess, 0) / 2)), velocity


def _least_spread(vectors: np.ndarray) -> float:
    """Standard deviation of a component, from the smallest quarter of the lengths."""
    squares = np.sum(vectors**2, axis=-1)
    squares = squares[np.isfinite(squares)]
    return float(np.sqrt(np.quantile(squares, 0.25) / (-2 * np.log(0.75)))) if squares.size else 0.0


def relative_step(flights: Flights, share: float = 0.5) -> float:
    """Relative displacement of neighbouring discs between frames, in diameters: a quantile over discs and frames."""
    steps = []
    for k in range(len(flights.time) - 1):
        present = np.flatnonzero(np.isfinite(flights.places[k : k + 2, :, 0]).all(axis=0))
        if len(present) > 1:
            _, neighbours = KDTree(flights.places[k, present]).query(flights.places[k, present], k=2)
            nearest = np.asarray(neighbours)[:, 1]
            moved = (flights.positions[k + 1] - flights.positions[k])[present]
            steps.append(np.linalg.norm(moved - moved[nearest], axis=-1))
    return float(np.quantile(np.concatenate(steps), share)) if steps else np.nan


def lasting_share(flights: Flights, noise: Noise) -> float:
    """Share of velocity changes that continue along the same line in the next frame: contacts that outlast a frame.

    Collisions of hard discs in clusters succeed each other as quickly, but along different lines.
    """
    if np.isfinite(flights.velocities).any():
        change, clear, lag = np.diff(flights.velocities, axis=0), _CLEAR_CHANGE * np.sqrt(2) * noise.velocity, 1
    else:  # a change between two frames bends the track at both of them
        x = flights.positions
        change, clear, lag = x[2:] - 2 * x[1:-1] + x[:-2], _CLEAR_CHANGE * np.sqrt(6) * noise.position, 2
    size = np.linalg.norm(change, axis=-1)
    first, then = size[:-lag], size[lag:]
    along = np.sum(change[:-lag] * change[lag:], axis=-1) > _ALONG * first * then
    counted = np.isfinite(then) & (first > clear)
    return float(np.mean((along & (then > clear))[counted])) if np.count_nonzero(counted) >= _FEWEST_CHANGES else 0.0


def candidates(flights: Flights, noise: Noise, struck: np.ndarray | None = None) -> Candidates | None:
    """All pairs that may have collided, in all windows; None if there are none.

    Args:
      flights: unwrapped tracks of all discs, with masses.
      noise: of the observations.
      struck: (frames - 1, grains), windows in which a disc is known to collide, which end its flights.
    """
    margin = _REACH * relative_step(flights, _QUICK) + 0.1
    parts, near, pairs, last = [], [], 0, len(flights.time) - 2
    for k in range(last + 1):
        i, j, apart = _near(flights, k, margin)
        near.append((np.full(len(i), k), i, j, apart))
        pairs += len(i)
        if pairs > _MOST_PAIRS or k == last:
            part = _of_windows(flights, noise, struck, *(np.concatenate(x) for x in zip(*near, strict=True)))
            parts += [] if part is None else [part]
            near, pairs = [], 0
    return Candidates(*(np.concatenate(x) for x in zip(*parts, strict=True))) if parts else None


def with_masses(flights: Flights, noise: Noise) -> Flights:
    """The flights with masses, which if unknown are those for which most centres of mass move straight."""
    part = slice(0, _FRAMES_FOR_MASSES)
    if np.isfinite(flights.masses).all():
        return flights
    few = flights._replace(
        **{name: getattr(flights, name)[part] for name in ("time", "positions", "velocities", "places", "cell")}
    )
    powers = _POWERS if np.ptp(flights.diameters) > 0 else _POWERS[:1]
    best, most = flights, -1
    for power in powers:
        masses = flights.diameters**power
        pairs = candidates(few._replace(masses=masses), noise) if len(powers) > 1 else None
        straight = 0 if pairs is None else int(np.sum(straight_drift(pairs)))
        if straight > most:
            best, most = flights._replace(masses=masses), straight
    return best


def straight_drift(pairs: Candidates) -> Bool[np.ndarray, " pairs"]:
    """Whether the centre of mass of each candidate moves straight, within the noise."""
    return pairs.drift < chdtri(np.maximum(pairs.drift_freedom, 1), _RARE)


def _near(flights: Flights, k: int, margin: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pairs i < j that are near in frame k, and the separation of i from the image of j."""
    present = np.flatnonzero(np.isfinite(flights.places[k, :, 0]))
    if len(present) < 2:
        return np.zeros(0, int), np.zeros(0, int), np.zeros((0, 2))
    reach, places, cell = np.max(flights.diameters[present]) + margin, flights.places[k, present], flights.cell[k]
    images, owner = places, np.arange(len(present))
    if np.isfinite(cell[0]):
        width, height, offset = cell
        places = _wrapped(places, cell)
        shifts = np.array([[m * width + n * offset, n * height] for n in (-1, 0, 1) for m in (-2, -1, 0, 1, 2)])
        images, owner = (places + shifts[:, None]).reshape(-1, 2), np.tile(owner, len(shifts))
        inside = np.all((images > -reach) & (images < np.array([width, height]) + reach), axis=1)
        images, owner = images[inside], owner[inside]
    tree = KDTree(images)
    near = tree.query_ball_point(places, reach, return_sorted=False)
    i = np.repeat(np.arange(len(present)), [len(x) for x in near])
    j_image = np.concatenate([np.asarray(x, int) for x in near])
    apart, j = places[i] - images[j_image], owner[j_image]
    first = i < j
    i, j, apart = present[i[first]], present[j[first]], apart[first]
    close = np.linalg.norm(apart, axis=1) < (flights.diameters[i] + flights.diameters[j]) / 2 + margin
    return i[close], j[close], apart[close]


def _wrapped(places: np.ndarray, cell: np.ndarray) -> np.ndarray:
    width, height, offset = cell
    rows = np.floor(places[:, 1] / height)
    x = places[:, 0] - rows * offset
    return np.stack([x - width * np.floor(x / width), places[:, 1] - rows * height], axis=-1)


def _of_windows(
    flights: Flights,
    noise: Noise,
    struck: np.ndarray | None,
    k: np.ndarray,
    i: np.ndarray,
    j: np.ndarray,
    apart: np.ndarray,
) -> Candidates | None:
    """The candidates among pairs (pairs,) of discs i and j, whose separation is ``apart`` at the start of window k."""
    frames, pair, centre = _around_windows(flights, k, i, j, apart)
    of_pair, every = Noise(np.sqrt(2) * noise.position, np.sqrt(2) * noise.velocity, 0.0), np.arange(len(i))
    flown = []
    for outwards in (np.arange(LONGEST, -1, -1), np.arange(LONGEST + 1, 2 * LONGEST + 2)):
        relative, straight = _straight_part(pair, centre, outwards, of_pair, noise)
        if struck is not None:  # in the window before each further frame outwards
            ends = np.minimum(np.minimum(frames[:, outwards[1:]], frames[:, outwards[:-1]]), len(struck) - 1)
            passed = struck[ends, i[:, None]] | struck[ends, j[:, None]]
            straight[:, 1:] &= np.cumsum(passed, axis=1) == 0
        flown.append(_flown(pair, outwards, relative, straight))
    before, after = flown
    change = after.slope - before.slope
    size = np.sum(change**2, axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        clear = before.settled & after.settled & (size > _LEAST_CHANGE**2 * (before.variance + after.variance))
        contact = -np.sum((after.start - before.start) * change, axis=-1) / size
        until = pair.time[every, np.argmax(after.belongs, axis=1)]
        late = 0.5 * until + 3 * of_pair.position / np.sqrt(size)  # noise may shift it out of the window by as much
        clear &= (contact > -late) & (contact < until + late)
        contact = np.clip(contact, 0, until)
    if not clear.any():
        return None
    place = sum(flight.start + flight.slope * contact[:, None] for flight in flown) / 2
    both = before.belongs | after.belongs
    drift = _lines(centre.only(both), np.arange(both.shape[1]), noise)
    found = Candidates(
        window=k,
        grains=np.stack([i, j], axis=-1),
        reach=(flights.diameters[i] + flights.diameters[j]) / 2,
        time=pair.time,
        separation=np.where(both[..., None], pair.positions, 0),
        velocity=np.where((both & pair.has_velocity)[..., None], pair.velocities, 0),
        has_velocity=pair.has_velocity,
        before=before.belongs,
        after=after.belongs,
        duration=until,
        guess=np.concatenate([place, contact[:, None], before.slope], axis=1),
        drift=drift.misfit[:, -1],
        drift_freedom=2.0 * (both * (1 + pair.has_velocity)).sum(axis=1) - 4,
    )
    return Candidates(*(x[clear] for x in found))


def _around_windows(
    flights: Flights, k: np.ndarray, i: np.ndarray, j: np.ndarray, apart: np.ndarray
) -> tuple[np.ndarray, "_Observed", "_Observed"]:
    """The frames (pairs, frames) around windows, and the motion there of disc i relative to j and of their centre.

    That of the centre of mass is over the root mean square of the weights, so that it has the noise of one disc.
    """
    around = k[:, None] + np.arange(-LONGEST, 2 + LONGEST)
    exists = (around >= 0) & (around < len(flights.time))
    frames = np.clip(around, 0, len(flights.time) - 1)
    time = np.where(exists, flights.time[frames] - flights.time[k, None], 0.0)
    # The image of j lies a lattice vector from its track, and slides with the mean flow at its height
    shift = apart - (flights.positions[k, i] - flights.positions[k, j])
    slide = flights.shear_rate * np.stack([shift[:, 1], np.zeros(len(i))], axis=-1)
    of_i, of_j = (flights.positions[frames, grain[:, None]] for grain in (i, j))
    image = of_j - shift[:, None] - time[..., None] * slide[:, None]
    v_i, v_j = (flights.velocities[frames, grain[:, None]] for grain in (i, j))
    v_image = v_j - slide[:, None]
    share = (flights.masses[i] / (flights.masses[i] + flights.masses[j]))[:, None, None]
    spread = np.sqrt(share**2 + (1 - share) ** 2)
    middle, v_middle = ((share * one + (1 - share) * other) / spread for one, other in ((of_i, image), (v_i, v_image)))
    pair, centre = (_Observed(time, *motion, exists) for motion in ((of_i - image, v_i - v_image), (middle, v_middle)))
    return frames, pair, centre


class _Flight(NamedTuple):
    """The flight of each pair on one side of its window, and the line through it."""

    belongs: np.ndarray  # (pairs, frames), whether a frame belongs to it
    settled: np.ndarray  # as in ``_Lines``
    start: np.ndarray
    slope: np.ndarray
    variance: np.ndarray


def _flown(pair: "_Observed", outwards: np.ndarray, relative: "_Lines", straight: np.ndarray) -> _Flight:
    """The flight that is straight up to a frame, and its line."""
    belongs = np.zeros(pair.present.shape, bool)
    belongs[:, outwards] = straight & pair.present[:, outwards]
    end = np.arange(len(straight)), straight.sum(axis=1) - 1
    return _Flight(belongs, *(x[end] for x in (relative.settled, relative.start, relative.slope, relative.variance)))


def _straight_part(
    pair: "_Observed", centre: "_Observed", outwards: np.ndarray, of_pair: Noise, noise: Noise
) -> tuple["_Lines", np.ndarray]:
    """Lines of the relative motion, and up to which frame (pairs, frames) both motions are straight."""
    relative, common = _lines(pair, outwards, of_pair), _lines(centre, outwards, noise)
    together = relative.misfit + common.misfit
    added = np.diff(together, axis=1, prepend=0)
    freedom = 4 * (1 + pair.has_velocity[:, outwards].astype(int))
    total = np.cumsum(freedom * pair.present[:, outwards], axis=1) - 8
    likely = (added < _BENT[freedom]) & (together < _BENT[np.maximum(total, 1)])
    return relative, np.cumprod(~relative.settled | likely, axis=1).astype(bool)


class _Observed:
    """Positions (pairs, frames, 2) and velocities of points at times (pairs, frames), and where they exist."""

    def __init__(self, time, positions, velocities, exists):
        self.time, self.positions, self.velocities = time, positions, velocities
        self.present = exists & np.isfinite(positions[..., 0])
        self.has_velocity = self.present & np.isfinite(velocities[..., 0])

    def only(self, chosen: np.ndarray) -> "_Observed":
        """The same in the chosen frames only."""
        return _Observed(self.time, self.positions, self.velocities, self.present & chosen)


class _Lines(NamedTuple):
    """Straight lines through the first one, two, … of the frames: (pairs, frames) and (pairs, frames, 2)."""

    settled: np.ndarray  # whether these frames determine a line
    start: np.ndarray  # position at time zero
    slope: np.ndarray
    variance: np.ndarray  # of a component of the slope
    misfit: np.ndarray  # χ²


def _lines(points: _Observed, order: np.ndarray, noise: Noise) -> _Lines:
    """Weighted least squares, by cumulative sums over the frames in the given order."""
    t = points.time[:, order]
    wx = points.present[:, order] / noise.position**2
    wv = points.has_velocity[:, order] / noise.velocity**2
    x = np.where(points.present[:, order, None], points.positions[:, order], 0)
    v = np.where(points.has_velocity[:, order, None], points.velocities[:, order], 0)
    # Relative to the first position, so that sums of squares keep their digits
    first = x[np.arange(len(x)), np.argmax(points.present[:, order], axis=1)][:, None]
    x = np.where(points.present[:, order, None], x - first, 0)
    s0, s1, s2 = (np.cumsum(y, axis=1) for y in (wx, wx * t, wx * t**2 + wv))
    p = np.cumsum(wx[..., None] * x, axis=1)
    q = np.cumsum((wx * t)[..., None] * x + wv[..., None] * v, axis=1)
    r = np.cumsum(np.sum(wx[..., None] * x**2 + wv[..., None] * v**2, axis=-1), axis=1)
    determinant = s0 * s2 - s1**2
    settled = determinant > 1e-9 * s0 * s2
    safe = np.where(settled, determinant, 1)[..., None]
    start = (s2[..., None] * p - s1[..., None] * q) / safe
    slope = (s0[..., None] * q - s1[..., None] * p) / safe
    misfit = np.where(settled, np.maximum(r - np.sum(start * p + slope * q, axis=-1), 0), 0)
    return _Lines(settled, start + first, slope, s0 / safe[..., 0], misfit)
