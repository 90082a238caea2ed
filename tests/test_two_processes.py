"""Work is shared with a copy of a process without JAX; whatever happens to the copy, all of it is done."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from jaxgran.environment import usable_cores
from jaxgran.plotting.two_processes import do_all

SCRIPT = """
import os, sys, time
from functools import partial
from pathlib import Path
from jaxgran.plotting.two_processes import can_be_copied, do_all

assert can_be_copied()
first, fails = os.getpid(), sys.argv[1]

def task(number):
    if fails == "both" or fails == "copy" and os.getpid() != first:
        Path("failed").touch()
        raise OSError(28, "No space left on device")
    while fails == "copy" and not Path("failed").exists():
        time.sleep(0.01)  # until the copy has failed
    with open(f"task{number}", "a") as file:
        file.write(f"{os.getpid()} ")
    while fails == "none" and len({path.read_text() for path in Path().glob("task*")} - {""}) < 2:
        time.sleep(0.01)  # until the other process has begun a task

do_all([partial(task, number) for number in range(4)])
"""


@pytest.fixture
def copied() -> None:
    if sys.platform != "linux" or usable_cores() < 2:
        pytest.skip("the process is not copied")


def done(folder: Path, fails: str) -> tuple[subprocess.CompletedProcess, list[list[str]]]:
    """What came of four tasks in a process of their own, and the processes that did each of those begun."""
    ended = subprocess.run(
        [sys.executable, "-c", SCRIPT, fails], cwd=folder, capture_output=True, text=True, timeout=120
    )
    return ended, [path.read_text().split() for path in sorted(folder.glob("task*"))]


@pytest.mark.usefixtures("copied")
def test_every_task_is_done_once_and_both_processes_take_some(tmp_path: Path) -> None:
    ended, processes = done(tmp_path, "none")
    assert (ended.returncode, ended.stderr) == (0, "")
    assert [len(one) for one in processes] == [1] * 4
    assert len({one[0] for one in processes}) == 2


@pytest.mark.usefixtures("copied")
def test_tasks_of_a_copy_that_fails_are_done_by_the_process_itself(tmp_path: Path) -> None:
    ended, processes = done(tmp_path, "copy")
    assert ended.returncode == 0
    assert len(processes) == 4 and len({process for one in processes for process in one}) == 1


@pytest.mark.usefixtures("copied")
def test_what_goes_wrong_in_both_is_raised(tmp_path: Path) -> None:
    ended, processes = done(tmp_path, "both")
    assert ended.returncode == 1 and "No space left on device" in ended.stderr.splitlines()[-1]
    assert processes == []


def test_a_process_with_jax_does_all_itself_in_order(monkeypatch: pytest.MonkeyPatch) -> None:
    called: list[int] = []
    monkeypatch.setattr(os, "fork", lambda: called.append(-1))
    do_all([lambda number=number: called.append(number) for number in range(3)])
    assert "jax" in sys.modules and called == [0, 1, 2]
