"""Where the replicas of a map are kept: in its file, and while it runs in a folder beside it.

==================  ================================================================================
file                content
==================  ================================================================================
``settings.json``   all that the numbers of a replica depend on but its ``ReplicaId``: settings,
                    versions, sources, precision and device; and the commit of the sources
``replica-*.npz``   a finished replica, named after its ``ReplicaId``
``blocks-*.npz``    the blocks of a long batch that is running, see ``blocks``
``lock``            locked by the process that writes here; released when that process ends for any
                    reason
==================  ================================================================================

So a map is continued, and a finished one extended, with other lists of numbers and other seeds:
only replicas that are missing are run. Files of replicas that a map does not have are left alone,
also when it is finished. Those of replicas and blocks have a checksum. A damaged one is removed,
and its replicas are computed again.
"""

import glob
import json
import os
import secrets
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import jax
import numpy as np
import xarray as xr

from jaxgran.dynamics.tally import TABLE
from jaxgran.environment import default_device, precision
from jaxgran.files import atomic_write, is_locked, lock_file, stamp
from jaxgran.io.arrays import CorruptFile, read_arrays, write_arrays
from jaxgran.maps import results
from jaxgran.maps.attributes import common_identity, digest, first_difference, from_attrs, identity
from jaxgran.maps.batches import replica_ids
from jaxgran.maps.own_observables import sums_by_name
from jaxgran.maps.provenance import code_name, deciding, made_with
from jaxgran.maps.replica import Replica, ReplicaId, union
from jaxgran.maps.rows import measured_ids, replica_of, replicas_of, sums_of
from jaxgran.maps.settings import MapSettings
from jaxgran.maps.states import state_of, values_of
from jaxgran.model.checks import InputError, short_repr


