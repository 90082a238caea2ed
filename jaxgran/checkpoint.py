"""Checkpoint: a folder beside the output that holds what is done of a map until the map is finished.

==================  ================================================================================================
file                content
==================  ================================================================================================
``map.nc``          every parameter of the map, and the versions and precision that decide its bits
``done-*.nc``       the replicas of a finished batch
``journal-*.nc``    a batch that is under way, see ``journal``
``lock``            held by the process that writes here, and free as soon as that process has ended, however it did
==================  ================================================================================================

Every file carries a checksum. A damaged one is dropped, and what it held is computed anew.
"""

import hashlib
import json
import os
import shutil
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path

import jax
import numpy as np

from jaxgran.dataset import Key, Replica
from jaxgran.flow import InputError
from jaxgran.measure import Sample
from jaxgran.settings import MapSettings
from jaxgran.store import Damaged, read_arrays, write_arrays
from jaxgran.tally import flat_tally, tally_from_flat

try:
    import fcntl
except ImportError:  # where there are no such locks, two runs on one output are not told apart
    fcntl = None

_VERSIONS = ("jaxgran", "jax", "jaxlib", "numpy")


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
        self.settings = settings
        self.done: dict[Key, Replica] = {}
        self.damaged: list[str] = []
        self.folder.mkdir(exist_ok=True)
        self._lock = _locked(self.folder / "lock", output)
        unfinished = (self.folder / "map.nc").exists()
        try:
            if unfinished and not resume:
                raise InputError(
                    f"there is an unfinished map in {str(self.folder)!r}: "
                    "continue it with --resume, or remove the folder."
                )
            if unfinished:
                self._require_same()
                self._read()
            else:
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
            self.folder.mkdir(parents=True, exist_ok=True)
            self._write_settings()
            self._write(self.done)
        self.journal_path(list(replicas)).unlink(missing_ok=True)

    def journal_path(self, keys: Sequence[Key]) -> Path:
        """Where the journal of a batch belongs."""
        return self.folder / f"journal-{_name(keys)}.nc"

    def journals(self) -> list[list[Key]]:
        """The batches that were under way, as far as they can be continued."""
        found = []
        for path in sorted(self.folder.glob("journal-*.nc")):
            arrays = self._arrays(path)
            if arrays is None:
                continue
            keys = [(point, seed) for point, seed in arrays["keys"].tolist()]
            if self.done.keys() & set(keys):  # it was finished in the moment before the end
                path.unlink(missing_ok=True)
            else:
                found.append(keys)
        return found

    def close(self, finished: bool) -> None:
        """Give the lock back; a finished map needs its checkpoint no more, nor does one that had hardly begun."""
        if finished or not any(self.folder.glob("[dj]o*.nc")):
            shutil.rmtree(self.folder, ignore_errors=True)
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    def _write(self, replicas: Mapping[Key, Replica]) -> None:
        keys = [(*key, replica.status) for key, replica in replicas.items()]
        samples = [replica.sample for replica in replicas.values()]
        tallies = np.stack([flat_tally(sample.tally, np.shape(sample.tally.steps)) for sample in samples])
        numbers = [(r.strain, r.sample.area, r.sample.shear_rate) for r in replicas.values()]
        arrays = {"keys": np.array(keys, np.int64), "tallies": tallies, "numbers": np.array(numbers, np.float64)}
        write_arrays(self.folder / f"done-{_name(list(replicas))}.nc", arrays, {})

    def _read(self) -> None:
        dtype = np.dtype(_precision())
        for path in sorted(self.folder.glob("done-*.nc")):
            arrays = self._arrays(path)
            if arrays is None:
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
        write_arrays(self.folder / "map.nc", {}, _identity(self.settings))

    def _require_same(self) -> None:
        """Raise a ValueError that names the first difference between this map and the unfinished one."""
        try:
            _, theirs = read_arrays(self.folder / "map.nc")
        except Damaged:
            raise InputError(f"the file map.nc in {str(self.folder)!r} is damaged: remove the folder.") from None
        for name, value in json.loads(json.dumps(_identity(self.settings))).items():
            if theirs.get(name) != value:
                raise InputError(
                    f"the unfinished map in {str(self.folder)!r} has {name} {theirs.get(name)!r} and not {value!r}: "
                    "repeat it as it was begun, or remove the folder."
                )


def _identity(settings: MapSettings) -> dict[str, object]:
    """What decides the bits of the results."""
    versions = {f"version of {name}": version(name) for name in _VERSIONS}
    return {**asdict(settings), **versions, "precision": _precision(), "device": jax.default_backend()}


def _precision() -> str:
    return "float64" if jax.config.read("jax_enable_x64") else "float32"


def _name(keys: Iterable[Key]) -> str:
    """A name for a batch that no other has."""
    return hashlib.sha256(repr(sorted(keys)).encode()).hexdigest()[:16]


def _locked(path: Path, output: Path) -> int | None:
    """A lock that ends with this process, or a ValueError where another one holds it."""
    if fcntl is None:
        return None
    while True:
        handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.close(handle)
            raise InputError(
                f"another process is writing {str(output)!r}: wait for it, or give another output."
            ) from None
        if path.exists() and os.fstat(handle).st_ino == path.stat().st_ino:
            return handle
        os.close(handle)  # whoever held it has finished in this moment and removed it
        path.parent.mkdir(exist_ok=True)
