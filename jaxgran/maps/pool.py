"""Tasks on worker processes that may die: a dead worker is replaced, and its task repeated.

Every worker is a process of its own with one task at a time, so that it is known which task a death has hit. All that
connects it with its parent is one pipe, which ends with either of them; there are no queues, threads or semaphores that
a killed process could leave behind. A worker ends when the process that started it is gone, however that ended. Tasks
must be idempotent.
"""

import os
import pickle
import signal
import threading
import traceback
from collections import Counter, deque
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager, suppress
from multiprocessing import get_context, parent_process
from multiprocessing.connection import Connection, wait
from typing import Any, TypeVar

ATTEMPTS = 3  # workers that a task may kill before it is given up
_READY, _MESSAGE, _RESULT, _ERROR, _DEAD = "ready", "message", "result", "error", "dead"
T = TypeVar("T")


class Died(Exception):
    """The task has killed its worker ``ATTEMPTS`` times."""


class _Worker:
    """A process that is sent the arguments of one task after another."""

    def __init__(self, function: Callable, initialise: Callable[..., None], arguments: tuple):
        context = get_context("spawn")
        self.ready = False
        self.task: int | None = None
        self.connection, theirs = context.Pipe()
        self.process = context.Process(target=_work, args=(theirs, function, initialise, arguments), daemon=True)
        with theirs, _no_interrupt():  # their end is closed here, so that the pipe ends with the worker
            self.process.start()

    def begin(self, task: int, arguments: tuple) -> None:
        self.task = task
        with suppress(OSError):  # of a worker that has died in this moment
            self.connection.send(arguments)

    def says(self) -> tuple[str, Any]:
        """What it says next, which is nothing where it has died, even in the middle of a word."""
        try:
            return self.connection.recv()
        except (EOFError, OSError):
            return _DEAD, None

    def end(self) -> None:
        self.process.kill()
        self.process.join()
        self.process.close()
        self.connection.close()


def run_tasks(
    function: Callable[..., T],
    tasks: Sequence[tuple],
    workers: int,
    initialise: Callable[..., None],
    arguments: tuple,
    hear: Callable[[Any], None],
) -> Generator[tuple[int, T | Died]]:
    """Run a function on the arguments of every task, in the order of the tasks, and yield what is done as it is.

    Args:
      function: importable by a worker.
      tasks: arguments of each call.
      workers: processes.
      initialise, arguments: called once in every worker.
      hear: told the messages that workers ``send``.

    Yields:
      The number of the task, and its result or ``Died``. An exception of a task is raised here.

    Raises:
      ChildProcessError: workers die before they have a task.
    """
    waiting, deaths, stillborn, left = deque(range(len(tasks))), Counter(), 0, len(tasks)
    crew: list[_Worker] = []
    try:
        while left:
            while len(crew) < min(workers, left):
                crew.append(_Worker(function, initialise, arguments))
            for worker in crew:
                if waiting and worker.ready and worker.task is None:
                    task = waiting.popleft()
                    worker.begin(task, tasks[task])
            speaking = wait([worker.connection for worker in crew])
            for worker in [one for one in crew if one.connection in speaking]:
                kind, content = worker.says()
                task = worker.task
                if kind == _MESSAGE:
                    hear(content)
                elif kind == _READY:
                    worker.ready, stillborn = True, 0
                elif kind == _ERROR:
                    raise content
                elif kind == _RESULT and task is not None:
                    worker.task, left = None, left - 1
                    yield task, content
                else:
                    crew.remove(worker)
                    worker.end()
                    stillborn += not worker.ready
                    if stillborn == ATTEMPTS:
                        raise ChildProcessError(f"{ATTEMPTS} workers in a row died before they had a task")
                    if task is None:
                        continue
                    deaths[task] += 1
                    if deaths[task] < ATTEMPTS:
                        waiting.appendleft(task)
                    else:
                        left -= 1
                        yield task, Died(f"a batch has killed its worker {ATTEMPTS} times")
    finally:
        for worker in crew:
            worker.end()


_parent: Connection | None = None


def send(message: Any) -> None:
    """Send a message from a worker to whoever runs the tasks."""
    if _parent is not None:
        _parent.send((_MESSAGE, message))


def _work(parent: Connection, function: Callable, initialise: Callable[..., None], arguments: tuple) -> None:
    """The life of a worker: Ctrl-C is left to the parent, and nothing outlives it."""
    global _parent
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    _parent = parent
    try:
        initialise(*arguments)
        parent.send((_READY, None))
        while True:
            task = parent.recv()
            parent.send((_RESULT, function(*task)))
    except Exception as error:
        with suppress(OSError):
            parent.send((_ERROR, _portable(error)))


def _portable(error: Exception) -> Exception:
    """The error with where it came from as a note, or what can be said of it where it cannot be pickled."""
    error.add_note(f"in a worker:\n{''.join(traceback.format_exception(error))}")
    try:
        return pickle.loads(pickle.dumps(error))
    except Exception:
        return RuntimeError(f"{type(error).__name__}: {error}")


def _end_with_parent() -> None:
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


@contextmanager
def _no_interrupt() -> Iterator[None]:
    """Hold Ctrl-C back while a process starts, which inherits this and does not die of it with a traceback."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
