"""Readers of tracked discs: tables (CSV, HDF5), LAMMPS dumps, and GSD files of any program.

=====================================  ===============================================================================
file                                   required content
=====================================  ===============================================================================
``.csv``, ``.txt``, ``.tsv``           a header with the names below, one row per disc and frame
``.h5``, ``.hdf5``                     the same columns, as datasets of a group or as one dataset with named fields
``.lammpstrj``, ``.dump``              a text dump: id, positions (x, xu, xs or xsu), radius or diameter
``.gsd``                               positions in a box; z = 0 in all frames
=====================================  ===============================================================================

Columns, in any order and case: ``frame`` or ``time``, ``id`` or ``particle``, ``x``, ``y``, ``diameter`` or ``radius``;
optionally ``vx``, ``vy`` and ``mass``. A unit in brackets may follow a name.
"""

import glob
import math
import os
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxgran.io.tracks import (
    Observation,
    Table,
    Tracks,
    require_observation,
    tracks_of_states,
    tracks_of_table,
    with_stride,
)
from jaxgran.io.trajectory import read_trajectory
from jaxgran.model.checks import InputError, require_whole, short_repr

_NAMES = {
    "frame": ("frame", "step", "timestep"),
    "time": ("time", "t"),
    "id": ("particle", "track_id", "track", "id", "label"),  # "id" last: some trackers number detections by it
    "x": ("x", "position_x"),
    "y": ("y", "position_y"),
    "z": ("z",),
    "vx": ("vx",),
    "vy": ("vy",),
    "diameter": ("diameter", "d"),
    "radius": ("radius",),
    "mass": ("mass",),
}
_FLAT = 1e-3  # largest spread of z in diameters


def read_tracks(
    path: str | os.PathLike,
    *,
    interval: float | None = None,
    shear_rate: float | None = None,
    peculiar: bool = False,
    diameter: float | None = None,
    stride: int = 1,
) -> Tracks:
    """Read the tracks of discs from a file of another program or of a camera.

    Args:
      path: a table (``.csv``, ``.tsv``, ``.txt``, ``.h5``, ``.hdf5``), a LAMMPS dump (``.lammpstrj``, ``.dump``) or a
        GSD file. A table has the columns frame or time, id, x, y, diameter or radius, and optionally vx, vy, mass.
      interval: time between consecutive frames (the smallest difference of frame numbers). By default it is inferred
        from velocities and displacements, or is 1 without velocities.
      shear_rate: γ̇ of a sheared periodic cell; by default the rate at which the cell of the file tilts.
      peculiar: whether velocities are relative to the mean flow γ̇ y x̂. Velocities that lack the shear of the
        displacements are taken as peculiar with a UserWarning.
      diameter: diameter of all discs, for a file without diameters.
      stride: 3 uses every third frame.

    Returns:
      Tracks for ``fit_restitution``. A GSD file of jaxgran contains all parameters, so none may be given.

    Raises:
      InputError: (a ValueError) the file does not exist or does not contain such tracks; the message says why.
    """
    if not isinstance(path, (str, os.PathLike)):
        raise InputError(f"path must be a file name, not {short_repr(path)}.")
    observation = Observation(interval, shear_rate, peculiar, diameter)
    require_observation(observation)
    require_whole("stride", stride, 1, 10**9, "as files have fewer frames")
    path = Path(os.fspath(path))
    name, reader = short_repr(path.name), _READERS.get(path.suffix.lower())
    if reader is None:
        raise InputError(f"tracks must be a file that ends in {', '.join(_READERS)}, not {name}.")
    if not path.is_file():
        raise InputError(f"there is no file {short_repr(str(path))}.")
    if reader is _gsd_table and _of_jaxgran(path):
        if observation != Observation():
            raise InputError(f"{name} contains its time, shear rate and diameters, so none may be given.")
        trajectory = read_trajectory(path)
        tracks = tracks_of_states(trajectory.strain, trajectory.state, float(trajectory.shear_rate))
        return with_stride(tracks, stride, name)
    try:
        table = reader(path)
    except InputError as reason:
        raise InputError(f"{name} does not contain tracks of discs: {reason}.") from None
    except OSError:
        raise
    except Exception as error:  # a damaged file may raise any exception in the library that reads it
        reason = short_repr(str(error)).strip("'\"").rstrip(".")
        raise InputError(f"{name} cannot be read: {reason}.") from None
    return with_stride(tracks_of_table(table, observation, name), stride, name)


