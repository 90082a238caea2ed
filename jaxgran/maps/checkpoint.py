"""Checkpoint: a folder beside the output with the finished part of a map, kept until the map is
complete.

==================  ================================================================================
file                content
==================  ================================================================================
``map.nc``          the finished replicas, all parameters of the map, and the versions that its
                    results depend on
``journal-*.nc``    a batch that is running, see ``journal``; the end of its name is a hash of the
                    parameters, versions and sources
``lock``            locked by the process that writes here; released when that process ends for any
                    reason
==================  ================================================================================

``map.nc`` is written again whenever a batch ends, but at most so often that this takes a twentieth
of the time; the journals of batches that it lacks stay. Every file has a checksum. A damaged
journal is removed, and its replicas are computed again.
"""

import glob
import os
import shutil
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxgran.dynamics.tally import TABLE, flat_tally, tally_from_flat
from jaxgran.environment import default_device, precision
from jaxgran.files import same_file
from jaxgran.io.atomic import CorruptFile, read_arrays, write_arrays
from jaxgran.maps.attributes import digest, first_difference, identity
from jaxgran.maps.own_observables import sums_by_name
from jaxgran.maps.provenance import made_with, versions_of
from jaxgran.maps.replica import Key, Replica
from jaxgran.maps.settings import MapSettings
from jaxgran.model.checks import InputError
from jaxgran.model.grains import Grains
from jaxgran.model.state import State
from jaxgran.sampling.sample import Sample

try:
    import fcntl
except ImportError:  # a system without such locks: a second run on one output is not detected
    fcntl = None

WRITING_SHARE = 0.05  # largest share of the time that is spent on writing


class Checkpoint:
    """The finished part of a map, in memory and on disc.

    Args:
      output: file of the map's dataset; the folder is beside it.
      settings: the map.
      resume: whether to continue the unfinished map of an earlier run.

    Raises:
      InputError: (a ValueError) another process writes to this output. Or there is an unfinished
        map, and ``resume`` is False or its parameters or versions differ; the message names the
        difference.
    """

    def __init__(self, output: Path, settings: MapSettings, resume: bool):
        self.folder = output.with_name(f"{output.name}.unfinished")
        self.settings, self._output = settings, output
        self.done: dict[Key, Replica] = {}
        self.damaged: list[str] = []
        self._identity = _identity(settings)
        self._name = digest(self._identity)
        self._ended: list[Path] = []  # journals of the batches that map.nc lacks
        self._next_write = 0.0
        self._lock = _locked(self.folder, output)
        try:
            self._remove_leftovers()
            self._begin(resume)
        except BaseException:
            self._unlock()
            raise

    def add(self, replicas: Mapping[Key, Replica]) -> None:
        """Keep the replicas of a finished batch."""
        self.done |= replicas
        self._ended.append(self.journal_path(list(replicas)))
        begun = time.monotonic()
        if begun >= self._next_write:
            self._write()
            ended = time.monotonic()
            self._next_write = ended + (ended - begun) / WRITING_SHARE

    def journal_path(self, keys: Sequence[Key]) -> Path:
        """The file for the journal of a batch, named after its first replica and all that its
        numbers depend on.

        So a worker of an earlier map that still writes here writes no file of this one.
        """
        point, seed = keys[0]
        return self.folder / f"journal-{point}-{seed}-{self._name}.nc"

    def journals(self) -> list[list[Key]]:
        """The interrupted batches that can be continued from their journals."""
        found: list[list[Key]] = []
        for path in self._journals():
            try:
                keys = [(point, seed) for point, seed in read_arrays(path)[0]["keys"].tolist()]
            except CorruptFile:
                self.damaged.append(path.name)
                path.unlink(missing_ok=True)
                continue
            if self.done.keys() & set(
                keys
            ):  # its journal was about to be removed when the run ended
                path.unlink(missing_ok=True)
            else:
                found.append(keys)
        return found

    def close(self, finished: bool) -> None:
        """Release the lock, and remove the folder if the map is finished or has not begun."""
        if not finished and self._ended:
            with suppress(OSError):  # the disc is full: the journals stay
                self._write()
        if (finished or not (self.done or self._journals())) and _is_lock_of(
            self.folder, self._lock
        ):
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
        beside = self._output.parent.glob(
            f".{glob.escape(self._output.stem)}-{unique}{self._output.suffix}"
        )
        for path in [*beside, *self.folder.glob(f".*-{unique}.nc")]:
            path.unlink(missing_ok=True)

    def _begin(self, resume: bool) -> None:
        """Read the unfinished map that is there, or write the parameters of a new one."""
        path = self.folder / "map.nc"
        if path.exists():
            try:
                arrays, begun = read_arrays(path)
            except CorruptFile:
                raise InputError(
                    f"the file map.nc in {str(self.folder)!r} is damaged: remove the folder."
                ) from None
            if len(arrays["keys"]) or any(self.folder.glob("journal-*.nc")):
                if not resume:
                    raise InputError(
                        f"output {str(self._output)!r} has an unfinished map: pass `resume=True` "
                        f"to continue it, or remove the folder {str(self.folder)!r}.",
                        field="output",
                    )
                self._require_same(begun)
                self.done = _replicas_of(arrays, self.settings)
                return
        for journal in self.folder.glob("journal-*.nc"):
            journal.unlink()
        self._write()

    def _journals(self) -> list[Path]:
        return sorted(self.folder.glob(f"journal-*-{self._name}.nc"))

    def _unlock(self) -> None:
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    def _write(self) -> None:
        path, arrays = self.folder / "map.nc", _arrays_of(self.done)
        try:
            write_arrays(path, arrays, self._identity)
        except FileNotFoundError:  # the folder was removed by hand
            self._unlock()
            self._lock = _locked(self.folder, self._output)
            write_arrays(path, arrays, self._identity)
        for journal in self._ended:
            journal.unlink(missing_ok=True)
        self._ended = []

    def _require_same(self, begun: Mapping[str, object]) -> None:
        """Raise an InputError with the first difference between this map and the unfinished one."""
        if difference := first_difference(self._identity, begun):
            name, here, there = difference
            raise InputError(
                f"the unfinished map in {str(self.folder)!r} has {name} {there!r}, not {here!r}: "
                "resume it with the same parameters, or remove the folder."
            )


