"""Checkpoint: a folder beside the output with the finished part of a map, kept until the map is
complete.

==================  ================================================================================
file                content
==================  ================================================================================
``settings.npz``    all that the numbers of a replica depend on but its ``ReplicaId``: settings,
                    versions, sources, precision and device; and the commit of the sources
``replica-*.npz``   a finished replica, named after its ``ReplicaId``
``journal-*.npz``   a batch that is running, see ``journal``, named after its first replica; the end
                    of the name is a hash of what ``settings.npz`` has
``lock``            locked by the process that writes here; released when that process ends for any
                    reason
==================  ================================================================================

So a map is continued with other lists of numbers and other seeds too. Files of replicas that it
does not have are left alone, also when it is finished. Every file has a checksum. A damaged replica
or journal is removed, and its replicas are computed again.
"""

import glob
import os
import shutil
from collections.abc import Mapping, Sequence
from itertools import chain, product
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxgran.dynamics.tally import TABLE, flat_tally, tally_from_flat
from jaxgran.environment import default_device, precision
from jaxgran.files import is_locked, lock_file
from jaxgran.io.arrays import CorruptFile, read_arrays, write_arrays
from jaxgran.maps.attributes import digest, first_difference, identity_of_replicas
from jaxgran.maps.batches import points_of_part
from jaxgran.maps.own_observables import sums_by_name
from jaxgran.maps.provenance import code_name, deciding, made_with
from jaxgran.maps.replica import Key, Replica, ReplicaId, replica_ids
from jaxgran.maps.settings import MapSettings
from jaxgran.model.checks import InputError
from jaxgran.model.flow import ShearFlow
from jaxgran.model.grains import Grains
from jaxgran.model.state import State
from jaxgran.sampling.sample import Sample


class Checkpoint:
    """The finished part of a map, in memory and on disc.

    Args:
      output: file of the map's dataset; the folder is beside it.
      settings: the map.
      resume: whether to continue the unfinished map of an earlier run.

    Attributes:
      done: the finished replicas of this map.
      interrupted: batches of an earlier run that continue from their journals.
      damaged: names of the damaged files that were removed.

    Raises:
      InputError: (a ValueError) another process writes to this output. Or there is an unfinished
        map, and ``resume`` is False or something but lists, seeds and part differs; the message
        names the difference.
    """

    def __init__(self, output: Path, settings: MapSettings, resume: bool):
        self.folder = checkpoint_folder(output)
        self._settings_path, self._lock_path = self.folder / "settings.npz", self.folder / "lock"
        self.settings, self._output = settings, output
        self.done: dict[Key, Replica] = {}
        self.interrupted: list[list[Key]] = []
        self.damaged: list[str] = []
        keys = list(product(points_of_part(settings), range(settings.seeds)))
        self._ids = dict(zip(keys, replica_ids(settings, keys), strict=True))
        self._identity = _identity(settings)
        self._digest = digest(self._identity)
        self._lock = self._new_lock()
        try:
            self._remove_leftovers()
            self._begin(resume)
        except BaseException:
            self._unlock()
            raise

    def add(self, replicas: Mapping[Key, Replica]) -> None:
        """Keep the replicas of a finished batch."""
        try:
            self._write(replicas)
        except FileNotFoundError:  # the folder was removed by hand
            self._unlock()
            self._lock = self._new_lock()
            self._write_settings()
            self._write({**self.done, **replicas})
        self.done |= replicas
        self.journal_path(list(replicas)).unlink(missing_ok=True)

    def journal_path(self, keys: Sequence[Key]) -> Path:
        """The file for the journal of a batch, named after its first replica and all else that its
        numbers depend on.

        So a worker of an earlier map that still writes here writes no file of this one. The path is
        absolute, as workers may have another working folder.
        """
        name = f"journal-{_name(self._ids[keys[0]])}-{self._digest}.npz"
        return (self.folder / name).absolute()

    def close(self, finished: bool) -> None:
        """Release the lock, and remove the files of this map if it is finished, and the folder if
        it has no others.
        """
        if is_locked(self._lock_path, self._lock):
            replicas = {self._path(key) for key in self._ids} if finished else set()
            if replicas.issuperset(self._files(self._digest)):
                self._settings_path.unlink(missing_ok=True)  # first: without it there is no map
                shutil.rmtree(self.folder, ignore_errors=True)
            for path in replicas:
                path.unlink(missing_ok=True)
        self._unlock()

    def _remove_leftovers(self) -> None:
        """Remove temporary files of a process that was killed while it wrote."""
        unique = "[0-9a-f]" * 16
        file = Path(os.path.realpath(self._output))  # temporary files are beside it
        beside = f".{glob.escape(file.stem)}-{unique}{file.suffix}"
        for path in [*file.parent.glob(beside), *self.folder.glob(f".*-{unique}.npz")]:
            path.unlink(missing_ok=True)

    def _begin(self, resume: bool) -> None:
        """Read the unfinished map that is there, or write the settings of a new one."""
        try:
            there = self._settings_path.exists()
            commit, begun = read_arrays(self._settings_path) if there else ({}, {})
        except CorruptFile:
            raise InputError(
                f"the file settings.npz in {str(self.folder)!r} is damaged: remove the folder."
            ) from None
        if not (begun and self._files(digest(begun))):
            for path in self.folder.glob("*.npz"):
                path.unlink()
            self._write_settings()
            return
        if not resume:
            raise InputError(
                f"output {str(self._output)!r} has an unfinished map: pass `resume=True` "
                "to continue it, or name another file.",
                field="output",
            )
        if difference := first_difference(self._identity, begun):
            name, requested, begun_with = difference
            here = made_with()
            by, where = "", "with the same parameters"
            if name in here:
                other = code_name({name: str(text) for name, text in (begun | commit).items()})
                by, where = f" was begun by {other}, and this is {code_name(here)}: it", "there"
            raise InputError(
                f"the unfinished map in {str(self.folder)!r}{by} has {name} {begun_with!r}, not "
                f"{requested!r}; resume it {where}, or name another `output`."
            )
        self._read()

    def _write_settings(self) -> None:
        commit = {"commit": np.array(made_with()["commit"])}
        write_arrays(self._settings_path, commit, self._identity)

    def _files(self, digest: str) -> list[Path]:
        """The replicas and journals of a map."""
        patterns = "replica-*.npz", f"journal-*-{digest}.npz"
        return sorted(path for pattern in patterns for path in self.folder.glob(pattern))

    def _path(self, key: Key) -> Path:
        return self.folder / f"replica-{_name(self._ids[key])}.npz"

    def _read(self) -> None:
        """Read the replicas of this map, and which of its batches have a journal."""
        files = set(self.folder.iterdir())
        own_sums, flows = sums_by_name(self.settings), self.settings.flows()
        for key in self._ids:
            path = self._path(key)
            if path in files and (content := self._content(path)):
                self.done[key] = _replica_of(flows[key[0]], own_sums, *content)
        keys: dict[tuple, Key] = {replica: key for key, replica in self._ids.items()}
        for path in sorted(self.folder.glob(f"journal-*-{self._digest}.npz")):
            if content := self._content(path):
                replicas = list(map(tuple, content[0]["replicas"].tolist()))
                batch = [keys[replica] for replica in replicas if replica in keys]
                if len(batch) < len(replicas) or set(batch) & set(chain(*self.interrupted)):
                    continue  # also of other points, or of another batch
                if self.done.keys() >= set(batch):  # the run ended before it removed the journal
                    path.unlink(missing_ok=True)
                else:
                    self.interrupted.append(batch)
        for key in chain(*self.interrupted):
            self.done.pop(key, None)

    def _content(self, path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]] | None:
        """The content of a file; None where it was damaged, and is removed."""
        try:
            return read_arrays(path)
        except CorruptFile:
            self.damaged.append(path.name)
            path.unlink(missing_ok=True)
            return None

    def _write(self, replicas: Mapping[Key, Replica]) -> None:
        for key, replica in replicas.items():
            write_arrays(self._path(key), *_content_of(replica))

    def _new_lock(self) -> int | None:
        """The lock of the folder, made if missing; InputError if another process has it."""
        try:
            return lock_file(self._lock_path, wait=False)
        except FileExistsError:
            raise InputError(
                f"output needs the folder {str(self.folder)!r}, and a file has this name: "
                "rename it.",
                field="output",
            ) from None
        except BlockingIOError:
            raise InputError(
                f"another process is writing {str(self._output)!r}: wait for it, or choose "
                "another `output`."
            ) from None

    def _unlock(self) -> None:
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None


