"""Checkpoint: a folder beside the output with the finished part of a map, kept until the map is complete.

==================  ================================================================================================
file                content
==================  ================================================================================================
``map.nc``          all parameters of the map, and the versions and precision that its results depend on
``done-*.nc``       the replicas of a finished batch
``journal-*.nc``    a batch that is running, see ``journal``
``lock``            locked by the process that writes here; released when that process ends for any reason
==================  ================================================================================================

Every file has a checksum. A damaged file is removed, and its replicas are computed again. The file name of a batch is a
hash of the map and the replicas, so a file of another map is never taken for a part of this one.
"""

import glob
import hashlib
import json
import os
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import fields
from importlib.metadata import version
from pathlib import Path

import jax
import numpy as np

from jaxgran.contact.projected_methods import solver_name, solver_numbers
from jaxgran.dynamics.tally import TABLE, flat_tally, tally_from_flat
from jaxgran.io.atomic import CorruptFile, read_arrays, write_arrays
from jaxgran.maps.instants import as_arrays, from_arrays
from jaxgran.maps.own_observables import identity_of, sums_by_name
from jaxgran.maps.replica import Key, Replica
from jaxgran.maps.settings import MapSettings
from jaxgran.model.checks import InputError
from jaxgran.sampling.sample import Sample

try:
    import fcntl
except ImportError:  # a system without such locks: a second run on one output is not detected
    fcntl = None

_VERSIONS = ("jaxgran", "jax", "jaxlib", "numba", "numpy")


