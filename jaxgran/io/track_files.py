"""Files of tracked discs: tables (CSV, HDF5), dumps of LAMMPS, and GSD files of any program.

=====================================  ===============================================================================
file                                   what it must hold
=====================================  ===============================================================================
``.csv``, ``.txt``, ``.tsv``           a header with the names below, and a row for each disc in each frame
``.h5``, ``.hdf5``                     the same columns as datasets of one group, or as one dataset with named fields
``.lammpstrj``, ``.dump``              a text dump of LAMMPS: id, positions (x, xu, xs or xsu), radius or diameter
``.gsd``                               positions in a box; z = 0 in all frames
=====================================  ===============================================================================

Columns, in any order and in small or capital letters: ``frame`` (or ``time``), ``id`` (or ``particle``), ``x``, ``y``,
``diameter`` or ``radius``; ``vx`` and ``vy`` and ``mass`` if they are known. A unit in brackets may follow a name.
"""

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
    every_frame,
    require_observation,
    tracks_of_states,
    tracks_of_table,
)
from jaxgran.io.trajectory import read_trajectory
from jaxgran.model.checks import InputError, require_whole, short_repr

_NAMES = {
    "frame": ("frame", "step", "timestep"),
    "time": ("time", "t"),
    "id": ("particle", "track_id", "track", "id", "label"),  # where a tracker numbers what it found too, that is "id"
    "x": ("x", "position_x"),
    "y": ("y", "position_y"),
    "z": ("z",),
    "vx": ("vx",),
    "vy": ("vy",),
    "diameter": ("diameter", "d"),
    "radius": ("radius",),
    "mass": ("mass",),
}
_FLAT = 1e-3  # of a diameter, by which z may differ from disc to disc


def read_tracks(
    path: str | os.PathLike,
    *,
    interval: float | None = None,
    shear_rate: float | None = None,
    peculiar: bool = False,
    diameter: float | None = None,
    every: int = 1,
) -> Tracks:
    """The tracks of discs in a file of another program, or of a camera.

    Args:
      path: a table (``.csv``, ``.tsv``, ``.txt``, ``.h5``, ``.hdf5``), a dump of LAMMPS (``.lammpstrj``, ``.dump``) or
        a GSD file. The columns of a table are frame or time, id, x, y, diameter or radius, and vx, vy, mass if known.
      interval: time between frames, or between frames whose numbers differ by the smallest difference that there is;
        without it the time follows from velocities and displacements, or is 1 where there are no velocities.
      shear_rate: γ̇ of a sheared periodic cell; without it, the rate at which the cell of the file tilts.
      peculiar: whether the velocities are relative to the shear, γ̇ y x̂ being left out.
      diameter: of all discs, where the file has none.
      every: 3 to use each third frame only, and so on.

    Returns:
      What ``fit_restitution`` needs. A GSD file of jaxgran says all of this itself.

    Raises:
      InputError: (a ValueError) there is no such file, or it does not hold such tracks; the message says why.
    """
    if not isinstance(path, (str, os.PathLike)):
        raise InputError(f"path must be a file name, not {short_repr(path)}.")
    said = Observation(interval, shear_rate, peculiar, diameter)
    require_observation(said)
    require_whole("every", every, 1, 10**9, "as files have fewer frames")
    path = Path(os.fspath(path))
    name, reader = short_repr(path.name), _READERS.get(path.suffix.lower())
    if reader is None:
        raise InputError(f"tracks must be a file that ends in {', '.join(_READERS)}, not {name}.")
    if not path.is_file():
        raise InputError(f"there is no file {short_repr(str(path))}.")
    if reader is _gsd_table and _of_jaxgran(path):
        if said != Observation():
            raise InputError(f"{name} says its time, shear rate and diameters itself, so none is to be given.")
        trajectory = read_trajectory(path)
        tracks = tracks_of_states(trajectory.strain, trajectory.state, float(trajectory.shear_rate))
        return every_frame(tracks, every, name)
    try:
        table = reader(path)
    except InputError as lack:
        raise InputError(f"{name} does not hold tracks of discs: {lack}.") from None
    except OSError:
        raise
    except Exception as error:  # a damaged file may raise any exception in the library that reads it
        why = short_repr(str(error)).strip("'\"").rstrip(".")
        raise InputError(f"{name} cannot be read: {why}.") from None
    return every_frame(tracks_of_table(table, said, name), every, name)