def _arrays_of(replicas: Mapping[Key, Replica]) -> dict[str, np.ndarray]:
    """Replicas as arrays for a file, in which each state has arrays of its own."""
    tallies = [
        flat_tally(one.sample.tally, np.shape(one.sample.tally.steps)) for one in replicas.values()
    ]
    arrays = {
        "keys": np.array([(*key, one.status) for key, one in replicas.items()], np.int64).reshape(
            -1, 3
        ),
        "tallies": np.array(tallies),
        "numbers": np.array(
            [(one.strain, one.sample.area, one.sample.shear_rate) for one in replicas.values()],
            float,
        ),
    }
    for row, one in enumerate(replicas.values()):
        if one.state is not None:
            leaves = enumerate(jax.tree.leaves(one.state))
            arrays |= {f"state-{row}-{k}": np.asarray(x) for k, x in leaves}
    return arrays


def _replicas_of(arrays: Mapping[str, np.ndarray], settings: MapSettings) -> dict[Key, Replica]:
    """The replicas of ``_arrays_of``."""
    dtype, own_sums, flows = np.dtype(precision()), sums_by_name(settings), settings.flows()
    replicas = {}
    for row, ((point, seed, status), tally, (strain, area, shear_rate)) in enumerate(
        zip(arrays["keys"].tolist(), arrays["tallies"], arrays["numbers"], strict=True)
    ):
        tallies = tally_from_flat(tally, dtype, own_sums)
        sample = Sample(tallies, dtype.type(area), dtype.type(shear_rate), flows[point].grains)
        state = None
        if f"state-{row}-0" in arrays:
            found: list[Any] = [
                arrays[f"state-{row}-{k}"] for k in range(6)
            ]  # the leaves of a state
            state = State(Grains(*found[:2]), *found[2:])
        replicas[point, seed] = Replica(sample, status, float(strain), state)
    return replicas


def _identity(settings: MapSettings) -> dict[str, Any]:
    """All that the results depend on, bit for bit, in types of JSON."""
    return {
        **identity(settings),
        **versions_of(made_with()),
        "precision": precision(),
        "device": default_device().platform,
        "number of running sums": len(TABLE),
    }


def _locked(folder: Path, output: Path) -> int | None:
    """Lock a folder, made if missing, until this process ends; InputError if another process has
    locked it.

    On a file system without locks, a second run on one output is not detected.
    """
    while True:
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except FileExistsError:
            raise InputError(
                f"output needs the folder {str(folder)!r}, and a file has this name: rename it.",
                field="output",
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
                f"another process is writing {str(output)!r}: wait for it, or choose another "
                "`output`."
            ) from None
        except OSError:
            return handle
        if _is_lock_of(folder, handle):
            return handle
        os.close(handle)  # the lock of a removed folder: try again


def _is_lock_of(folder: Path, lock: int | None) -> bool:
    """Whether the lock is that of this folder, and not of one that was removed since."""
    return lock is None or same_file(lock, folder / "lock")