def _csv_table(path: Path) -> Table:
    import pandas as pd

    separators = ((",", "."), (";", "."), (";", ","), (r"\s+", "."))  # with the decimal mark
    rows = pd.DataFrame()
    try:
        if "\0" in path.read_text(encoding="utf-8"):
            raise InputError("it is not UTF-8 text")
        for separator, decimal in separators:
            rows = pd.read_csv(path, sep=separator, decimal=decimal, comment="#", skipinitialspace=True)
            if len(rows.columns) > 1 and not (separator == ";" and rows.select_dtypes(exclude="number").columns.size):
                break
    except UnicodeError:
        raise InputError("it is not UTF-8 text") from None
    return Table(_named({str(name): column.to_numpy() for name, column in rows.items()}))


def _hdf5_table(path: Path) -> Table:
    import h5py

    try:
        with h5py.File(path, "r") as file:
            return Table(_named(_columns_of(file)))
    except OSError as error:
        raise InputError(f"HDF5 cannot read it, {str(error).rstrip('.')}") from None


def _columns_of(group: Any) -> dict[str, np.ndarray]:
    """The columns of a group: its datasets, the fields of its only dataset, or those of its only subgroup."""
    import h5py

    arrays = {name: entry for name, entry in group.items() if isinstance(entry, h5py.Dataset)}
    inner = [entry for name, entry in group.items() if isinstance(entry, h5py.Group) and not name.startswith("_i_")]
    names = set(arrays)
    if len(arrays) == 1 and next(iter(arrays.values())).dtype.names:
        rows = next(iter(arrays.values()))[()]
        names = set(rows.dtype.names)
        if "values_block_0" not in names:
            return {name: rows[name] for name in rows.dtype.names}
    if not arrays and len(inner) == 1:
        return _columns_of(inner[0])
    if "values_block_0" in names or "block0_values" in names:
        raise InputError(
            'pandas stored it without column names: write it with to_hdf(…, format="table", data_columns=True)'
        )
    return {name: np.asarray(entry[()]) for name, entry in arrays.items()}


def _lammps_table(path: Path) -> Table:
    from pymatgen.io.lammps.outputs import parse_lammps_dumps

    parts, cells = [], []
    try:
        dumps = list(parse_lammps_dumps(glob.escape(str(path))))
    except (ValueError, LookupError, AttributeError, TypeError):  # the parser checks nothing itself
        raise InputError("it is not a text dump as written by dump custom without dump_modify units or time") from None
    for dump in dumps:
        if len(dump.data) != dump.natoms or dump.natoms == 0 or dump.data.iloc[-1].isna().any():
            raise InputError(f"time step {dump.timestep} is incomplete or empty")
        columns = {str(name): column.to_numpy() for name, column in dump.data.items()}
        bounds, tilt = np.asarray(dump.box.bounds, float), dump.box.tilt
        (left, right), (low, high) = bounds[:2]
        offset = 0.0 if tilt is None else float(tilt[0])
        kind = next((kind for kind in ("x", "xu", "xs", "xsu") if kind in columns), "x")
        if kind != "x" and kind.replace("x", "y") in columns:
            x, y = columns[kind], columns[kind.replace("x", "y")]
            if "s" in kind:
                x, y = left + (right - left) * x + offset * y, low + (high - low) * y
            rows = np.floor((y - low) / (high - low))  # the velocity is that of the image inside the cell
            columns |= {"x": x - rows * offset, "y": y - rows * (high - low)}
        parts.append(_named({**columns, "frame": np.full(len(dump.data), dump.timestep)}))
        cells.append((right - left, high - low, offset))
    steps = [part["frame"][0] for part in parts]
    if len(set(steps)) < len(steps):
        raise InputError("two frames have the same time step")
    names = set(parts[0]).intersection(*parts)
    order = np.argsort(steps)
    return Table({name: np.concatenate([part[name] for part in parts]) for name in names}, np.array(cells)[order])


def _gsd_table(path: Path) -> Table:
    import gsd.hoomd

    parts, cells, times = [], [], []
    opened: Any = gsd.hoomd.open(path, "r")
    with opened as file:
        if len(file) == 0:
            raise InputError("it has no frames")
        for frame in file:
            grains, box, step = frame.particles, np.asarray(frame.configuration.box, float), frame.configuration.step
            if grains.N == 0 or grains.N != file[0].particles.N:
                raise InputError(
                    f"the number of discs changes from {file[0].particles.N} to {grains.N} in frame {len(parts)}, "
                    "and a GSD file has no ids: write a table with a column id"
                )
            columns = {
                **dict(zip("xyz", np.asarray(grains.position, float).T, strict=True)),
                **dict(zip(("vx", "vy"), np.asarray(grains.velocity, float).T[:2], strict=True)),
                **{name: np.asarray(getattr(grains, name), float) for name in ("diameter", "mass")},
                "frame": np.full(grains.N, float(step)),
                "id": np.arange(grains.N, dtype=float),
            }
            if not file.file.chunk_exists(0, "particles/mass"):
                del columns["mass"]  # absent: the library returns ones
            parts.append(_named(columns))
            cells.append((box[0], box[1], box[3] * box[1]))
            times.append(_recorded_time(frame.log))
    steps = np.array([part["frame"][0] for part in parts])
    if np.all(np.diff(times) > 0):
        parts = [{**part, "time": np.full_like(part["frame"], time)} for part, time in zip(parts, times, strict=True)]
    elif np.any(np.diff(steps) <= 0):  # the program did not store step numbers
        parts = [{**part, "frame": np.full_like(part["frame"], k)} for k, part in enumerate(parts)]
    cells = np.array(cells)
    if not np.all(np.isfinite(cells)) or not np.all(cells[:, :2] > 0):
        raise InputError("its box has no finite width and height")
    return Table({name: np.concatenate([part[name] for part in parts]) for name in parts[0]}, cells)