def _csv_table(path: Path) -> Table:
    import pandas as pd

    forms = ((",", "."), (r"\s+", "."), (";", "."), (";", ","))  # the last of spreadsheets with a decimal comma
    rows = pd.DataFrame()
    try:
        if "\0" in path.read_text(encoding="utf-8"):
            raise InputError("it is not text in UTF-8")
        for separator, decimal in forms:
            rows = pd.read_csv(path, sep=separator, decimal=decimal, comment="#", skipinitialspace=True)
            if len(rows.columns) > 1 and not (separator == ";" and rows.select_dtypes(exclude="number").columns.size):
                break
    except UnicodeError:
        raise InputError("it is not text in UTF-8") from None
    return Table(_named({str(name): column.to_numpy() for name, column in rows.items()}))


def _hdf5_table(path: Path) -> Table:
    import h5py

    try:
        with h5py.File(path, "r") as file:
            return Table(_named(_columns_of(file)))
    except OSError as error:
        raise InputError(f"it is not an HDF5 file that can be read, {str(error).rstrip('.')}") from None


def _columns_of(group: Any) -> dict[str, np.ndarray]:
    """The columns in a group: its datasets, the fields of its only dataset, or what its only group holds."""
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
            'it is a table of pandas without names: write it by to_hdf(…, format="table", data_columns=True)'
        )
    return {name: np.asarray(entry[()]) for name, entry in arrays.items()}


def _lammps_table(path: Path) -> Table:
    try:
        from pymatgen.io.lammps.outputs import parse_lammps_dumps
    except ImportError:
        raise InputError("pymatgen must be installed to read a dump of LAMMPS, by pip install pymatgen") from None
    parts, cells = [], []
    try:
        dumps = list(parse_lammps_dumps(_escaped(path)))
    except (ValueError, LookupError, AttributeError, TypeError):  # whichever line it is that the library cannot take
        raise InputError(
            "it is not a text dump of LAMMPS, as dump custom writes it without dump_modify units or time"
        ) from None
    for dump in dumps:
        if len(dump.data) != dump.natoms or dump.natoms == 0 or dump.data.iloc[-1].isna().any():
            raise InputError(f"in time step {dump.timestep} the discs are not as many as it says, or there are none")
        columns = {str(name): column.to_numpy() for name, column in dump.data.items()}
        bounds, tilt = np.asarray(dump.box.bounds, float), dump.box.tilt
        (left, right), (low, high) = bounds[:2]
        offset = 0.0 if tilt is None else float(tilt[0])
        kind = next((kind for kind in ("x", "xu", "xs", "xsu") if kind in columns), "x")
        if kind != "x" and kind.replace("x", "y") in columns:
            x, y = columns[kind], columns[kind.replace("x", "y")]
            if "s" in kind:
                x, y = left + (right - left) * x + offset * y, low + (high - low) * y
            rows = np.floor((y - low) / (high - low))  # the velocity is that of the image in the cell
            columns |= {"x": x - rows * offset, "y": y - rows * (high - low)}
        parts.append(_named({**columns, "frame": np.full(len(dump.data), dump.timestep)}))
        cells.append((right - left, high - low, offset))
    steps = [part["frame"][0] for part in parts]
    if len(set(steps)) < len(steps):
        raise InputError("two frames have the same time step")
    names = set(parts[0]).intersection(*parts)
    order = np.argsort(steps)
    return Table({name: np.concatenate([part[name] for part in parts]) for name in names}, np.array(cells)[order])


def _escaped(path: Path) -> str:
    import glob

    return glob.escape(str(path))


