"""A checkpoint gives back what was kept, tells what is damaged or foreign, and has one writer."""

import errno
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest
from flows import assert_same_bits
from synthetic import one_sentence, random_replica, refused

from jaxgran import files
from jaxgran.contact.projected_methods import BarzilaiBorwein
from jaxgran.dynamics.engine import Jax
from jaxgran.io.arrays import write_arrays
from jaxgran.maps import checkpoint, provenance
from jaxgran.maps.checkpoint import Checkpoint
from jaxgran.maps.replica import Key, Replica, replica_ids
from jaxgran.maps.settings import MapSettings
from jaxgran.model.checks import InputError
from jaxgran.model.status import Status

LOOSE = BarzilaiBorwein(tolerance=1e-3)
SETTINGS = MapSettings((0.5, 0.9), (0.5, 0.6), grains=64, seeds=2, strain=2.0)


@pytest.fixture
def output(tmp_path: Path) -> Path:
    return tmp_path / "map.nc"


def batches() -> list[dict[Key, Replica]]:
    rng = np.random.default_rng(0)
    return [
        {
            (point, seed): random_replica(
                rng, SETTINGS, Status.not_steady if point == 1 else 0, point
            )
            for seed in range(2)
        }
        for point in range(3)
    ]


def cut_off(output: Path) -> dict[Key, Replica]:
    """A run that keeps three batches and ends without having finished."""
    run = Checkpoint(output, SETTINGS, resume=False)
    for batch in batches():
        run.add(batch)
    run.close(finished=False)
    return run.done


def journal_of(output: Path, keys: list[Key], settings: MapSettings = SETTINGS) -> Path:
    """The journal of a batch, as another run of these settings names and writes it."""
    run = Checkpoint(output.with_name("another.nc"), settings, resume=False)
    run.close(finished=True)
    path = output.with_name("map.nc.unfinished") / run.journal_path(keys).name
    write_arrays(path, {"replicas": np.array(replica_ids(settings, keys))}, {})
    return path


def test_what_is_kept_comes_back_bit_for_bit(output: Path) -> None:
    kept = cut_off(output)
    resumed = Checkpoint(output, SETTINGS, resume=True)
    assert_same_bits(resumed.done, kept)
    assert resumed.damaged == resumed.interrupted == []
    resumed.close(finished=True)
    assert list(output.parent.iterdir()) == []


def test_an_unfinished_map_is_never_overwritten(output: Path) -> None:
    cut_off(output)
    with refused("to continue it"):
        Checkpoint(output, SETTINGS, resume=False)
    Checkpoint(output, SETTINGS, resume=True).close(finished=False)


@pytest.mark.parametrize("change", [{"solver": LOOSE}, {"strain": 2.5}, {"engine": Jax()}])
def test_another_map_is_refused_and_the_difference_named(output: Path, change: dict) -> None:
    cut_off(output)
    with refused(f"has {next(iter(change))} "):
        Checkpoint(output, replace(SETTINGS, **change), resume=True)


def test_a_map_begun_on_the_processor_continues_there_beside_an_accelerator(
    output: Path, monkeypatch
) -> None:
    cut_off(output)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    with jax.default_device(jax.devices("cpu")[0]):
        Checkpoint(output, SETTINGS, resume=True).close(finished=False)


@pytest.mark.parametrize("how", ["torn", "flipped", "empty"])
def test_damaged_settings_are_one_sentence_and_a_damaged_replica_or_journal_is_removed(
    output: Path, how: str
) -> None:
    cut_off(output)
    folder = output.with_name("map.nc.unfinished")
    files = [journal_of(output, [(3, 0)]), *folder.glob("replica-*-0.npz")]
    for file in (*files, folder / "settings.npz"):
        whole = bytearray(file.read_bytes())
        middle = len(whole) // 2
        whole[middle : middle + 64] = bytes(255 - x for x in whole[middle : middle + 64])
        file.write_bytes(
            {"torn": bytes(whole[:middle]), "flipped": bytes(whole), "empty": b""}[how]
        )
        if file == files[-1]:
            resumed = Checkpoint(output, SETTINGS, resume=True)
            assert resumed.interrupted == [] and list(resumed.done) == [(p, 1) for p in range(3)]
            assert sorted(resumed.damaged) == sorted(path.name for path in files)
            assert not any(path.exists() for path in files)
            resumed.close(finished=False)
    with pytest.raises(InputError, match="damaged: remove the folder") as refused:
        Checkpoint(output, SETTINGS, resume=True)
    assert one_sentence(str(refused.value))


