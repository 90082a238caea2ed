"""Tracks: where discs were seen, frame by frame, whatever saw them, and how they come from a table or from states.

Every reader of ``track_files`` makes a ``Table``, one row for each disc in each frame. ``tracks_of_table`` makes of it
the arrays that a fit needs. A disc that is not seen in a frame has NaN there.

Velocities are those of the laboratory. Where a program gives peculiar ones, γ̇ y x̂ is added.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxgran.model.checks import InputError, require_number, require_untraced, short_repr
from jaxgran.model.state import State

_LARGEST = 50_000_000  # entries of discs × frames; more do not fit into the memory of a small machine
_SAME_TIME = (0.7, 1.4)  # of displacement over velocity × time, where both are in one unit
_ONE_MASS = 1e-3  # by which the mass of a disc may differ from frame to frame; at more, it is none
_LEAP = 5.0  # median displacements, above which a displacement is none
_SAME_FRAME = 0.2  # of the shear that displacements have and velocities lack, over their rms difference across the cell


@dataclass(frozen=True)
class Tracks:
    """Discs that were seen in frames, in units of the observer.

    ==========  ===================  ====  ====================================================================
    field       shape                unit  meaning
    ==========  ===================  ====  ====================================================================
    time        (frames,)            t     time of each frame, increasing
    diameters   (grains,)            ℓ     diameter
    masses      (grains,)            m     mass, in any unit; NaN where they are not known
    positions   (frames, grains, 2)  ℓ     centres; NaN in a frame in which the disc is not seen
    velocities  (frames, grains, 2)  ℓ/t   in the laboratory; NaN where they are not known
    cell        (frames, 3)          ℓ     width, height and offset along x of the image row above; infinite
                                           width and height without a periodic cell
    shear_rate  ()                   1/t   γ̇ at which the image rows slide; 0 without a sheared cell
    ==========  ===================  ====  ====================================================================
    """

    time: Float[np.ndarray, " frames"]
    diameters: Float[np.ndarray, " grains"]
    masses: Float[np.ndarray, " grains"]
    positions: Float[np.ndarray, "frames grains 2"]
    velocities: Float[np.ndarray, "frames grains 2"]
    cell: Float[np.ndarray, "frames 3"]
    shear_rate: float


class Table(NamedTuple):
    """What a file says: a row for each disc in each frame.

    ==========  =========  ==============================================================================
    columns     (rows,)    by name: frame or time, id, x, y; diameter, mass, vx, vy where they are known
    cells       (frames,3) as in ``Tracks``, in the order of the frames; None without a periodic cell
    ==========  =========  ==============================================================================
    """

    columns: dict[str, np.ndarray]
    cells: np.ndarray | None = None


class Observation(NamedTuple):
    """What the user says of a file; None where the file says it, or its displacements.

    ===========  ====  ==========================================================================
    interval     t     time between frames, of the smallest difference of their numbers
    shear_rate   1/t   γ̇
    peculiar     –     whether velocities are relative to the shear, γ̇ y x̂ being left out
    diameter     ℓ     of all discs
    ===========  ====  ==========================================================================
    """

    interval: float | None = None
    shear_rate: float | None = None
    peculiar: bool = False
    diameter: float | None = None


def tracks_of_states(strain: Float[np.ndarray, " frames"], states: State, shear_rate: float = 1.0) -> Tracks:
    """Tracks of the states of a flow, such as ``state`` of ``snapshot_series``.

    Args:
      strain: (frames,), strain of each frame, increasing; the time of each frame where ``shear_rate`` is 0.
      states: the frames, with a leading (frames,) axis.
      shear_rate: γ̇, in the time unit of the velocities.

    Raises:
      InputError: (a ValueError) fewer than two frames, out of order or not finite.
    """
    require_untraced(
        "tracks_of_states", "it computes in NumPy, so call it for each trajectory", strain, states, shear_rate
    )
    require_number("shear_rate", shear_rate, lambda x: (x >= 0) & np.isfinite(x), "a number of at least 0")
    strain, shape = np.asarray(strain, float), np.shape(states.velocities) if isinstance(states, State) else ()
    if strain.ndim != 1 or len(strain) < 2 or len(shape) != 3 or shape[0] != len(strain):
        raise InputError(
            "states must be two or more frames of one flow, with the strain of each, "
            f"not {len(np.atleast_1d(strain))} strains and velocities of shape {shape}."
        )
    if not np.all(np.isfinite(strain)) or np.any(np.diff(strain) <= 0):
        raise InputError("strain must be finite and increase from frame to frame.")
    parts = (states.grains.radii, states.grains.masses, states.positions, states.velocities, states.side, states.tilt)
    radii, masses, positions, velocities, side, tilt = (np.asarray(x, float) for x in parts)
    if not all(np.all(np.isfinite(x)) for x in (radii, masses, positions, velocities, side, tilt)):
        raise InputError("states must have finite positions, velocities, radii and masses.")
    time = strain / shear_rate if shear_rate > 0 else strain
    cell = np.stack([side, side, side * tilt], axis=-1)
    return Tracks(
        time, 2 * radii[0], masses[0], positions, _laboratory(velocities, positions, shear_rate), cell, shear_rate
    )


def tracks_of_table(table: Table, said: Observation, name: str) -> Tracks:
    """The tracks of a table; ``name`` is that of the file, for the sentence of an InputError."""
    clock = "time" if "time" in table.columns else "frame"
    columns = {key: np.asarray(column, float) for key, column in table.columns.items()}
    for key in (clock, "id"):
        if not np.all(np.isfinite(columns[key])):
            raise InputError(f"{name} has a row without a number in the column {key}.")
    if any(np.any(np.isinf(column)) for column in columns.values()):
        raise InputError(f"{name} has a number that is infinite.")
    instants, frame = np.unique(columns[clock], return_inverse=True)
    ids, grain = np.unique(columns["id"], return_inverse=True)
    if len(instants) < 2:
        raise InputError(f"{name} has one frame, and a collision is seen between two.")
    if len(ids) < 2:
        raise InputError(f"{name} has one disc, and a collision takes two.")
    if len(instants) * len(ids) > _LARGEST:
        raise InputError(f"{name} has {len(instants)} frames of {len(ids)} ids, which are too many: give a part of it.")
    if len(np.unique(frame * len(ids) + grain)) < len(frame):
        raise InputError(f"{name} has an id twice in one frame.")

    def spread(*names: str) -> np.ndarray:
        full = np.full((len(instants), len(ids), len(names)), np.nan)
        for k, key in enumerate(names):
            full[frame, grain, k] = columns.get(key, np.nan)
        return full

    positions, velocities = spread("x", "y"), spread("vx", "vy")
    positions[~np.isfinite(positions).all(axis=-1)] = np.nan
    if not np.any(np.isfinite(positions)):
        raise InputError(f"{name} has no disc with both x and y.")
    velocities[~(np.isfinite(velocities).all(axis=-1) & np.isfinite(positions[..., 0]))] = np.nan
    if not np.any(velocities[np.isfinite(velocities)]):  # a program that does not store them writes zeros
        velocities[:] = np.nan
    diameters = _of_grain(spread("diameter")[..., 0])
    if said.diameter is not None:
        diameters = np.full(len(ids), said.diameter)
    if not np.any(np.isfinite(diameters)):
        raise InputError(f"{name} has no column diameter or radius: give --diameter.")
    if not np.all(diameters > 0):
        raise InputError(f"{name} has a disc whose diameter is not a positive number.")
    each_mass = spread("mass")[..., 0]
    masses = _of_grain(each_mass)
    off = np.abs(each_mass - masses) > _ONE_MASS * masses  # trackers call the brightness of a disc its mass
    masses = masses if np.all(masses > 0) and not off.any() else np.full(len(ids), np.nan)
    cell = table.cells if table.cells is not None else np.tile([np.inf, np.inf, 0.0], (len(instants), 1))
    if clock == "time":
        if said.interval is not None:
            raise InputError(f"{name} has a column time, so a time between frames is not to be given.")
        time, known_time = instants, True
    else:
        time, known_time = (instants - instants[0]) / np.min(np.diff(instants)), said.interval is not None
        time = time * (said.interval if said.interval is not None else 1.0)
    tracks = Tracks(time, diameters, masses, positions, velocities, cell, 0.0)
    return _in_one_unit(tracks, said, known_time, name)


def _in_one_unit(tracks: Tracks, said: Observation, known_time: bool, name: str) -> Tracks:
    """Tracks with a unit of time and velocities of the laboratory; an InputError where these cannot be theirs."""
    has_velocities, rate = bool(np.isfinite(tracks.velocities).any()), said.shear_rate
    moved, during = displacements(tracks), np.diff(tracks.time)[:, None, None]
    steps = np.linalg.norm(moved, axis=-1, keepdims=True)
    if np.isfinite(steps).any():  # through the sides of a cell that is not known, and other leaps
        moved = np.where(steps <= _LEAP * np.nanmedian(steps), moved, np.nan)
    if has_velocities:
        mean = (tracks.velocities[1:] + tracks.velocities[:-1]) / 2 * during
        seen = np.isfinite(moved) & np.isfinite(mean)
        if np.any(mean[..., 1][seen[..., 1]]):
            seen[..., 0] = False  # along x they may lack the shear
        quick = seen & (np.abs(mean) >= np.median(np.abs(mean[seen]))) & (mean != 0) if seen.any() else seen
        # The median, as the few that collide in between do not go with their mean velocity
        slope = float(np.median(moved[quick] / mean[quick])) if quick.any() else 0.0
        if not known_time and slope > 0:
            tracks = _with(tracks, time=tracks.time * slope)
        elif not _SAME_TIME[0] < slope < _SAME_TIME[1]:
            raise InputError(
                f"{name} has displacements that are {slope:.3g} times velocity × time: its velocities, its lengths and "
                "the time between its frames must be in one unit."
            )
    if rate is None:
        rate = sliding(tracks)
    velocities = _laboratory(tracks.velocities, tracks.positions, rate) if said.peculiar else tracks.velocities
    tracks = _with(tracks, velocities=velocities, shear_rate=rate)
    if has_velocities:
        _require_frame(tracks, moved, name)
    return tracks


def _require_frame(tracks: Tracks, moved: np.ndarray, name: str) -> None:
    """Raise an InputError where displacements have a shear that the velocities lack, or the other way round."""
    during = np.diff(tracks.time)[:, None]
    height = (tracks.positions[1:, :, 1] + tracks.positions[:-1, :, 1]) / 2
    lacking = moved[..., 0] / during - (tracks.velocities[1:, :, 0] + tracks.velocities[:-1, :, 0]) / 2
    seen = np.isfinite(height) & np.isfinite(lacking)
    if np.count_nonzero(seen) < 3:
        return
    y, u = height[seen] - height[seen].mean(), lacking[seen] - np.median(lacking[seen])
    variance = np.mean(y**2)
    if variance == 0:
        return
    rate = np.mean(y * np.clip(u, *np.quantile(u, (0.02, 0.98)))) / variance
    speed = np.sqrt(np.nanmean(tracks.velocities[..., 1] ** 2))
    if abs(rate) * np.sqrt(variance) > max(_SAME_FRAME * speed, 5 * np.std(u) / np.sqrt(seen.sum())):
        raise InputError(
            f"{name} has velocities that differ from its displacements by a shear of rate {rate:.3g}: give "
            "--shear-rate, and --peculiar where they are relative to the shear."
        )


def every_frame(tracks: Tracks, every: int, name: str) -> Tracks:
    """Each third frame only where ``every`` is 3; an InputError where fewer than two are left."""
    if every == 1:
        return tracks
    if len(tracks.time) <= every:
        raise InputError(f"every must be less than the number of frames, {len(tracks.time)} in {name}, not {every}.")
    by_frame = {key: getattr(tracks, key)[::every] for key in ("time", "positions", "velocities", "cell")}
    return _with(tracks, **by_frame)


def displacements(tracks: Tracks) -> Float[np.ndarray, "frames-1 grains 2"]:
    """How far each disc has gone from frame to frame, to its nearest image; NaN where it is not seen in both."""
    return nearest_image(np.diff(tracks.positions, axis=0), tracks.cell[1:, None])


def nearest_image(separations: Float[np.ndarray, "*n 2"], cell: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 2"]:
    """The minimum image of separations in a cell; unchanged where the cell is infinite."""
    width, height, offset = np.moveaxis(cell, -1, 0)
    periodic = np.isfinite(height)
    rows = np.where(periodic, np.round(separations[..., 1] / height), 0)
    x = separations[..., 0] - rows * offset
    columns = np.where(periodic, np.round(x / width), 0)
    across, up = np.where(periodic, width, 0), np.where(periodic, height, 0)
    return np.stack([x - columns * across, separations[..., 1] - rows * up], axis=-1)


def sliding(tracks: Tracks) -> float:
    """The rate at which the image rows of the cell slide, from its offsets; they are known up to the width."""
    width, height, offset = tracks.cell.T
    if not np.all(np.isfinite(width)):
        return 0.0
    slid = np.diff(offset)
    slid -= width[1:] * np.round(slid / width[1:])
    return float(np.sum(slid / height[1:]) / (tracks.time[-1] - tracks.time[0]))


def _laboratory(velocities: np.ndarray, positions: np.ndarray, shear_rate: float) -> np.ndarray:
    return velocities + shear_rate * np.stack([positions[..., 1], np.zeros(positions.shape[:-1])], axis=-1)


def _of_grain(values: Float[np.ndarray, "frames grains"]) -> Float[np.ndarray, " grains"]:
    """The median over the frames of a number that belongs to a disc; NaN where it is never given."""
    known = np.isfinite(values).any(axis=0)
    medians = np.full(values.shape[1], np.nan)
    medians[known] = np.nanmedian(values[:, known], axis=0)
    return medians


def _with(tracks: Tracks, **changes) -> Tracks:
    return Tracks(**{**{name: getattr(tracks, name) for name in Tracks.__dataclass_fields__}, **changes})


def require_observation(said: Observation) -> None:
    """Raise an InputError unless the numbers that are given can be."""
    for name, words, value in (
        ("interval", "a positive number", said.interval),
        ("diameter", "a positive number", said.diameter),
    ):
        if value is not None:
            require_number(name, value, lambda x: (x > 0) & np.isfinite(x), words)
    if said.shear_rate is not None:
        require_number("shear_rate", said.shear_rate, np.isfinite, "a finite number")
    if said.peculiar and not said.shear_rate:
        raise InputError(f"peculiar goes with a shear rate, and shear_rate is {short_repr(said.shear_rate)}.")
