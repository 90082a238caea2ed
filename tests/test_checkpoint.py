"""A checkpoint gives back what was kept, tells what is damaged or foreign, and has one writer."""

import errno
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from flows import assert_same_bits
from synthetic import one_sentence, random_replica, refused

from jaxgran.contact.projected_methods import BarzilaiBorwein
from jaxgran.dynamics.engine import Jax
from jaxgran.io.atomic import write_arrays
from jaxgran.maps import checkpoint
from jaxgran.maps.checkpoint import Checkpoint
from jaxgran.maps.replica import Key, Replica
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
        {(point, seed): random_replica(rng, SETTINGS, Status.not_steady if point == 1 else 0) for seed in range(2)}
        for point in range(3)
    ]


def cut_off(output: Path) -> dict[Key, Replica]:
    """A run that keeps three batches and ends without having finished."""
    run = Checkpoint(output, SETTINGS, resume=False)
    for batch in batches():
        run.add(batch)
    run.close(finished=False)
    return run.done


def test_what_is_kept_comes_back_bit_for_bit(output: Path) -> None:
    kept = cut_off(output)
    resumed = Checkpoint(output, SETTINGS, resume=True)
    assert_same_bits(resumed.done, kept)
    assert resumed.damaged == []
    resumed.close(finished=True)
    assert list(output.parent.iterdir()) == []


def test_an_unfinished_map_is_never_overwritten(output: Path) -> None:
    cut_off(output)
    with refused("to continue it"):
        Checkpoint(output, SETTINGS, resume=False)
    Checkpoint(output, SETTINGS, resume=True).close(finished=False)


@pytest.mark.parametrize("change", [{"solver": LOOSE}, {"restitution": (0.4, 0.9)}, {"engine": Jax()}])
def test_another_map_is_refused_and_the_difference_named(output: Path, change: dict) -> None:
    cut_off(output)
    with refused(f"has {next(iter(change))} "):
        Checkpoint(output, replace(SETTINGS, **change), resume=True)


def test_files_of_another_format_are_refused_and_kept(output: Path, monkeypatch) -> None:
    cut_off(output)
    folder = output.with_name("map.nc.unfinished")
    there = sorted(folder.iterdir())
    monkeypatch.setattr("jaxgran.io.atomic.FORMAT_VERSION", 2)
    with pytest.raises(InputError, match="has format_version 1, and this version of jaxgran reads") as no:
        Checkpoint(output, SETTINGS, resume=True)
    assert one_sentence(str(no.value)) and sorted(folder.iterdir()) == there


@pytest.mark.parametrize("how", ["torn", "flipped"])
def test_a_damaged_file_costs_its_own_batch_alone(output: Path, how: str) -> None:
    kept = cut_off(output)
    folder = output.with_name("map.nc.unfinished")
    lost = sorted(folder.glob("done-*.nc"))[1]
    whole = bytearray(lost.read_bytes())
    middle = len(whole) // 2
    whole[middle : middle + 64] = bytes(255 - x for x in whole[middle : middle + 64])
    lost.write_bytes({"torn": bytes(whole[:middle]), "flipped": bytes(whole)}[how])
    resumed = Checkpoint(output, SETTINGS, resume=True)
    assert resumed.damaged == [lost.name] and not lost.exists()
    assert len(resumed.done) == 4
    assert_same_bits(resumed.done, {key: kept[key] for key in resumed.done})
    resumed.close(finished=False)


def test_damaged_parameters_are_known_from_the_names_of_the_batches(output: Path) -> None:
    kept = cut_off(output)
    file = output.with_name("map.nc.unfinished") / "map.nc"
    file.write_bytes(b"half")
    with refused("damaged: remove the folder"):
        Checkpoint(output, replace(SETTINGS, solver=LOOSE), resume=True)
    for damaged in (["map.nc"], []):
        resumed = Checkpoint(output, SETTINGS, resume=True)
        assert resumed.damaged == damaged
        assert_same_bits(resumed.done, kept)
        resumed.close(finished=False)


def test_what_a_finished_map_has_left_is_no_part_of_the_next_one(output: Path) -> None:
    cut_off(output)
    (output.with_name("map.nc.unfinished") / "map.nc").unlink()  # killed while it removed its folder
    other = replace(SETTINGS, solver=LOOSE)
    first = Checkpoint(output, other, resume=False)
    assert first.done == {}
    first.add(batches()[0])
    first.close(finished=False)
    resumed = Checkpoint(output, other, resume=True)
    assert set(resumed.done) == set(batches()[0])
    resumed.close(finished=True)


def test_batches_of_another_map_are_never_taken_for_those_of_this_one(output: Path) -> None:
    cut_off(output)
    folder = output.with_name("map.nc.unfinished")
    done = {path.name: path.read_bytes() for path in folder.glob("done-*.nc")}
    shutil.rmtree(folder)
    other = Checkpoint(output, replace(SETTINGS, solver=LOOSE), resume=False)
    assert other.journal_path([(0, 0)]) != Checkpoint(output.with_name("b.nc"), SETTINGS, False).journal_path([(0, 0)])
    for name, content in done.items():
        (folder / name).write_bytes(content)
    journal = other.journal_path([(0, 0)])
    write_arrays(journal, {"keys": np.array([[3, 1]])}, {})  # the name is that of another batch
    assert other.journals() == [] and not journal.exists()
    other.close(finished=False)
    resumed = Checkpoint(output, other.settings, resume=True)
    assert resumed.done == {} and resumed.damaged == []
    resumed.close(finished=False)


def test_no_replica_is_under_way_twice(output: Path) -> None:
    run = Checkpoint(output, SETTINGS, resume=False)
    run.add(batches()[0])
    for keys in ([(1, 0), (1, 1)], [(1, 1), (2, 0)], [(0, 1), (2, 1)], [(3, 0)]):
        write_arrays(run.journal_path(keys), {"keys": np.array(keys)}, {})
    begun = [key for batch in run.journals() for key in batch]
    assert len(set(begun)) == len(begun) and (3, 0) in begun and (0, 1) not in begun
    run.close(finished=True)


def test_the_lock_is_taken_again_with_a_folder_that_was_removed(output: Path) -> None:
    """And all that was known."""
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


def test_what_was_being_written_or_removed_when_a_process_was_killed_is_tidied_up(output: Path) -> None:
    cut_off(output)
    folder = output.with_name("map.nc.unfinished")
    for litter in (folder / ".done-0123-0123456789abcdef.nc", output.with_name(".map-0123456789abcdef.nc")):
        litter.write_bytes(b"half")
    shutil.copytree(folder, output.with_name(".map.nc.unfinished"))
    other = output.with_name(".map-of-mine.nc")
    other.write_bytes(b"")
    Checkpoint(output, SETTINGS, resume=True).close(finished=True)
    assert list(output.parent.iterdir()) == [other]


def test_a_file_in_place_of_the_folder_is_one_sentence(output: Path) -> None:
    output.with_name("map.nc.unfinished").write_text("mine")
    with refused("a file has this name"):
        Checkpoint(output, SETTINGS, resume=False)


def test_a_file_system_without_locks_is_no_obstacle(output: Path, monkeypatch) -> None:
    def no_locks(*_) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(checkpoint.fcntl, "flock", no_locks)
    kept = cut_off(output)
    monkeypatch.setattr(checkpoint, "fcntl", None)
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
