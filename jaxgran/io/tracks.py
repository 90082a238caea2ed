"""Tracks of discs: observed positions and velocities frame by frame, built from a table or from states.

Every reader in ``track_files`` returns a ``Table`` with a row for each disc in each frame, which ``tracks_of_table``
converts to arrays. A disc missing from a frame has NaN there. Velocities are in the laboratory frame: γ̇ y x̂ is added to
peculiar ones.
"""

import warnings
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxgran.model.batches import equal_values
from jaxgran.model.checks import InputError, require_number, require_untraced, short_repr
from jaxgran.model.state import State

_LARGEST = 50_000_000  # discs × frames that fit into the memory of a small machine
_SAME_TIME = (0.7, 1.4)  # accepted displacement over velocity × time
_ONE_MASS = 1e-3  # largest relative variation of the mass of a disc; above it, the column is no mass
_LEAP = 5.0  # median displacements, above which a displacement is discarded
_SAME_RATE = 0.2  # largest relative difference of a missing shear from the shear rate
_SAME_FRAME = 0.2  # largest shear between displacements and velocities, in rms velocities across the cell


@dataclass(frozen=True)
class Tracks:
    """Tracked discs, in the units of the observer.

    ==========  ===================  ====  ====================================================================
    field       shape                unit  meaning
    ==========  ===================  ====  ====================================================================
    time        (frames,)            t     time of each frame, increasing
    diameters   (grains,)            ℓ     diameter
    masses      (grains,)            m     mass, in any unit; NaN if unknown
    positions   (frames, grains, 2)  ℓ     centres; NaN in frames without the disc
    velocities  (frames, grains, 2)  ℓ/t   in the laboratory; NaN if unknown
    cell        (frames, 3)          ℓ     width, height and x offset of the image row above; infinite width
                                           and height without a periodic cell
    shear_rate  ()                   1/t   γ̇ of the sheared cell; 0 without one
    ==========  ===================  ====  ====================================================================
    """

    time: Float[np.ndarray, " frames"]
    diameters: Float[np.ndarray, " grains"]
    masses: Float[np.ndarray, " grains"]
    positions: Float[np.ndarray, "frames grains 2"]
    velocities: Float[np.ndarray, "frames grains 2"]
    cell: Float[np.ndarray, "frames 3"]
    shear_rate: float

    __eq__ = equal_values


class Table(NamedTuple):
    """Content of a file: a row for each disc in each frame."""

    columns: dict[str, np.ndarray]  # (rows,) by name: frame or time, id, x, y; optionally diameter, mass, vx, vy
    cells: np.ndarray | None = None  # (frames, 3) as in ``Tracks``, by frame; None without a periodic cell


class Observation(NamedTuple):
    """What the user specifies about a file; None to infer it."""

    interval: float | None = None  # time between frames whose numbers differ by the smallest difference
    shear_rate: float | None = None
    peculiar: bool = False  # whether velocities are relative to the mean flow γ̇ y x̂
    diameter: float | None = None  # of all discs


