"""Whatever happens to a map, nothing is lost, nothing is wrong, and what happened is said in a
sentence.

Every test starts the real command line in a process of its own, and compares bit for bit with a map
that nothing happened to.
"""

import os
import random
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import xarray as xr
from command_line import Outcome, assert_one_sentence, jaxgran

from jaxgran.maps.results import open_map

pytestmark = pytest.mark.skipif(
    not Path("/proc/self/stat").exists(), reason="looks for processes in /proc"
)
DRIVER = Path(__file__).with_name("fault_driver.py")
FLOWS = ["--restitution", "0.3,0.7", "--packing-fraction", "0.6", "--grains", "32", "--seeds", "2"]
STRAINS = ["--timestep", "1e-3", "--equilibrate", "3", "--strain", "10"]
MAP = ["map", *FLOWS, *STRAINS]
PATIENCE = 120.0


class Lab:
    """A folder for maps, with the map that nothing happened to."""

    def __init__(self, folder: Path):
        self.folder = folder
        done = self.run_here("whole.nc")
        assert done.status == 0, done.err
        self.whole = open_map(folder / "whole.nc")

    def run_here(self, output: str, *words: str) -> Outcome:
        """Run a map in this process, where nothing happens to it."""
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("jaxgran.plotting.map_figures.save_figures", lambda *_, **__: [])
            patch.setattr("jaxgran.maps.batches.batch_size", lambda *_: 2)
            return jaxgran(self.folder, *MAP, "--workers", "1", "--output", output, *words)

    def start(self, output: str, *words: str, fault: str = "") -> subprocess.Popen:
        """Start a map in a process of its own, as leader of a group of processes."""
        command = [sys.executable, str(DRIVER), *MAP, "--workers", "2", "--output", output, *words]
        environment = os.environ | {"FAULT": fault}
        environment.pop("TF_CPP_MIN_LOG_LEVEL", None)  # which JAX has set in this process
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
        own = {"cwd": self.folder, "env": environment, "start_new_session": True}
        return subprocess.Popen(command, **own, **pipes)

    def finish(self, process: subprocess.Popen) -> subprocess.CompletedProcess:
        out, err = process.communicate(timeout=PATIENCE)
        assert "Traceback" not in err, err
        return subprocess.CompletedProcess(process.args, process.returncode, out, err)

    def wait_for_work(self, output: str, process: subprocess.Popen) -> None:
        """Wait until a file keeps a part of the work, or the process has ended."""
        folder, end = self.folder / f"{output}.unfinished", time.monotonic() + PATIENCE
        while not any(folder.glob("*.npz")) and process.poll() is None:
            assert time.monotonic() < end
            time.sleep(0.02)

    def assert_whole_when_continued(self, output: str) -> None:
        """An unfinished map comes to the bits of the one that nothing happened to."""
        done = self.run_here(output, "--resume")
        assert done.status == 0, done.err
        xr.testing.assert_equal(open_map(self.folder / output), self.whole)
        assert not (self.folder / f"{output}.unfinished").exists()
        assert not list((self.folder / output).parent.glob(".*"))  # no temporary files


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Lab:
    return Lab(tmp_path_factory.mktemp("lab"))


def test_a_map_that_is_killed_at_random_moments_loses_nothing_that_is_done(lab: Lab) -> None:
    rng, known = random.Random(1), 0
    for _ in range(3):
        process = lab.start("killed.nc", "--resume")
        lab.wait_for_work("killed.nc", process)
        time.sleep(rng.uniform(0, 3.0))  # in the start or in the work
        process.kill()
        _, err = process.communicate(timeout=PATIENCE)
        assert "Warning" not in err and "Traceback" not in err, err
        for done in map(int, re.findall(r"continued: (\d+) of 4", err)):
            assert done >= known  # what is done stays done
            known = done
        if process.returncode == 0:  # it was faster
            break
    lab.assert_whole_when_continued("killed.nc")


def test_a_map_that_is_interrupted_tells_the_command_that_continues_it(lab: Lab) -> None:
    process = lab.start("interrupted.nc")
    lab.wait_for_work("interrupted.nc", process)
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does
    assert_tells_what_continues_it(lab.finish(process), 130, "interrupted.nc")
    lab.assert_whole_when_continued("interrupted.nc")


def assert_tells_what_continues_it(
    done: subprocess.CompletedProcess, status: int, output: str
) -> None:
    assert done.returncode == status
    *_, last = done.stderr.strip().splitlines()
    words = last.split("Continue: jaxgran ")[1].split()
    assert words[-1] == "--resume" and words[words.index("--output") + 1] == output


def test_a_full_disc_is_one_sentence_and_the_map_goes_on_when_there_is_room(lab: Lab) -> None:
    done = lab.finish(lab.start("full.nc", fault="disc full"))
    assert done.returncode == 1
    *_, last = done.stderr.strip().splitlines()
    assert last.startswith("jaxgran: stopped by the file system, File too large: 'full.nc")
    assert "; finished batches are in full.nc.unfinished: " in last
    assert last.endswith("add --resume.")
    lab.assert_whole_when_continued("full.nc")


def test_a_second_map_on_one_output_is_refused_and_harms_nothing(lab: Lab) -> None:
    first = lab.start("one.nc")
    lab.wait_for_work("one.nc", first)
    os.killpg(first.pid, signal.SIGSTOP)  # it holds the file as long as it lives
    for words in ([], ["--resume"]):
        second = lab.run_here("one.nc", *words)
        assert_one_sentence(second)
        assert "another process is writing 'one.nc'" in second.err
    os.killpg(first.pid, signal.SIGTERM)  # as Slurm does
    os.killpg(first.pid, signal.SIGCONT)
    assert_tells_what_continues_it(lab.finish(first), 143, "one.nc")
    lab.assert_whole_when_continued("one.nc")