def _recorded_time(log: Mapping[str, np.ndarray]) -> float:
    """The time of a frame by its recorded strain, in units of 1/γ̇ without a shear rate; NaN if there is none."""
    strain, rate = (np.ravel(log.get(f"jaxgran/{name}", x)) for name, x in (("strain", np.nan), ("shear_rate", 1.0)))
    return float(strain[0] / rate[0]) if strain.size and rate.size and rate[0] > 0 else np.nan


def _of_jaxgran(path: Path) -> bool:
    """Whether jaxgran wrote a GSD file, with the exact states and the parameters of its flow."""
    import gsd.fl

    try:
        with gsd.fl.open(str(path), "r") as file:
            names = ("jaxgran/strain", "jaxgran/shear_rate", "particles/exact_velocity")
            return file.nframes > 0 and all(file.chunk_exists(0, f"log/{name}") for name in names)
    except Exception:  # damaged, which the reader will report
        return False


def recorded_restitution(path: str | os.PathLike) -> float | None:
    """The restitution stored in a GSD file of jaxgran; None if there is none."""
    if not str(path).endswith(".gsd") or not _of_jaxgran(Path(path)):
        return None
    restitution = float(read_trajectory(path).restitution)
    return None if math.isnan(restitution) else restitution


def _named(columns: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The columns by canonical name; an InputError with a reason if a required one is missing or not numeric."""
    given = {re.split(r"[\[(]", name)[0].strip().lower(): column for name, column in columns.items()}  # x [mm]
    numbers = {}
    for name, aliases in _NAMES.items():
        alias = next((alias for alias in aliases if alias in given), None)
        if alias is not None:
            numbers[name] = _numbers(name, np.asarray(given[alias]))
    for name in ("id", "x", "y"):
        if name not in numbers:
            others = ", ".join(alias for alias in _NAMES[name] if alias != name)
            raise InputError(f"there is no column {name} (or {others}) among {', '.join(given)[:100] or 'none'}")
    if "frame" not in numbers and "time" not in numbers:
        raise InputError(f"there is no column frame or time among {', '.join(given)[:100]}")
    if len({len(column) for column in numbers.values()}) > 1:
        raise InputError("its columns differ in length")
    if len(numbers["id"]) == 0:
        raise InputError("it has no rows")
    if "radius" in numbers:
        numbers["diameter"] = 2 * numbers.pop("radius")
    if "z" in numbers:
        z = numbers.pop("z")
        z, scale = z[np.isfinite(z)], np.median(numbers.get("diameter", np.ones(1)))
        if len(z) and not np.ptp(z) <= _FLAT * scale:
            raise InputError("it has three dimensions: z differs between discs")
    return numbers


def _numbers(name: str, column: np.ndarray) -> np.ndarray:
    import pandas as pd

    try:
        numbers = np.asarray(column, float)
    except (TypeError, ValueError):
        entries = [x.decode(errors="replace") if isinstance(x, bytes) else str(x) for x in column.ravel()]
        numeric: Any = pd.to_numeric(pd.Series(entries), errors="coerce")
        bad = np.array(entries)[np.isnan(np.asarray(numeric, float))]
        raise InputError(f"the column {name} has {short_repr(str(bad[0])[:30])}, which is not a number") from None
    if numbers.ndim != 1:
        raise InputError(f"the column {name} is not one-dimensional")
    return numbers


_READERS: dict[str, Callable[[Path], Table]] = {
    **dict.fromkeys((".csv", ".tsv", ".txt"), _csv_table),
    **dict.fromkeys((".h5", ".hdf5"), _hdf5_table),
    **dict.fromkeys((".lammpstrj", ".dump"), _lammps_table),
    ".gsd": _gsd_table,
}