def tracks_of_states(strain: Float[np.ndarray, " frames"], states: State, shear_rate: float = 1.0) -> Tracks:
    """Tracks of the states of a flow, such as ``state`` of ``snapshot_series``.

    Args:
      strain: (frames,), strain of each frame, increasing; its time if ``shear_rate`` is 0.
      states: states with a leading (frames,) axis.
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


def tracks_of_table(table: Table, observation: Observation, name: str) -> Tracks:
    """The tracks in a table; ``name`` names the file in error messages."""
    clock = "time" if "time" in table.columns else "frame"
    columns = {key: np.asarray(column, float) for key, column in table.columns.items()}
    for key in (clock, "id"):
        if not np.all(np.isfinite(columns[key])):
            raise InputError(f"{name} has a missing value in column {key}.")
    if any(np.any(np.isinf(column)) for column in columns.values()):
        raise InputError(f"{name} has an infinite number.")
    instants, frame = np.unique(columns[clock], return_inverse=True)
    ids, grain = np.unique(columns["id"], return_inverse=True)
    if len(instants) < 2:
        raise InputError(f"{name} has one frame, and two or more are needed.")
    if len(ids) < 2:
        raise InputError(f"{name} has one disc, and two or more are needed.")
    if len(instants) * len(ids) > _LARGEST:
        raise InputError(f"{name} is too large, with {len(instants)} frames of {len(ids)} ids: read a part of it.")
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
    if not np.any(velocities[np.isfinite(velocities)]):  # programs without velocities write zeros
        velocities[:] = np.nan
    diameters = _of_grain(spread("diameter")[..., 0])
    if observation.diameter is not None:
        diameters = np.full(len(ids), observation.diameter)
    if not np.any(np.isfinite(diameters)):
        raise InputError(f"{name} has no column diameter or radius: give the diameter.")
    if not np.all(diameters > 0):
        raise InputError(f"{name} has a disc whose diameter is not positive.")
    each_mass = spread("mass")[..., 0]
    masses = _of_grain(each_mass)
    off = np.abs(each_mass - masses) > _ONE_MASS * masses  # some trackers call brightness "mass"
    masses = masses if np.all(masses > 0) and not off.any() else np.full(len(ids), np.nan)
    cell = table.cells if table.cells is not None else np.tile([np.inf, np.inf, 0.0], (len(instants), 1))
    if clock == "time":
        if observation.interval is not None:
            raise InputError(f"{name} contains its times, so no time between frames may be given.")
        time, has_interval = instants, True
    else:
        time, has_interval = (instants - instants[0]) / np.min(np.diff(instants)), observation.interval is not None
        time = time * (observation.interval if observation.interval is not None else 1.0)
    tracks = Tracks(time, diameters, masses, positions, velocities, cell, 0.0)
    return _in_one_unit(tracks, observation, has_interval, name)


def _in_one_unit(tracks: Tracks, observation: Observation, has_interval: bool, name: str) -> Tracks:
    """Tracks with consistent units of time and laboratory velocities; an InputError if these contradict each other."""
    has_velocities, rate = bool(np.isfinite(tracks.velocities).any()), observation.shear_rate
    moved, during = displacements(tracks), np.diff(tracks.time)[:, None, None]
    steps = np.linalg.norm(moved, axis=-1, keepdims=True)
    if np.isfinite(steps).any():  # discard jumps through the sides of an unknown cell
        moved = np.where(steps <= _LEAP * np.nanmedian(steps), moved, np.nan)
    if has_velocities:
        mean = (tracks.velocities[1:] + tracks.velocities[:-1]) / 2 * during
        defined = np.isfinite(moved) & np.isfinite(mean)
        if np.any(mean[..., 1][defined[..., 1]]):
            defined[..., 0] = False  # velocities along x may exclude the mean flow
        quick = defined & (np.abs(mean) >= np.median(np.abs(mean[defined]))) & (mean != 0) if defined.any() else defined
        # The median excludes the few discs that collide in between
        slope = float(np.median(moved[quick] / mean[quick])) if quick.any() else 0.0
        if not has_interval and slope > 0:
            tracks = replace(tracks, time=tracks.time * slope)
        elif not _SAME_TIME[0] < slope < _SAME_TIME[1]:
            raise InputError(
                f"{name} has displacements of {slope:.3g} times velocity × time: its velocities, lengths and the time "
                "between its frames must have consistent units."
            )
    if rate is None:
        rate = cell_shear_rate(tracks)
    tracks = replace(tracks, shear_rate=rate)
    if not has_velocities:
        return tracks
    if observation.peculiar:
        tracks = _with_shear(tracks, rate, moved)
    lacking, only_shear = _lacking_shear(tracks, moved)
    unknown = rate == 0 and observation.shear_rate is None
    as_expected = unknown or abs(lacking - rate) < _SAME_RATE * abs(rate)
    if lacking and only_shear and as_expected and not observation.peculiar:
        tracks = _with_shear(tracks, rate or lacking, moved)
        warnings.warn(
            f"the velocities in {name} lack the shear of the displacements, of rate {lacking:.3g}: they are taken as "
            "peculiar.",
            stacklevel=4,
        )
        lacking, _ = _lacking_shear(tracks, moved)
    if lacking:
        raise InputError(
            f"{name} has velocities that differ from its displacements by a shear of rate {lacking:.3g}, and its shear "
            f"rate is {rate:.3g}: check the unit of its velocities, the time between its frames and the shear rate."
        )
    return tracks


def _lacking_shear(tracks: Tracks, moved: np.ndarray) -> tuple[float, bool]:
    """The rate of the shear by which displacements differ from velocities × time, or 0 if it is not significant.

    Also whether most velocities lack nothing but this shear.
    """
    height = (tracks.positions[1:, :, 1] + tracks.positions[:-1, :, 1]) / 2
    lacking = _lacking_velocity(tracks, moved)
    defined = np.isfinite(height) & np.isfinite(lacking)
    half = np.count_nonzero(defined) // 2
    if half < 2:
        return 0.0, False
    order = np.argsort(height[defined])
    y, u = height[defined][order], lacking[defined][order]
    apart = y[-half:] - y[:half]
    if not np.all(apart > 0):
        return 0.0, False
    rate = float(np.median((u[-half:] - u[:half]) / apart))  # the median excludes the few discs that collide in between
    others = u - rate * y
    others -= np.median(others)
    speed = np.sqrt(np.nanmean(tracks.velocities[..., 1] ** 2))
    significant = max(_SAME_FRAME * speed, 5 * np.std(others) / np.sqrt(len(u)))
    only_shear = bool(np.median(np.abs(others)) <= _SAME_FRAME * speed)
    return rate if abs(rate) * np.std(y) > significant else 0.0, only_shear


def _with_shear(tracks: Tracks, rate: float, moved: np.ndarray) -> Tracks:
    """Tracks with laboratory velocities from peculiar ones; the mean flow is at rest where the displacements say so."""
    velocities = _laboratory(tracks.velocities, tracks.positions, rate)
    sheared = replace(tracks, velocities=velocities, shear_rate=rate)
    lacking = _lacking_velocity(sheared, moved)
    known = lacking[np.isfinite(lacking)]
    return replace(sheared, velocities=velocities + np.array([np.median(known) if known.size else 0.0, 0.0]))


def _lacking_velocity(tracks: Tracks, moved: np.ndarray) -> np.ndarray:
    """What the velocities along x lack of displacement over time, (frames - 1, grains)."""
    mean = (tracks.velocities[1:, :, 0] + tracks.velocities[:-1, :, 0]) / 2
    return moved[..., 0] / np.diff(tracks.time)[:, None] - mean


def with_stride(tracks: Tracks, stride: int, name: str) -> Tracks:
    """Every ``stride``-th frame; an InputError if fewer than two remain."""
    if len(tracks.time) <= stride:
        raise InputError(f"stride must be less than the number of frames, {len(tracks.time)} in {name}, not {stride}.")
    by_frame = {key: getattr(tracks, key)[::stride] for key in ("time", "positions", "velocities", "cell")}
    return replace(tracks, **by_frame)


def displacements(tracks: Tracks) -> Float[np.ndarray, "frames-1 grains 2"]:
    """Displacement of each disc from frame to frame, to its nearest image; NaN if it is missing from either."""
    return nearest_image(np.diff(tracks.positions, axis=0), tracks.cell[1:, None])


def nearest_image(separations: Float[np.ndarray, "*n 2"], cell: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 2"]:
    """The minimum image of separations in a cell; unchanged if the cell is infinite."""
    width, height, offset = np.moveaxis(cell, -1, 0)
    periodic = np.isfinite(height)
    rows = np.where(periodic, np.round(separations[..., 1] / height), 0)
    x = separations[..., 0] - rows * offset
    columns = np.where(periodic, np.round(x / width), 0)
    across, up = np.where(periodic, width, 0), np.where(periodic, height, 0)
    return np.stack([x - columns * across, separations[..., 1] - rows * up], axis=-1)


def cell_shear_rate(tracks: Tracks) -> float:
    """Shear rate of the cell, from the offsets of its image rows, which are known modulo the width."""
    width, height, offset = tracks.cell.T
    if not np.all(np.isfinite(width)):
        return 0.0
    slid = np.diff(offset)
    slid -= width[1:] * np.round(slid / width[1:])
    return float(np.sum(slid / height[1:]) / (tracks.time[-1] - tracks.time[0]))


def _laboratory(velocities: np.ndarray, positions: np.ndarray, shear_rate: float) -> np.ndarray:
    return velocities + shear_rate * np.stack([positions[..., 1], np.zeros(positions.shape[:-1])], axis=-1)


def _of_grain(values: Float[np.ndarray, "frames grains"]) -> Float[np.ndarray, " grains"]:
    """Median over the frames of a property of a disc; NaN if it is never given."""
    given = np.isfinite(values).any(axis=0)
    medians = np.full(values.shape[1], np.nan)
    medians[given] = np.nanmedian(values[:, given], axis=0)
    return medians


def require_observation(observation: Observation) -> None:
    """Raise an InputError unless what the user specified is possible."""
    for name in ("interval", "diameter"):
        if (value := getattr(observation, name)) is not None:
            require_number(name, value, lambda x: (x > 0) & np.isfinite(x), "a positive number")
    if observation.shear_rate is not None:
        require_number("shear_rate", observation.shear_rate, np.isfinite, "a finite number")
    if observation.peculiar and not observation.shear_rate:
        raise InputError(f"peculiar requires a shear rate, and shear_rate is {short_repr(observation.shear_rate)}.")