def test_a_batch_is_under_way_until_all_of_it_is_written(output: Path, monkeypatch) -> None:
    def full_disc(path: Path, arrays, about) -> None:
        if path.name.endswith("-1.npz"):
            raise OSError(errno.ENOSPC, "No space left on device")
        write_arrays(path, arrays, about)

    run = Checkpoint(output, SETTINGS, resume=False)
    first, second, third = batches()
    journals = [journal_of(output, list(batch)) for batch in (first, second)]
    run.add(first)
    assert [path.exists() for path in journals] == [False, True]
    with monkeypatch.context() as patch, pytest.raises(OSError):
        patch.setattr(checkpoint, "write_arrays", full_disc)
        run.add(second)
    run.add(third)
    journal_of(output, list(third))  # as of a run that ended before it removed it
    run.close(finished=False)
    resumed = Checkpoint(output, SETTINGS, resume=True)
    assert resumed.interrupted == [list(second)]
    assert_same_bits(resumed.done, first | third)
    resumed.add(second)
    resumed.close(finished=True)
    assert list(output.parent.iterdir()) == []


def test_a_map_continues_with_other_axes_seeds_and_parts_and_keeps_what_it_does_not_need(
    output: Path,
) -> None:
    """Its points are (0.5, 0.5), (0.5, 0.9) and (0.6, 0.5), packing fraction and restitution."""
    kept = cut_off(output)
    journal_of(output, [(3, 0), (3, 1)])
    more = replace(
        SETTINGS, restitution=(0.5, 0.7, 0.9), packing_fraction=(0.6,), seeds=2, first_seed=1
    )
    resumed = Checkpoint(output, more, resume=True)
    assert resumed.interrupted == []  # one of its seeds is not needed
    assert_same_bits(resumed.done, {(0, 0): kept[2, 1]})
    resumed.close(finished=True)
    again = Checkpoint(output, SETTINGS, resume=True)
    assert again.interrupted == [[(3, 0), (3, 1)]]
    assert_same_bits(again.done, {key: x for key, x in kept.items() if key != (2, 1)})
    again.close(finished=False)


def test_with_an_error_the_number_of_seeds_is_that_of_the_unfinished_map(output: Path) -> None:
    settings = replace(SETTINGS, strain=None, error=0.1)
    run = Checkpoint(output, settings, resume=False)
    run.add(batches()[0])
    run.close(finished=False)
    Checkpoint(output, replace(settings, restitution=(0.5,)), resume=True).close(finished=False)
    with refused("has seeds 2, not 3"):
        Checkpoint(output, replace(settings, seeds=3), resume=True)


def test_a_late_worker_of_another_map_writes_into_no_file_of_this_one(output: Path) -> None:
    run = Checkpoint(output, SETTINGS, resume=False)
    late = journal_of(output, [(0, 0)], replace(SETTINGS, solver=LOOSE))
    assert late != run.journal_path([(0, 0)])
    run.close(finished=False)
    assert list(output.parent.iterdir()) == []


def test_a_map_of_other_sources_is_not_continued(output: Path, monkeypatch) -> None:
    cut_off(output)
    monkeypatch.setattr("jaxgran.maps.provenance.sources_digest", lambda: "other")
    with refused("has code_digest "):
        Checkpoint(output, SETTINGS, resume=True)


