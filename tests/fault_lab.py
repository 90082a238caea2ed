"""A folder in which maps run as processes of the real command line, and things are done to them.

The map that nothing happened to, and what is left to do of the others, run in this process. The other processes have
the cache of the command line, in the folder of the tests: the first of them compiles for all.
"""

import os
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import pytest
import xarray as xr
from command_line import Outcome, jaxgran

from jaxgran.maps.results import open_map

NEEDS_PROC = pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks for processes in /proc")
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
            patch.setattr("jaxgran.plotting.map_figures.save_figures", lambda *_: [])
            patch.setattr("jaxgran.maps.batches.batch_size", lambda *_: 2)
            return jaxgran(self.folder, *MAP, "--workers", "1", "--output", output, *words)

    def start(self, output: str, *words: str, fault: str = "") -> subprocess.Popen:
        """Start a map in a process of its own, as leader of a group of processes."""
        command = [sys.executable, str(DRIVER), *MAP, "--workers", "2", "--output", output, *words]
        environment = os.environ | {"FAULT": fault}
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
        """Wait until the process has written or removed a file of the checkpoint, or ended."""
        folder, end = self.folder / f"{output}.unfinished", time.monotonic() + PATIENCE

        def now() -> set[tuple[str, int]]:
            found = set()
            for path in folder.glob("*.nc"):
                with suppress(FileNotFoundError):
                    found.add((path.name, path.stat().st_mtime_ns))
            return found

        before = now()
        while now() == before and process.poll() is None:
            assert time.monotonic() < end
            time.sleep(0.02)

    def assert_whole(self, output: str) -> None:
        """The map has the bits of the one that nothing happened to, and nothing else is left."""
        xr.testing.assert_equal(open_map(self.folder / output), self.whole)
        assert not (self.folder / f"{output}.unfinished").exists()
        assert not list((self.folder / output).parent.glob(".*"))  # no temporary files

    def assert_whole_when_continued(self, output: str) -> None:
        """An unfinished map comes to the bits of the one that nothing happened to."""
        done = self.run_here(output, "--resume")
        assert done.status == 0, done.err
        self.assert_whole(output)
