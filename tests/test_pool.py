"""Every task is done once whatever happens to its worker, and no worker outlives its parent."""

import os
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pool_tasks
import pytest

from jaxgran.maps import pool
from jaxgran.maps.pool import ATTEMPTS, WorkerDied, run_tasks
from jaxgran.model.checks import InputError


def run(function, tasks, workers: int = 2, hear=lambda _: None) -> dict:
    """Results by task, each of which is yielded once."""
    yielded = list(run_tasks(function, tasks, workers, pool_tasks.prepare, (), hear))
    assert len({number for number, _ in yielded}) == len(yielded)
    return dict(yielded)


def is_alive(process: int) -> bool:
    try:
        return Path(f"/proc/{process}/stat").read_text().split(") ")[1][0] != "Z"
    except OSError:
        return False


def gone(processes: list[int], patience: float = 10.0) -> bool:
    """Whether the processes end within some seconds."""
    end = time.monotonic() + patience
    while time.monotonic() < end and any(map(is_alive, processes)):
        time.sleep(0.05)
    return not any(map(is_alive, processes))


def test_every_task_is_done_and_every_message_heard() -> None:
    heard: list[int] = []
    assert run(pool_tasks.square, [(k,) for k in range(20)], hear=heard.append) == {k: k * k for k in range(20)}
    assert sorted(heard) == list(range(20))


STARTS_WORKERS = """
from jaxgran.maps.pool import require_processes, run_tasks
require_processes()
list(run_tasks(print, [(1,), (2,)], 2, print, (), print))
"""


def test_a_script_without_a_guarded_main_part_is_told_so(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(STARTS_WORKERS)
    done = subprocess.run([sys.executable, str(script)], capture_output=True, text=True)
    assert done.stderr.count("Traceback") == 1
    last = done.stderr.splitlines()[-1]
    assert last.endswith(
        'InputError: workers must be 1 in this script, or it must have its main part under if __name__ == "__main__":.'
    )


def test_a_program_from_standard_input_is_told_to_be_a_file() -> None:
    done = subprocess.run([sys.executable], input=STARTS_WORKERS, capture_output=True, text=True)
    assert "workers must be 1 in a program that is read from standard input: save it as a file" in done.stderr


def test_a_daemonic_process_has_no_workers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pool, "current_process", lambda: SimpleNamespace(daemon=True))
    with pytest.raises(InputError, match=r"^workers must be 1 in a daemonic process"):
        pool.require_processes()


def test_a_dead_worker_is_replaced_and_its_task_repeated(tmp_path: Path) -> None:
    tasks = [(str(tmp_path), k, ATTEMPTS - 1 if k in (1, 4) else 0) for k in range(6)]
    assert run(pool_tasks.die_at_first, tasks) == {k: k for k in range(6)}


def test_a_worker_that_dies_in_the_middle_of_a_word_is_replaced(tmp_path: Path) -> None:
    tasks = [(str(tmp_path), k) for k in range(3)]
    assert run(pool_tasks.die_in_the_middle_of_a_word, tasks) == {k: k for k in range(3)}


def test_a_task_that_keeps_killing_its_worker_is_given_up_and_the_others_are_done(tmp_path: Path) -> None:
    tasks = [(str(tmp_path), k, 99 if k == 1 else 0) for k in range(6)]
    results = run(pool_tasks.die_at_first, tasks)
    assert isinstance(results.pop(1), WorkerDied)
    assert results == {k: k for k in (0, 2, 3, 4, 5)}
    assert len(list(tmp_path.iterdir())) == ATTEMPTS


def test_a_mistake_in_a_task_is_raised() -> None:
    with pytest.raises(ValueError, match="task 0 is wrong"):
        run(pool_tasks.fail, [(0,)])


def test_a_mistake_that_cannot_be_sent_is_told_in_words() -> None:
    with pytest.raises(RuntimeError, match="Stubborn: 1 and 2"):
        run(pool_tasks.fail_stubbornly, [()])


def test_a_mistake_in_the_preparation_is_raised_and_workers_that_die_of_it_are_not_replaced_forever() -> None:
    for prepare, error, words in (
        (pool_tasks.fail_to_prepare, ValueError, "nothing is ready"),
        (pool_tasks.die_before_it_begins, ChildProcessError, "3 workers in a row"),
    ):
        with pytest.raises(error, match=words):
            list(run_tasks(pool_tasks.square, [(k,) for k in range(9)], 2, prepare, (), lambda _: None))


def test_an_interrupt_is_left_to_the_parent() -> None:
    assert run(pool_tasks.interrupt_itself, [(k,) for k in range(3)]) == {k: k for k in range(3)}


def test_no_tasks_need_no_workers() -> None:
    assert run(pool_tasks.square, []) == {}


@pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="looks for open files in /proc")
def test_nothing_stays_open(tmp_path: Path) -> None:
    counts = []
    for name in ("one", "other"):  # the first also starts what looks after the processes
        (tmp_path / name).mkdir()
        run(pool_tasks.die_at_first, [(str(tmp_path / name), k, 1) for k in range(3)])
        counts.append(len(list(Path("/proc/self/fd").iterdir())))
    assert counts[0] == counts[1]


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks for processes in /proc")
def test_workers_end_with_the_iterator() -> None:
    running = run_tasks(pool_tasks.process_id, [(0.0,), (30.0,), (30.0,)], 2, pool_tasks.prepare, (), lambda _: None)
    _, process = next(running)
    start = time.monotonic()
    running.close()
    assert time.monotonic() - start < 5 and gone([process])


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks for processes in /proc")
def test_no_worker_outlives_a_parent_that_is_killed_nor_says_a_word_about_it() -> None:
    script = """
import pool_tasks, sys
from jaxgran.maps.pool import run_tasks
if __name__ == "__main__":
    tasks = [(0.5,), (0.5,), (60,), (60,)]
    for _, process in run_tasks(pool_tasks.process_id, tasks, 2, pool_tasks.prepare, (), print):
        print(process, flush=True)
"""
    pipe = subprocess.PIPE
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    parent = subprocess.Popen([sys.executable, "-c", script], stdout=pipe, stderr=pipe, text=True, env=environment)
    assert parent.stdout is not None
    workers = [int(parent.stdout.readline()) for _ in range(2)]
    assert all(map(is_alive, workers))
    parent.kill()
    _, err = parent.communicate(timeout=10)
    assert err == ""
    assert gone(workers)