def test_a_map_of_another_version_names_it_and_its_commit_and_not_to_remove_it(
    output: Path, monkeypatch
) -> None:
    older = provenance.made_with() | {"version_jaxgran": "0.1.0", "commit": "abc1234"}
    with monkeypatch.context() as patch:
        patch.setattr(checkpoint, "made_with", lambda: older)
        cut_off(output)
    with pytest.raises(InputError) as caught:
        Checkpoint(output, SETTINGS, resume=True)
    assert "was begun by jaxgran 0.1.0, commit abc1234, and this is" in str(caught.value)
    assert "resume it there" in str(caught.value) and "remove" not in str(caught.value)


def test_workers_with_another_working_folder_find_the_journals(output: Path, monkeypatch) -> None:
    monkeypatch.chdir(output.parent)
    run = Checkpoint(Path(output.name), SETTINGS, resume=False)
    assert run.journal_path([(0, 0)]).parent == output.with_name("map.nc.unfinished")
    run.close(finished=True)


def test_a_journal_without_its_map_is_no_part_of_the_next_one(output: Path) -> None:
    cut_off(output)
    folder = output.with_name("map.nc.unfinished")
    journal_of(output, [(3, 0)])
    (folder / "settings.npz").unlink()
    run = Checkpoint(output, replace(SETTINGS, solver=LOOSE), resume=False)
    assert run.done == {} and run.interrupted == []
    run.close(finished=False)
    assert list(output.parent.iterdir()) == []


def test_the_lock_is_taken_again_with_a_folder_that_was_removed(output: Path) -> None:
    run = Checkpoint(output, SETTINGS, resume=False)
    first, second, _ = batches()
    run.add(first)
    shutil.rmtree(run.folder)
    run.add(second)
    with pytest.raises(InputError, match="another process is writing"):
        Checkpoint(output, SETTINGS, resume=True)
    run.close(finished=False)
    resumed = Checkpoint(output, SETTINGS, resume=True)
    assert_same_bits(resumed.done, first | second)
    resumed.close(finished=True)
    assert list(output.parent.iterdir()) == []


def test_what_was_being_written_when_a_process_was_killed_is_tidied_up(output: Path) -> None:
    cut_off(output)
    folder = output.with_name("map.nc.unfinished")
    for litter in (
        folder / ".replica-0123456789abcdef.npz",
        output.with_name(".map-0123456789abcdef.nc"),
    ):
        litter.write_bytes(b"half")
    other = output.with_name(".map-of-mine.nc")
    other.write_bytes(b"")
    Checkpoint(output, SETTINGS, resume=True).close(finished=True)
    assert list(output.parent.iterdir()) == [other]


def test_a_file_system_without_locks_is_no_obstacle(output: Path, monkeypatch) -> None:
    def no_locks(*_) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(files.fcntl, "flock", no_locks)
    kept = cut_off(output)
    monkeypatch.setattr(files, "fcntl", None)
    resumed = Checkpoint(output, SETTINGS, resume=True)
    assert_same_bits(resumed.done, kept)
    resumed.close(finished=True)
    assert list(output.parent.iterdir()) == []


def test_a_second_writer_is_refused_until_the_first_has_ended_however_it_did(output: Path) -> None:
    script = f"""
import time
from pathlib import Path
from jaxgran.maps.checkpoint import Checkpoint
from jaxgran.contact.projected_methods import BarzilaiBorwein
from jaxgran.maps.settings import MapSettings
import jax
jax.config.update("jax_enable_x64", True)
Checkpoint(Path({str(output)!r}), {SETTINGS!r}, resume=False)
print("locked", flush=True)
time.sleep(60)
"""
    first = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True)
    assert first.stdout is not None and first.stdout.readline() == "locked\n"
    with refused("another process is writing"):
        Checkpoint(output, SETTINGS, resume=True)
    first.send_signal(signal.SIGKILL)
    first.wait()
    first.stdout.close()
    Checkpoint(output, SETTINGS, resume=True).close(finished=True)