class Checkpoint:
    """The finished part of a map, in memory and on disc.

    Args:
      output: file of the map's dataset; the folder is beside it.
      settings: the map.
      resume: whether to continue the unfinished map of an earlier run.

    Raises:
      InputError: (a ValueError) another process writes to this output. Or there is an unfinished map, and ``resume`` is
        False or its parameters or versions differ; the message names the difference.
    """

    def __init__(self, output: Path, settings: MapSettings, resume: bool):
        self.folder = output.with_name(f"{output.name}.unfinished")
        self.settings, self._output = settings, output
        self.done: dict[Key, Replica] = {}
        self.damaged: list[str] = []
        self._identity = _identity(settings)
        self._lock = _locked(self.folder, output)
        try:
            self._remove_leftovers()
            unfinished = (self.folder / "map.nc").exists() and self._batches()
            if unfinished and not resume:
                raise InputError(
                    f"output {str(output)!r} has an unfinished map: pass `resume=True` to continue it, or remove the "
                    f"folder {str(self.folder)!r}.",
                    field="output",
                )
            if unfinished:
                self._require_same()
                self._read()
            else:
                for path in self._batches():  # of a finished map whose folder was removed only in part
                    path.unlink()
                self._write_settings()
        except BaseException:
            self.close(finished=False)
            raise

    def add(self, replicas: Mapping[Key, Replica]) -> None:
        """Keep the replicas of a finished batch."""
        self.done |= replicas
        try:
            self._write(replicas)
        except FileNotFoundError:  # the folder was removed by hand: all results are written again
            self._unlock()
            self._lock = _locked(self.folder, self._output)
            self._write_settings()
            self._write(self.done)
        self.journal_path(list(replicas)).unlink(missing_ok=True)

    def journal_path(self, keys: Sequence[Key]) -> Path:
        """The file for the journal of a batch."""
        return self.folder / f"journal-{self._name(keys)}.nc"

    def journals(self) -> list[list[Key]]:
        """The interrupted batches that can be continued from their journals."""
        found: list[list[Key]] = []
        for path in sorted(self.folder.glob("journal-*.nc")):
            arrays = self._arrays(path)
            if arrays is None:
                continue
            keys = [(point, seed) for point, seed in arrays["keys"].tolist()]
            known = {*self.done, *(key for batch in found for key in batch)}
            finished = bool(known & set(keys))  # its journal was about to be removed when the run ended
            foreign = path != self.journal_path(keys)
            if finished or foreign:
                path.unlink(missing_ok=True)
            else:
                found.append(keys)
        return found

    def close(self, finished: bool) -> None:
        """Release the lock, and remove the folder if the map is finished or has no batch yet."""
        if (finished or not self._batches()) and _is_lock_of(self.folder, self._lock):
            try:  # renamed in one operation, so that the next run finds the whole folder or none
                os.replace(self.folder, self._discarded)
            except OSError:
                shutil.rmtree(self.folder, ignore_errors=True)
            shutil.rmtree(self._discarded, ignore_errors=True)
        self._unlock()

    @property
    def _discarded(self) -> Path:
        """Name of the folder while it is being removed."""
        return self.folder.with_name(f".{self.folder.name}")

    def _remove_leftovers(self) -> None:
        """Remove temporary files of a process that was killed while it wrote or removed files."""
        shutil.rmtree(self._discarded, ignore_errors=True)
        unique = "[0-9a-f]" * 16
        beside = self._output.parent.glob(f".{glob.escape(self._output.stem)}-{unique}{self._output.suffix}")
        for path in [*beside, *self.folder.glob(f".*-{unique}.nc")]:
            path.unlink(missing_ok=True)

    def _batches(self) -> list[Path]:
        """Files of finished and of running batches."""
        return [path for kind in ("done", "journal") for path in self.folder.glob(f"{kind}-*.nc")]

    def _unlock(self) -> None:
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    def _name(self, keys: Sequence[Key]) -> str:
        """A name that is unique to a batch of a map: a hash of both."""
        text = json.dumps([self._identity, sorted(keys)], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    def _write(self, replicas: Mapping[Key, Replica]) -> None:
        keys = [(*key, replica.status) for key, replica in replicas.items()]
        samples = [replica.sample for replica in replicas.values()]
        tallies = np.stack([flat_tally(sample.tally, np.shape(sample.tally.steps)) for sample in samples])
        numbers = [(r.strain, r.sample.area, r.sample.shear_rate) for r in replicas.values()]
        arrays = {"keys": np.array(keys, np.int64), "tallies": tallies, "numbers": np.array(numbers, np.float64)}
        arrays |= as_arrays([replica.instant for replica in replicas.values()])
        write_arrays(self.folder / f"done-{self._name(list(replicas))}.nc", arrays, {})

    def _read(self) -> None:
        dtype, own_sums = np.dtype(_precision()), sums_by_name(self.settings)
        for path in sorted(self.folder.glob("done-*.nc")):
            arrays = self._arrays(path)
            if arrays is None:
                continue
            if path.name != f"done-{self._name([(point, seed) for point, seed, _ in arrays['keys'].tolist()])}.nc":
                path.unlink(missing_ok=True)
                continue
            columns = arrays["keys"], arrays["tallies"], arrays["numbers"], from_arrays(arrays)
            for row, tally, numbers, instant in zip(*columns, strict=True):
                point, seed, status = row.tolist()
                strain, area, shear_rate = numbers
                tallies = tally_from_flat(tally, dtype, own_sums)
                grains = self.settings.flows()[point].grains
                sample = Sample(tallies, dtype.type(area), dtype.type(shear_rate), grains)
                self.done[point, seed] = Replica(sample, status, float(strain), instant)

    def _arrays(self, path: Path) -> dict[str, np.ndarray] | None:
        """The content of a file; a damaged file is removed, its name noted, and the result is None."""
        try:
            return read_arrays(path)[0]
        except CorruptFile:
            self.damaged.append(path.name)
            path.unlink(missing_ok=True)
            return None

    def _write_settings(self) -> None:
        write_arrays(self.folder / "map.nc", {}, self._identity)

    def _require_same(self) -> None:
        """Raise an InputError with the first difference between this map and the unfinished one."""
        try:
            _, begun = read_arrays(self.folder / "map.nc")
        except CorruptFile:
            if not self._has_batch_of_this_map():
                raise InputError(f"the file map.nc in {str(self.folder)!r} is damaged: remove the folder.") from None
            self.damaged.append("map.nc")
            self._write_settings()
            return
        for name, value in self._identity.items():
            if begun.get(name) != value:
                raise InputError(
                    f"the unfinished map in {str(self.folder)!r} has {name} {begun.get(name)!r}, not {value!r}: "
                    "resume it with the same parameters, or remove the folder."
                )

    def _has_batch_of_this_map(self) -> bool:
        """Whether the name of a file shows that it is a batch of this map."""
        for path in self._batches():
            try:
                keys = [(row[0], row[1]) for row in read_arrays(path)[0]["keys"].tolist()]
            except CorruptFile:
                continue
            if path.stem.endswith(f"-{self._name(keys)}"):
                return True
        return False


def _identity(settings: MapSettings) -> dict[str, object]:
    """All that the results depend on, bit for bit, in types of JSON."""
    versions = {f"version of {name}": version(name) for name in _VERSIONS}
    here = {"precision": _precision(), "device": jax.default_backend(), "number of running sums": len(TABLE)}
    parameters = {field.name: getattr(settings, field.name) for field in fields(settings)}
    solver = f"{solver_name(settings.solver)} {json.dumps(solver_numbers(settings.solver))}"
    engine = "auto" if settings.engine is None else settings.engine.name
    identity = {**parameters, "solver": solver, "engine": engine, "observe": identity_of(settings), **versions, **here}
    return json.loads(json.dumps(identity, default=lambda number: number.item()))


def _precision() -> str:
    return "float64" if jax.config.read("jax_enable_x64") else "float32"


def _locked(folder: Path, output: Path) -> int | None:
    """Lock a folder, made if missing, until this process ends; InputError if another process has locked it.

    On a file system without locks, a second run on one output is not detected.
    """
    while True:
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except FileExistsError:
            raise InputError(
                f"output needs the folder {str(folder)!r}, and a file has this name: rename it.", field="output"
            ) from None
        if fcntl is None:
            return None
        try:
            handle = os.open(folder / "lock", os.O_RDWR | os.O_CREAT, 0o644)
        except FileNotFoundError:  # another process has just finished and removed the folder
            continue
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(handle)
            raise InputError(
                f"another process is writing {str(output)!r}: wait for it, or choose another `output`."
            ) from None
        except OSError:
            return handle
        if _is_lock_of(folder, handle):
            return handle
        os.close(handle)  # the lock of a removed folder: try again


def _is_lock_of(folder: Path, lock: int | None) -> bool:
    """Whether the lock is that of this folder, and not of one that was removed since."""
    try:
        return lock is None or os.path.samestat(os.fstat(lock), (folder / "lock").stat())
    except OSError:
        return False