def _gsd_table(path: Path) -> Table:
    import gsd.hoomd

    parts, cells = [], []
    opened: Any = gsd.hoomd.open(path, "r")
    with opened as file:
        if len(file) == 0:
            raise InputError("it has no frames")
        for frame in file:
            grains, box, step = frame.particles, np.asarray(frame.configuration.box, float), frame.configuration.step
            if grains.N == 0 or grains.N != file[0].particles.N:
                raise InputError("its frames do not have one number of discs, so the discs cannot be told apart")
            columns = {
                **dict(zip("xyz", np.asarray(grains.position, float).T, strict=True)),
                **dict(zip(("vx", "vy"), np.asarray(grains.velocity, float).T[:2], strict=True)),
                **{name: np.asarray(getattr(grains, name), float) for name in ("diameter", "mass")},
                "frame": np.full(grains.N, float(step)),
                "id": np.arange(grains.N, dtype=float),
            }
            if not file.file.chunk_exists(0, "particles/mass"):
                del columns["mass"]  # the library then says one
            parts.append(_named(columns))
            cells.append((box[0], box[1], box[3] * box[1]))
    steps = np.array([part["frame"][0] for part in parts])
    if np.any(np.diff(steps) <= 0):  # a program that does not count its steps
        for k, part in enumerate(parts):
            part["frame"][:] = k
    cells = np.array(cells)
    if not np.all(np.isfinite(cells)) or not np.all(cells[:, :2] > 0):
        raise InputError("its box has no width and height")
    return Table({name: np.concatenate([part[name] for part in parts]) for name in parts[0]}, cells)


def _of_jaxgran(path: Path) -> bool:
    """Whether a GSD file has the parameters of its flow."""
    import gsd.fl

    try:
        with gsd.fl.open(str(path), "r") as file:
            return file.nframes > 0 and file.chunk_exists(0, "log/jaxgran/strain")
    except Exception:  # of a damaged file: the reader will say so
        return False


def recorded_restitution(path: str | os.PathLike) -> float | None:
    """The restitution that a GSD file of jaxgran was made with; None of another file."""
    of_jaxgran = str(path).endswith(".gsd") and _of_jaxgran(Path(path))
    return float(read_trajectory(path).restitution) if of_jaxgran else None


def _named(columns: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The columns by our names; an InputError in a few words where one that is needed is missing or has no numbers."""
    by_name = {re.split(r"[\[(]", name)[0].strip().lower(): column for name, column in columns.items()}  # x [mm]
    found = {}
    for name, others in _NAMES.items():
        given = next((by_name[other] for other in others if other in by_name), None)
        if given is not None:
            found[name] = _numbers(name, np.asarray(given))
    for name in ("id", "x", "y"):
        if name not in found:
            others = ", ".join(other for other in _NAMES[name] if other != name)
            raise InputError(f"there is no column {name} (or {others}) among {', '.join(by_name)[:100] or 'none'}")
    if "frame" not in found and "time" not in found:
        raise InputError(f"there is no column frame or time among {', '.join(by_name)[:100]}")
    if len({len(column) for column in found.values()}) > 1:
        raise InputError("its columns do not have one length")
    if len(found["id"]) == 0:
        raise InputError("it has no rows")
    radius = found.pop("radius", None)
    if radius is not None:
        found["diameter"] = 2 * radius
    height = found.pop("z", None)
    if height is not None:
        scale, known = np.median(found.get("diameter", np.ones(1))), height[np.isfinite(height)]
        if len(known) and not known.max() - known.min() <= _FLAT * scale:
            raise InputError("it has three dimensions: z differs from disc to disc")
    return found


def _numbers(name: str, column: np.ndarray) -> np.ndarray:
    try:
        numbers = np.asarray(column, float)
    except (TypeError, ValueError):
        raise InputError(f"the column {name} has {_first_word(column)}, which is not a number") from None
    if numbers.ndim != 1:
        raise InputError(f"the column {name} is not a list of numbers")
    return numbers


def _first_word(column: np.ndarray) -> str:
    """The first entry that is not a number, for a sentence."""
    for entry in column.ravel():
        word = entry.decode(errors="replace") if isinstance(entry, bytes) else str(entry)
        try:
            float(word)
        except ValueError:
            return short_repr(word[:30])
    return "something"


_READERS: dict[str, Callable[[Path], Table]] = {
    **dict.fromkeys((".csv", ".tsv", ".txt"), _csv_table),
    **dict.fromkeys((".h5", ".hdf5"), _hdf5_table),
    **dict.fromkeys((".lammpstrj", ".dump"), _lammps_table),
    ".gsd": _gsd_table,
}
TRACK_ENDINGS = tuple(_READERS)
