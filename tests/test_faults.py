"""Whatever happens to a map, nothing is lost, nothing is wrong, and what happened is said in a sentence.

Every test runs the real command line in processes of its own, and compares bit for bit with a map that nothing
happened to.
"""

import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import jax
import numpy as np
import pytest
import xarray as xr

from jaxgran import sweep
from jaxgran.dataset import read_dataset
from jaxgran.settings import MapSettings

pytestmark = [
    pytest.mark.faults,
    pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks for processes in /proc"),
]
DRIVER = Path(__file__).with_name("fault_driver.py")
MAP = (
    "map --restitution 0.3,0.7 --packing-fraction 0.6,0.75 --grains 32 --seeds 2 --timestep 1e-3 "
    "--equilibrate 0.5 --strain 40 --batch 2"
)
KILLS = 20
PATIENCE = 120.0


class Lab:
    """A folder for maps, with a cache of compiled programs and the map that nothing happened to."""

    def __init__(self, folder: Path):
        self.folder = folder
        done = self.finish(self.start("whole.nc"))
        assert done.returncode == 0, done.stderr
        self.whole = read_dataset(folder / "whole.nc")

    def start(self, output: str, *words: str, fault: str = "", workers: int = 2) -> subprocess.Popen:
        command = [sys.executable, str(DRIVER), *MAP.split(), "--workers", str(workers), "--output", output, *words]
        environment = os.environ | {"FAULT": fault, "XLA_FLAGS": ""}  # optimised: these maps run more than they compile
        environment.pop("TF_CPP_MIN_LOG_LEVEL", None)  # which JAX has set in this process
        streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, "start_new_session": True}
        return subprocess.Popen(command, cwd=self.folder, env=environment, **streams)

    def finish(self, process: subprocess.Popen) -> subprocess.CompletedProcess:
        out, err = process.communicate(timeout=PATIENCE)
        assert "Traceback" not in err, err
        return subprocess.CompletedProcess(process.args, process.returncode, out, err)

    def wait_for(self, output: str, pattern: str = "journal-*.nc", process: subprocess.Popen | None = None) -> None:
        """Wait until a file of the checkpoint is there."""
        folder, end = self.folder / f"{output}.unfinished", time.monotonic() + PATIENCE
        while not any(folder.glob(pattern)):
            assert time.monotonic() < end and (process is None or process.poll() is None)
            time.sleep(0.02)

    def wait_for_work(self, output: str, process: subprocess.Popen) -> None:
        """Wait until the process has written or removed a journal or a batch, or ended."""
        folder, end = self.folder / f"{output}.unfinished", time.monotonic() + PATIENCE

        def now() -> set[tuple[str, int]]:
            found = set()
            for path in folder.glob("[dj]o*.nc"):
                with suppress(FileNotFoundError):
                    found.add((path.name, path.stat().st_mtime_ns))
            return found

        before = now()
        while now() == before and process.poll() is None:
            assert time.monotonic() < end
            time.sleep(0.02)

    def assert_whole(self, output: str) -> None:
        xr.testing.assert_equal(read_dataset(self.folder / output), self.whole)
        assert not (self.folder / f"{output}.unfinished").exists()
        assert not list((self.folder / output).parent.glob(".*"))  # no temporary files


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Lab:
    return Lab(tmp_path_factory.mktemp("lab"))


def children(process: int) -> list[int]:
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            text = stat.read_text()
        except OSError:
            continue
        if int(text.rsplit(")", 1)[1].split()[1]) == process:
            found.append(int(stat.parent.name))
    return found


def workers_of(process: subprocess.Popen) -> list[int]:
    """The workers of a map, without the process that multiprocessing starts beside them."""

    def words(child: int) -> str:
        try:
            return Path(f"/proc/{child}/cmdline").read_text()
        except OSError:
            return ""

    return [child for child in children(process.pid) if "spawn_main" in words(child)]


@pytest.mark.parametrize("workers", [1, 2])
def test_a_map_that_is_killed_at_random_moments_loses_and_doubles_nothing(lab: Lab, workers: int) -> None:
    rng, maps, kills, known = random.Random(workers), 1, 0, 0
    while kills < KILLS // 2:
        output = f"killed{workers}-{maps}.nc"
        process = lab.start(output, "--resume", "--batch", "1", workers=workers)
        if rng.random() < 0.6:  # in the middle of the work, else at any moment of the start
            lab.wait_for_work(output, process)
            time.sleep(rng.uniform(0, 1.5))
        else:
            time.sleep(rng.uniform(0, 3.0))
        process.kill()
        _, err = process.communicate(timeout=PATIENCE)
        begun = "Ran out of input" not in err  # what Python says of a worker that has only half been started
        assert "Warning" not in err and not (begun and "Traceback" in err), err
        for done in re.findall(r"continued: (\d+) of 8", err):
            assert int(done) >= known  # what is done stays done
            known = int(done)
        kills += process.returncode != 0
        folder = lab.folder / f"{output}.unfinished"
        if (lab.folder / output).exists() and not folder.exists():  # it was faster: the next map
            xr.testing.assert_equal(read_dataset(lab.folder / output), lab.whole)
            maps, known = maps + 1, 0
    done = lab.finish(lab.start(output, "--resume", workers=workers))
    assert done.returncode == 0, done.stderr
    lab.assert_whole(output)


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
    assert lab.finish(lab.start("deadly.nc", "--resume")).returncode == 0
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
    assert lab.finish(lab.start("interrupted.nc", "--resume")).returncode == 0
    lab.assert_whole("interrupted.nc")


@pytest.mark.parametrize("workers", [1, 2])
def test_a_full_disc_is_one_sentence_and_the_map_goes_on_when_there_is_room(lab: Lab, workers: int) -> None:
    output = f"full{workers}.nc"
    done = lab.finish(lab.start(output, fault="disc full", workers=workers))
    assert done.returncode == 1
    *_, last = done.stderr.strip().splitlines()
    assert last.startswith("jaxgran: stopped by the file system, File too large; what is done is in ")
    assert last.endswith("add --resume.")
    assert lab.finish(lab.start(output, "--resume", workers=workers)).returncode == 0
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
    done = lab.finish(lab.start("clock.nc", fault="clock"))
    assert done.returncode == 0, done.stderr
    lab.assert_whole("clock.nc")


def test_a_second_map_on_one_output_is_refused_and_harms_nothing(lab: Lab) -> None:
    first = lab.start("one.nc")
    lab.wait_for("one.nc", "map.nc", first)
    for words in ([], ["--resume"]):
        second = lab.finish(lab.start("one.nc", *words))
        assert second.returncode == 2
        assert second.stderr.count("\n") == 1 and "another process is writing 'one.nc'" in second.stderr
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
