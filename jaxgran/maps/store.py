"""Where a map is kept: its file, and a checkpoint beside it while the map runs."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import xarray as xr

from jaxgran.maps import results
from jaxgran.maps.attributes import (
    first_difference,
    from_attrs,
    identity,
    identity_of_replicas,
)
from jaxgran.maps.batches import points_of_part
from jaxgran.maps.checkpoint import Checkpoint, checkpoint_folder
from jaxgran.maps.provenance import code_name, deciding, made_with
from jaxgran.maps.settings import MapSettings, RunOptions
from jaxgran.model.checks import InputError, short_repr


class Store(NamedTuple):
    """The file of a map and its checkpoint; neither without an ``output``.

    Attributes:
      output: the file.
      checkpoint: the finished part of the map.
      finished: the finished map, of any settings, that the file has already.
      result: the same if it is what was asked for, so that nothing has to be run.
    """

    output: Path | None = None
    checkpoint: Checkpoint | None = None
    finished: xr.DataTree | None = None
    result: xr.DataTree | None = None

    def write(self, data: xr.DataTree, interrupted: bool) -> None:
        """Write a map in which something was measured, but no interrupted one over a finished
        one.
        """
        if self.output is None or "tally" not in data["sums"]:
            return
        if not interrupted or self.finished is None:
            results.write_dataset(data, self.output)


@contextmanager
def open_store(settings: MapSettings, run: RunOptions) -> Iterator[Store]:
    """The store of a map. At the end the checkpoint is removed if it has all replicas, and kept
    after an error.

    Raises:
      InputError: (a ValueError) the output has something else and may not be replaced, or see
        ``Checkpoint``.
    """
    if run.output is None:
        yield Store()
        return
    earlier, difference = _earlier_map(run.output, settings)
    finished = earlier if earlier is not None and results.is_finished(earlier) else None
    # an unfinished map whose replicas settings of other axes, seeds or part have too
    continued = (
        run.resume
        and earlier is not None
        and finished is None
        and checkpoint_folder(run.output).exists()
        and identity_of_replicas(from_attrs(earlier)) == identity_of_replicas(settings)
    )
    if earlier is not None and not (difference or run.resume or run.overwrite):
        raise InputError(
            f"output {short_repr(str(run.output))} already exists and has this map; pass "
            "`resume=True` to keep its points, or `overwrite=True` to replace it.",
            field="output",
        )
    if difference and not (run.overwrite or continued):
        raise InputError(
            f"output {short_repr(str(run.output))} already exists and has {difference}; "
            "name another file, or pass `overwrite=True` to replace it.",
            field="output",
        )
    checkpoint = Checkpoint(run.output, settings, run.resume)
    try:
        is_new = not (checkpoint.done or checkpoint.interrupted)
        result = finished if run.resume and is_new and not difference else None
        if result is not None and (other_code := _other_code(result)):
            if not run.overwrite:
                raise InputError(
                    f"output {short_repr(str(run.output))} {other_code}; draw it as it is by "
                    "jaxgran plot, or pass `overwrite=True` to measure it again.",
                    field="output",
                )
            result = None
        yield Store(run.output, checkpoint, finished, result)
    except BaseException as error:
        if isinstance(error, OSError) and checkpoint.done:
            note = f"finished batches are in {checkpoint.folder}: to continue, add `resume=True`"
            error.add_note(note)
        checkpoint.close(finished=False)
        raise
    checkpoint.close(finished=len(checkpoint.done) == replica_count(settings))


def _other_code(data: xr.DataTree) -> str:
    """With what a map was made, if the numbers of this process could be others; else ""."""
    here, there = made_with(), {str(name): str(value) for name, value in data.attrs.items()}
    if difference := first_difference(deciding(here), deciding(there)):
        name, now, before = difference
        return (
            f"was made with {code_name(there)}, and this is {code_name(here)}: it has {name} "
            f"{before!r}, not {now!r}"
        )
    return ""


def _earlier_map(path: Path, settings: MapSettings) -> tuple[xr.DataTree | None, str]:
    """The map that is in a file already, or None, and a description of what a map of these settings
    would replace.

    The description is "" if there is no file, or one of a map of the same settings.
    """
    if not path.exists():
        return None, ""
    try:
        data = results.open_map(path)
        there = from_attrs(data)
    except InputError:
        return None, "something other than a map of this version"
    if difference := first_difference(identity(there), identity(settings)):
        name, before, now = difference
        return data, f"a map with {name} {short_repr(before)} and not {short_repr(now)}"
    return data, ""


def replica_count(settings: MapSettings) -> int:
    """The number of replicas that a map measures."""
    return len(points_of_part(settings)) * settings.seeds