class Store:
    """The replicas of a map that are there already, and those that are added.

    Args:
      output: file of the map; the folder is beside it.
      settings: the map.
      resume: whether to take the replicas that the file and the folder have.
      overwrite: whether the file may be replaced, whatever it has.

    Attributes:
      replicas: those of this map that are there.
      in_file: what the file has measured.
      finished: the data of the file, if it is this map, and has all that is asked for.
      damaged: names of the damaged files that were removed.

    Raises:
      InputError: (a ValueError) another process writes to this output. Or the file or the folder
        has something else; the message names the difference.
    """

    def __init__(self, output: Path, settings: MapSettings, resume: bool, overwrite: bool):
        self.output, self.settings = output, settings
        self.folder = output.with_name(f"{output.name}.unfinished")
        self.damaged: list[str] = []
        self._overwrite = overwrite
        self._lock_path, self._begun_path = self.folder / "lock", self.folder / "settings.json"
        self._ids = set(replica_ids(settings))
        self._made, self._of_map = made_with(), identity(settings)
        of_device = {"device": default_device().platform, "number of running sums": len(TABLE)}
        self._identity = common_identity(self._of_map) | deciding(self._made) | of_device
        self._digest = digest(self._identity)
        self.in_file: set[ReplicaId] = set()
        self._lock = self._new_lock()
        try:
            self._stamp = stamp(output)
            earlier = self._earlier_map(resume, overwrite) if output.exists() else None
            self._remove_leftovers()
            self._begin(resume)
            in_folder = union(self._read() if resume else [])
            if not overwrite and (lost := sorted(self.in_file - self._ids - in_folder.keys())):
                raise self._refused(f"a map with {_text(lost[0])}, which this one lacks")
            from_file = [] if earlier is None else replicas_of(earlier, settings)
            there = union(in_folder.values(), from_file)
            self.replicas = {name: x for name, x in there.items() if name in self._ids}
        except BaseException:
            self.close()
            raise
        whole = earlier is not None and self.in_file >= self._ids
        self.finished = earlier if whole and not in_folder else None

    def add(self, replica: Replica) -> None:
        """Keep a finished replica; one that was given up runs again when the map is resumed."""
        if replica.sample is None:
            return
        try:
            self._write([replica])
        except FileNotFoundError:  # the folder was removed by hand
            self._unlock()
            self._lock = self._new_lock()
            self._write_begun()
            self._write([*self.replicas.values(), replica])
        self.replicas[replica.id] = replica
        self.blocks_path([replica.id]).unlink(missing_ok=True)

    def blocks_path(self, replicas: Sequence[ReplicaId]) -> Path:
        """The file for the blocks of a batch, named after its replicas and all else that its
        numbers depend on.

        So a worker of an earlier map that still writes here writes no file of this one. The path is
        absolute, as workers may have another working folder.
        """
        name = digest({"replicas": [list(x) for x in replicas]})
        return (self.folder / f"blocks-{name}-{self._digest}.npz").absolute()

    def write(self, data: xr.DataTree, interrupted: bool) -> None:
        """Write a map in which something was measured, but no interrupted one over replicas that it
        lacks.
        """
        if "tally" in data["sums"] and not (interrupted and self.in_file - self.replicas.keys()):
            if not self._overwrite and stamp(self.output) not in (None, self._stamp):
                free = self.output.with_name(f"{self.output.stem}-{secrets.token_hex(4)}.nc")
                results.write_dataset(data, free)
                where = f"this map is written to {short_repr(str(free))}: "
                raise self._refused("what another process wrote meanwhile", where)
            results.write_dataset(data, self.output)

    def close(self, written: bool = False) -> None:
        """Release the lock. If the whole map was written, remove the files of its replicas; remove
        the folder if it has no others.
        """
        if is_locked(self._lock_path, self._lock):
            whole = written and self._ids <= self.replicas.keys()
            own = {self._path(x) for x in self._ids} if whole else set()
            blocks = [] if whole else self.folder.glob(f"blocks-*-{self._digest}.npz")
            empty = not {*self.folder.glob("replica-*.npz"), *blocks} - own
            if empty:
                self._begun_path.unlink(missing_ok=True)  # first: without it there is no map
            for path in own:
                path.unlink(missing_ok=True)
            if empty:
                for path in (*self.folder.glob("blocks-*.npz"), self._lock_path):
                    path.unlink(missing_ok=True)
                with suppress(OSError):  # files of the user are in it
                    self.folder.rmdir()
        self._unlock()

    def _earlier_map(self, resume: bool, overwrite: bool) -> xr.DataTree | None:
        """The map of the file, if its replicas are to be taken."""
        try:
            data = results.open_map(self.output)
            there, self.in_file = identity(from_attrs(data)), set(measured_ids(data))
        except InputError:
            if not overwrite:
                raise self._refused("something other than a map of this version") from None
            return None
        theirs, ours = common_identity(there), common_identity(self._of_map)
        common = first_difference({x: theirs[x] for x in theirs if x in ours}, ours)
        if resume and common is None:
            return self._of_same_code(data, overwrite)
        if overwrite:
            return None
        difference = common if resume else first_difference(there, self._of_map)
        if difference is not None:
            name, before, now = difference
            raise self._refused(
                f"a map with {name} {short_repr(before)} and not {short_repr(now)}",
                "pass `resume=True` to extend it, or " if common is None else "",
            )
        raise InputError(
            f"output {short_repr(str(self.output))} already exists and has this map; pass "
            "`resume=True` to keep its points, or `overwrite=True` to replace it.",
            field="output",
        )

    def _of_same_code(self, data: xr.DataTree, overwrite: bool) -> xr.DataTree | None:
        """A map whose numbers this process would repeat; None for another one that may be
        replaced.
        """
        there = {str(name): str(value) for name, value in data.attrs.items()}
        difference = first_difference(deciding(self._made), deciding(there))
        if difference is None:
            return data
        if overwrite:
            return None
        name, now, before = difference
        raise InputError(
            f"output {short_repr(str(self.output))} was made with {code_name(there)}, and this is "
            f"{code_name(self._made)}: it has {name} {before!r}, not {now!r}; draw it as it is by "
            "jaxgran plot, or pass `overwrite=True` to measure it again.",
            field="output",
        )

    def _refused(self, content: str, or_else: str = "") -> InputError:
        return InputError(
            f"output {short_repr(str(self.output))} already exists and has {content}; {or_else}"
            "name another file, or pass `overwrite=True` to replace it.",
            field="output",
        )

    def _remove_leftovers(self) -> None:
        """Remove temporary files of a process that was killed while it wrote."""
        unique = "[0-9a-f]" * 16
        file = Path(os.path.realpath(self.output))  # temporary files are beside it
        beside = f".{glob.escape(file.stem)}-{unique}{file.suffix}"
        for path in [*file.parent.glob(beside), *self.folder.glob(f".*-{unique}.*")]:
            path.unlink(missing_ok=True)

    def _begin(self, resume: bool) -> None:
        """Compare the unfinished map that is there, or write the settings of a new one."""
        begun: dict[str, Any] = {}
        try:
            if self._begun_path.exists():
                begun = dict(json.loads(self._begun_path.read_text("utf-8")))
        except (TypeError, ValueError):
            raise InputError(
                f"the file settings.json in {str(self.folder)!r} is damaged: remove the folder."
            ) from None
        commit = {"commit": begun.pop("commit", "")}
        replicas = [*self.folder.glob("replica-*.npz")]
        blocks = self.folder.glob(f"blocks-*-{digest(begun)}.npz")
        if not begun and replicas and not self.output.exists():
            raise InputError(
                f"the folder {str(self.folder)!r} has replicas, and no settings.json that says of "
                "which map: rename or remove it."
            )
        if not begun or not [*replicas, *blocks]:
            for path in self.folder.glob("*.npz"):
                path.unlink()
            self._write_begun()
            return
        if not resume:
            raise InputError(
                f"output {str(self.output)!r} has an unfinished map: pass `resume=True` "
                "to continue it, or name another file.",
                field="output",
            )
        if difference := first_difference(self._identity, begun):
            name, requested, begun_with = difference
            by, where = "", "with the same parameters"
            if name in self._made:
                other = code_name({key: str(text) for key, text in (begun | commit).items()})
                here = code_name(self._made)
                by, where = f" was begun by {other}, and this is {here}: it", "there"
            raise InputError(
                f"the unfinished map in {str(self.folder)!r}{by} has {name} {begun_with!r}, not "
                f"{requested!r}; resume it {where}, or name another `output`."
            )

    def _write_begun(self) -> None:
        content = json.dumps(self._identity | {"commit": self._made["commit"]})
        with atomic_write(self._begun_path) as temporary:
            temporary.write_text(content, "utf-8")

    def _path(self, replica: ReplicaId) -> Path:
        return self.folder / f"replica-{'-'.join(map(repr, replica))}.npz"

    def _write(self, replicas: Iterable[Replica]) -> None:
        for replica in replicas:
            states = {} if replica.state is None else values_of(replica.state)
            arrays = sums_of(replica) | {f"state_{name}": x for name, x in states.items()}
            write_arrays(self._path(replica.id), arrays, {"replica": list(replica.id)})

    def _read(self) -> Iterator[Replica]:
        """The replicas of the folder, also those of other axes and seeds."""
        dtype, own_sums = np.dtype(precision()), sums_by_name(self.settings)
        for path in sorted(self.folder.glob("replica-*.npz")):
            try:
                arrays, about = read_arrays(path)
            except CorruptFile:
                self.damaged.append(path.name)
                path.unlink(missing_ok=True)
                continue
            fields = {x[6:]: array for x, array in arrays.items() if x.startswith("state_")}
            state = jax.tree.map(np.asarray, state_of(fields, dtype)) if fields else None
            replica: Any = about["replica"]
            yield replica_of(self.settings, ReplicaId(*replica), arrays, dtype, own_sums, state)

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
                f"another process is writing {str(self.output)!r}: wait for it, or choose "
                "another `output`."
            ) from None

    def _unlock(self) -> None:
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None


@contextmanager
def open_store(
    output: Path, settings: MapSettings, resume: bool, overwrite: bool
) -> Iterator[Store]:
    """The store of a map, closed at the end; see ``Store``."""
    store, written = Store(output, settings, resume, overwrite), False
    try:
        yield store
        written = True
    except OSError as error:
        if store.replicas:
            note = f"finished batches are in {store.folder}: to continue, add `resume=True`"
            error.add_note(note)
        raise
    finally:
        store.close(written)


def _text(replica: ReplicaId) -> str:
    return (
        f"restitution {replica.restitution:g}, packing fraction {replica.packing_fraction:g}, "
        f"grains {replica.grains}, timestep {replica.timestep:g} and seed {replica.seed}"
    )
