"""Checkpoint: a folder beside the output that holds what is done of a map until the map is finished.

==================  ================================================================================================
file                content
==================  ================================================================================================
``map.nc``          every parameter of the map, and the versions and precision that decide its bits
``done-*.nc``       the replicas of a finished batch
``journal-*.nc``    a batch that is under way, see ``journal``
``lock``            held by the process that writes here, and free as soon as that process has ended, however it did
==================  ================================================================================================

Every file carries a checksum. A damaged one is dropped, and what it held is computed anew. The names of the batches
tell the map and the replicas, so that what another map has left behind is never taken for a part of this one.
"""

import glob
import hashlib
import json
import os
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path

import jax
import numpy as np

from jaxgran.dynamics.tally import flat_tally, tally_from_flat
from jaxgran.io.atomic import Damaged, read_arrays, write_arrays
from jaxgran.maps.dataset import Key, Replica
from jaxgran.maps.settings import MapSettings
from jaxgran.model.checks import InputError
from jaxgran.sampling.sample import Sample

try:
    import fcntl
except ImportError:  # where there are no such locks, two runs on one output are not told apart
    fcntl = None

_VERSIONS = ("jaxgran", "jax", "jaxlib", "numba", "numpy")


class Checkpoint:
    """What is done of a map, in memory and on disc.

    Args:
      output: the dataset that the map will be written to; the folder stands beside it.
      settings: the map.
      resume: whether to continue what an earlier run has left.

    Raises:
      ValueError: another process writes to this output, or an unfinished map is there and ``resume`` is False or its
        parameters or versions are others; the sentence names the difference.
    """

    def __init__(self, output: Path, settings: MapSettings, resume: bool):
        self.folder = output.with_name(f"{output.name}.unfinished")
        self.settings, self._output = settings, output
        self.done: dict[Key, Replica] = {}
        self.damaged: list[str] = []
        self._identity = _identity(settings)
        self._lock = _locked(self.folder, output)
        try:
            self._tidy()
            unfinished = (self.folder / "map.nc").exists() and self._batches()
            if unfinished and not resume:
                raise InputError(
                    f"there is an unfinished map in {str(self.folder)!r}: "
                    "continue it with --resume, or remove the folder."
                )
            if unfinished:
                self._require_same()
                self._read()
            else:
                for path in self._batches():  # of a map that is finished: only half of its folder was removed
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
        except FileNotFoundError:  # somebody has removed the folder: all that is known is written again
            self._unlock()
            self._lock = _locked(self.folder, self._output)
            self._write_settings()
            self._write(self.done)
        self.journal_path(list(replicas)).unlink(missing_ok=True)

    def journal_path(self, keys: Sequence[Key]) -> Path:
        """Where the journal of a batch belongs."""
        return self.folder / f"journal-{self._name(keys)}.nc"

    def journals(self) -> list[list[Key]]:
        """The batches that were under way, as far as they can be continued."""
        found: list[list[Key]] = []
        for path in sorted(self.folder.glob("journal-*.nc")):
            arrays = self._arrays(path)
            if arrays is None:
                continue
            keys = [(point, seed) for point, seed in arrays["keys"].tolist()]
            known = {*self.done, *(key for batch in found for key in batch)}
            if known & set(keys) or path != self.journal_path(
                keys
            ):  # finished in the moment before the end, or foreign
                path.unlink(missing_ok=True)
            else:
                found.append(keys)
        return found

    def close(self, finished: bool) -> None:
        """Give the lock back; a finished map needs its checkpoint no more, nor does one that had hardly begun."""
        if (finished or not self._batches()) and _is_at(self._lock, self.folder):
            try:  # it vanishes in one moment, so that whoever comes next finds all of it or nothing
                os.replace(self.folder, self._rubbish)
            except OSError:
                shutil.rmtree(self.folder, ignore_errors=True)
            shutil.rmtree(self._rubbish, ignore_errors=True)
        self._unlock()

    @property
    def _rubbish(self) -> Path:
        return self.folder.with_name(f".{self.folder.name}")

    def _tidy(self) -> None:
        """Remove what a process has left that was killed while it wrote or removed something."""
        shutil.rmtree(self._rubbish, ignore_errors=True)
        unique = "[0-9a-f]" * 16
        beside = self._output.parent.glob(f".{glob.escape(self._output.stem)}-{unique}{self._output.suffix}")
        for path in [*beside, *self.folder.glob(f".*-{unique}.nc")]:
            path.unlink(missing_ok=True)

    def _batches(self) -> list[Path]:
        return [path for kind in ("done", "journal") for path in self.folder.glob(f"{kind}-*.nc")]

    def _unlock(self) -> None:
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    def _name(self, keys: Sequence[Key]) -> str:
        """A name that no other batch has, of this map or another."""
        text = json.dumps([self._identity, sorted(keys)], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    def _write(self, replicas: Mapping[Key, Replica]) -> None:
        keys = [(*key, replica.status) for key, replica in replicas.items()]
        samples = [replica.sample for replica in replicas.values()]
        tallies = np.stack([flat_tally(sample.tally, np.shape(sample.tally.steps)) for sample in samples])
        numbers = [(r.strain, r.sample.area, r.sample.shear_rate) for r in replicas.values()]
        arrays = {"keys": np.array(keys, np.int64), "tallies": tallies, "numbers": np.array(numbers, np.float64)}
        write_arrays(self.folder / f"done-{self._name(list(replicas))}.nc", arrays, {})

    def _read(self) -> None:
        dtype = np.dtype(_precision())
        for path in sorted(self.folder.glob("done-*.nc")):
            arrays = self._arrays(path)
            if arrays is None:
                continue
            if path.name != f"done-{self._name([(point, seed) for point, seed, _ in arrays['keys'].tolist()])}.nc":
                path.unlink(missing_ok=True)
                continue
            for row, tally, numbers in zip(arrays["keys"], arrays["tallies"], arrays["numbers"], strict=True):
                point, seed, status = row.tolist()
                strain, area, shear_rate = numbers
                tallies = tally_from_flat(tally, dtype)
                sample = Sample(tallies, dtype.type(area), dtype.type(shear_rate), self.settings.grains)
                self.done[point, seed] = Replica(sample, status, float(strain))

    def _arrays(self, path: Path) -> dict[str, np.ndarray] | None:
        """The content of a file; a damaged one is dropped and remembered."""
        try:
            return read_arrays(path)[0]
        except Damaged:
            self.damaged.append(path.name)
            path.unlink(missing_ok=True)
            return None

    def _write_settings(self) -> None:
        write_arrays(self.folder / "map.nc", {}, self._identity)

    def _require_same(self) -> None:
        """Raise a ValueError that names the first difference between this map and the unfinished one."""
        try:
            _, theirs = read_arrays(self.folder / "map.nc")
        except Damaged:
            if not self._has_ours():
                raise InputError(f"the file map.nc in {str(self.folder)!r} is damaged: remove the folder.") from None
            self.damaged.append("map.nc")
            self._write_settings()
            return
        for name, value in self._identity.items():
            if theirs.get(name) != value:
                raise InputError(
                    f"the unfinished map in {str(self.folder)!r} has {name} {theirs.get(name)!r} and not {value!r}: "
                    "repeat it as it was begun, or remove the folder."
                )

    def _has_ours(self) -> bool:
        """Whether the name of a batch tells that it is one of this map."""
        for path in self._batches():
            try:
                keys = [(row[0], row[1]) for row in read_arrays(path)[0]["keys"].tolist()]
            except Damaged:
                continue
            if path.stem.endswith(f"-{self._name(keys)}"):
                return True
        return False


def _identity(settings: MapSettings) -> dict[str, object]:
    """What decides the bits of the results, as JSON has it."""
    versions = {f"version of {name}": version(name) for name in _VERSIONS}
    identity = {**asdict(settings), **versions, "precision": _precision(), "device": jax.default_backend()}
    return json.loads(json.dumps(identity, default=lambda number: number.item()))


def _precision() -> str:
    return "float64" if jax.config.read("jax_enable_x64") else "float32"


def _locked(folder: Path, output: Path) -> int | None:
    """A lock in a folder that is made if need be, which ends with this process; ValueError where another one holds it.

    Where the file system knows no locks, two runs on one output are not told apart.
    """
    while True:
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except FileExistsError:
            raise InputError(
                f"output needs the folder {str(folder)!r}, and there is a file of this name: rename it."
            ) from None
        if fcntl is None:
            return None
        try:
            handle = os.open(folder / "lock", os.O_RDWR | os.O_CREAT, 0o644)
        except FileNotFoundError:  # whoever was here has finished in this moment and removed the folder
            continue
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(handle)
            raise InputError(
                f"another process is writing {str(output)!r}: wait for it, or give another output."
            ) from None
        except OSError:
            return handle
        if _is_at(handle, folder):
            return handle
        os.close(handle)  # as above


def _is_at(lock: int | None, folder: Path) -> bool:
    """Whether the lock is still that of the folder."""
    try:
        return lock is None or os.path.samestat(os.fstat(lock), (folder / "lock").stat())
    except OSError:
        return False
