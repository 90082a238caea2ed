"""Work that is shared with a copy of this process, where a second core is free and the process can be copied."""

import os
import sys
import threading
from collections.abc import Callable, Sequence

from jaxgran.environment import usable_cores


def can_be_copied() -> bool:
    """Whether a copy of this process works: it has one thread, and JAX with its threads is not loaded."""
    return sys.platform == "linux" and "jax" not in sys.modules and threading.active_count() == 1


def do_all(tasks: Sequence[Callable[[], object]]) -> None:
    """Call up to 256 tasks, each in this process or in a copy of it, whichever is free first.

    What they return is lost, so they should write files. If the copy fails, this process does all tasks itself, and
    raises what goes wrong.
    """
    if len(tasks) < 2 or usable_cores() < 2 or not can_be_copied():
        for task in tasks:
            task()
        return
    waiting, end = os.pipe()  # the numbers of the tasks that nobody has begun
    os.write(end, bytes(range(len(tasks))))
    os.close(end)

    def do_waiting() -> None:
        while number := os.read(waiting, 1):
            tasks[number[0]]()

    copy = os.fork()
    if copy == 0:
        failed = 1
        try:
            do_waiting()
            failed = 0
        finally:
            os._exit(failed)  # without the end of the other process: its files and its errors are not of the copy
    try:
        do_waiting()
    finally:
        os.close(waiting)
        _, status = os.waitpid(copy, 0)
    if status:
        for task in tasks:
            task()
