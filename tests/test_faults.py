"""Whatever happens to a map, nothing is lost, nothing is wrong, and what happened is said in a sentence.

Every test runs the real command line in processes of its own, and compares bit for bit with a map that nothing
happened to. What happens to those that are killed at random moments is in ``test_kills``.
"""

import os
import random
import shutil
import signal
import time
from pathlib import Path

import jax
import numpy as np
import pytest
from fault_lab import MARKS, Lab, workers_of

from jaxgran.maps import sweep
from jaxgran.maps.results import read_dataset
from jaxgran.maps.settings import MapSettings

pytestmark = MARKS


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Lab:
    return Lab(tmp_path_factory.mktemp("lab"))


def test_workers_that_are_killed_are_replaced(lab: Lab) -> None:
    process = lab.start("workers.nc")
    for _ in range(2):
        lab.wait_for("workers.nc", process=process)
        os.kill(random.choice(workers_of(process)), signal.SIGKILL)
        time.sleep(0.5)
    done = lab.finish(process)
    assert done.returncode == 0, done.stderr
    lab.assert_whole("workers.nc")


def test_a_batch_that_kills_its_workers_is_given_up_and_the_rest_is_done(lab: Lab) -> None:
    done = lab.finish(lab.start("deadly.nc", fault="deadly batch"))
    assert done.returncode == 3
    assert "killed its worker 3 times: (restitution 0.3, packing fraction 0.6) not measured." in done.stderr
    assert "not run: (restitution 0.3, packing fraction 0.6)." in done.stderr
    data = read_dataset(lab.folder / "deadly.nc")
    for name in ("force_ratio", "pressure", "status"):
        assert data[name].values[0, 1] == lab.whole[name].values[0, 1]
    assert lab.finish(lab.start("deadly.nc", "--resume", workers=1)).returncode == 0
    lab.assert_whole("deadly.nc")


def test_a_map_that_is_interrupted_tells_the_command_that_continues_it(lab: Lab) -> None:
    process = lab.start("interrupted.nc")
    lab.wait_for("interrupted.nc", process=process)
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does, to the workers too
    done = lab.finish(process)
    assert done.returncode == 130
    *_, last = done.stderr.strip().splitlines()
    words = last.split("Continue: jaxgran ")[1].split()
    assert words[-1] == "--resume" and words[words.index("--output") + 1] == "interrupted.nc"
    assert lab.finish(lab.start("interrupted.nc", "--resume", workers=1)).returncode == 0
    lab.assert_whole("interrupted.nc")


@pytest.mark.parametrize("workers", [1, 2])
def test_a_full_disc_is_one_sentence_and_the_map_goes_on_when_there_is_room(lab: Lab, workers: int) -> None:
    output = f"full{workers}.nc"
    done = lab.finish(lab.start(output, fault="disc full", workers=workers))
    assert done.returncode == 1
    *_, last = done.stderr.strip().splitlines()
    assert last.startswith("jaxgran: stopped by the file system, File too large; what is done is in ")
    assert last.endswith("add --resume.")
    assert lab.finish(lab.start(output, "--resume", workers=1)).returncode == 0
    lab.assert_whole(output)


def test_an_output_folder_that_is_removed_is_made_again(lab: Lab) -> None:
    (lab.folder / "gone").mkdir()
    process = lab.start("gone/map.nc")
    lab.wait_for("gone/map.nc", process=process)
    while (lab.folder / "gone").exists():  # a worker may be writing into it
        shutil.rmtree(lab.folder / "gone", ignore_errors=True)
    done = lab.finish(process)
    assert done.returncode == 0, done.stderr
    lab.assert_whole("gone/map.nc")


def test_a_clock_that_jumps_changes_nothing(lab: Lab) -> None:
    done = lab.finish(lab.start("clock.nc", fault="clock", workers=1))
    assert done.returncode == 0, done.stderr
    lab.assert_whole("clock.nc")


def test_a_second_map_on_one_output_is_refused_and_harms_nothing(lab: Lab) -> None:
    first = lab.start("one.nc", workers=1)
    lab.wait_for("one.nc", "map.nc", first)
    os.killpg(first.pid, signal.SIGSTOP)  # it holds the file as long as it lives
    for words in ([], ["--resume"]):
        second = lab.finish(lab.start("one.nc", *words, workers=1))
        assert second.returncode == 2
        assert second.stderr.count("\n") == 1 and "another process is writing 'one.nc'" in second.stderr
    os.killpg(first.pid, signal.SIGCONT)
    assert lab.finish(first).returncode == 0
    lab.assert_whole("one.nc")


def test_a_batch_that_does_not_fit_into_the_memory_is_halved(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = MapSettings((0.5, 0.9), (0.6,), grains=64, seeds=2, timestep=1e-3, equilibrate=0.5, strain=1.6)
    keys, sizes = [(0, 0), (0, 1), (1, 0), (1, 1)], []
    whole = dict(sweep._run_task(settings, keys))
    prepare = sweep.prepare_batch

    def small_device(flow, replica_keys, *arguments):
        sizes.append(len(replica_keys))
        if len(replica_keys) > 1:
            raise jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 42 bytes.")
        return prepare(flow, replica_keys, *arguments)

    monkeypatch.setattr(sweep, "prepare_batch", small_device)
    halved = sweep._run_task(settings, keys, tmp_path / "journal.nc")
    assert sizes == [4, 2, 1, 1, 2, 1, 1]
    assert [key for key, _ in halved] == keys
    for key, replica in halved:
        jax.tree.map(np.testing.assert_array_equal, replica, whole[key])


def test_another_error_of_the_device_is_not_hidden(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken_device(*_):
        raise jax.errors.JaxRuntimeError("INTERNAL: the device is on fire.")

    monkeypatch.setattr(sweep, "prepare_batch", broken_device)
    with pytest.raises(jax.errors.JaxRuntimeError, match="on fire"):
        sweep._run_task(MapSettings((0.5,), (0.6,), grains=64, strain=1.6), [(0, 0), (0, 1)])
