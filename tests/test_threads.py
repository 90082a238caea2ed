"""Every task is done once, and an error ends all of them."""

import subprocess
import sys
import threading
import time
import traceback

import jax
import jax.numpy as jnp
import pytest

from jaxgran.dynamics.batch import Cancelled, in_threads


@pytest.mark.parametrize("threads", [1, 2, 30])
def test_every_task_is_done_and_every_message_heard_by_the_caller(threads: int) -> None:
    heard = []

    def square(number: int, send) -> int:
        send(number)
        return number * number

    def hear(number: int) -> None:
        heard.append((number, threading.current_thread()))

    done = list(in_threads(square, [(k,) for k in range(20)], threads, hear))
    assert sorted(done) == [(k, k * k) for k in range(20)]
    assert sorted(heard) == [(k, threading.current_thread()) for k in range(20)]


def test_as_many_tasks_run_at_a_time_as_there_are_threads() -> None:
    meeting = threading.Barrier(3, timeout=10)
    assert len(list(in_threads(lambda _: meeting.wait(), [()] * 6, 3, print))) == 6


def test_threads_have_the_precision_of_the_caller() -> None:
    def dtype(send) -> jnp.dtype:
        return jnp.ones(()).dtype

    for x64, expected in ((True, jnp.float64), (False, jnp.float32)):
        with jax.enable_x64(x64):
            assert [found for _, found in in_threads(dtype, [()] * 2, 2, print)] == [expected] * 2


def test_an_error_is_raised_with_its_traceback_and_ends_the_other_tasks() -> None:
    ends = []

    def task(number: int, send) -> None:
        if number == 1:
            raise ValueError("task 1 is wrong")
        try:
            while True:
                send(number)
                time.sleep(0.01)
        except Cancelled:
            ends.append(number)
            raise

    with pytest.raises(ValueError, match="task 1 is wrong") as error:
        list(in_threads(task, [(k,) for k in range(5)], 2, lambda _: None))
    assert traceback.extract_tb(error.value.__traceback__)[-1].name == "task"
    assert ends == [0]


def test_the_threads_end_with_the_generator() -> None:
    def task(number: int, send) -> int:
        while number:
            send(number)
            time.sleep(0.01)
        return number

    before = threading.active_count()
    running = in_threads(task, [(0,), (1,), (2,)], 2, lambda _: None)
    assert next(running) == (0, 0)
    running.close()
    assert threading.active_count() == before


def test_a_command_does_not_wait_for_a_thread_that_still_computes() -> None:
    script = """
import threading, time
from jaxgran.cli.terminal import run_program

threading.Thread(target=time.sleep, args=(100,), name="jaxgran-0").start()

def interrupted(**_):
    print("a sentence")
    raise SystemExit(130)

run_program(interrupted)
"""
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, timeout=50
    )
    assert (done.returncode, done.stdout, done.stderr) == (130, "a sentence\n", "")