def checkpoint_folder(output: Path) -> Path:
    """The folder of the checkpoint of a map."""
    return output.with_name(f"{output.name}.unfinished")


def _name(replica: ReplicaId) -> str:
    """The numbers of a replica, as a part of the name of a file."""
    return "-".join(map(repr, replica))


def _content_of(replica: Replica) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """A replica as arrays and a description for ``write_arrays``."""
    sample = replica.sample
    arrays = {
        "tally": flat_tally(sample.tally, np.shape(sample.tally.steps)),
        "area": np.asarray(sample.area),
        "mass": np.asarray(sample.mass),
    }
    arrays |= {f"state_{k}": np.asarray(x) for k, x in enumerate(jax.tree.leaves(replica.state))}
    return arrays, {"status": int(replica.status), "strain": float(replica.strain)}


def _replica_of(
    flow: ShearFlow, own_sums: Any, arrays: Mapping[str, np.ndarray], about: Mapping[str, Any]
) -> Replica:
    """The replica of ``_content_of``."""
    tally = tally_from_flat(arrays["tally"], np.dtype(precision()), own_sums)
    numbers = jax.tree.map(arrays["area"].dtype.type, flow)
    sample = Sample(tally, arrays["area"][()], arrays["mass"][()], numbers)
    leaves: list[Any] = [arrays[name] for name in sorted(arrays) if name.startswith("state_")]
    state = State(Grains(*leaves[:2]), *leaves[2:]) if leaves else None
    return Replica(sample, about["status"], about["strain"], state)


def _identity(settings: MapSettings) -> dict[str, Any]:
    """All that the results depend on, bit for bit, in types of JSON."""
    return {
        **identity_of_replicas(settings),
        **deciding(made_with()),
        "device": default_device().platform,
        "number of running sums": len(TABLE),
    }
