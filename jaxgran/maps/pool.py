"""Tasks on worker processes that may die: a dead worker is replaced, and its task is repeated.

Every worker is a process with one task at a time, so the task of a dead worker is known. One pipe connects it with its
parent, and closes when either of them ends. There are no queues or semaphores that a killed process could leave behind.
A worker ends when the process that started it has ended for any reason. Tasks may run more than once and must then give
the same result.
"""

import os
import pickle
import signal
import sys
import threading
import traceback
from collections import Counter, deque
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager, suppress
from multiprocessing import current_process, get_context, parent_process
from multiprocessing.connection import Connection, wait
from typing import Any, TypeVar

from jaxgran.model.checks import InputError

_UNGUARDED = 97  # exit status of a worker that begins with the script of its parent, down to the start of workers
_GUARDED = 'its main part under if __name__ == "__main__":'
_LAST_WORDS = 1.0  # seconds from the end of a worker's pipe to its exit
ATTEMPTS = 3  # workers that may die of a task before it is given up
_READY = "ready"
_MESSAGE = "message"
_RESULT = "result"
_ERROR = "error"
_DEAD = "dead"
T = TypeVar("T")


def require_processes() -> None:
    """Raise an InputError where this process cannot start workers.

    A worker imports the script of its parent before it has a task. If that script starts workers again, since its main
    part is not guarded, the worker ends, and its parent raises an InputError.
    """
    process = current_process()
    if getattr(process, "_inheriting", False):  # what ``multiprocessing`` sets while a process imports that script
        raise SystemExit(_UNGUARDED)
    if process.daemon:
        raise InputError(
            "workers must be 1 in a daemonic process, such as those of multiprocessing.Pool: the processes of "
            "concurrent.futures.ProcessPoolExecutor may have workers."
        )
    if str(getattr(sys.modules["__main__"], "__file__", "")).startswith("<"):
        raise InputError(
            f"workers must be 1 in a program that is read from standard input: save it as a file, with {_GUARDED}."
        )


class WorkerDied(Exception):
    """A task was given up, since its workers died ``ATTEMPTS`` times."""


class _Worker:
    """A process that receives the arguments of one task after another."""

    def __init__(self, function: Callable, initialise: Callable[..., None], arguments: tuple):
        context = get_context("spawn")
        self.ready = False
        self.task: int | None = None
        self.connection, theirs = context.Pipe()
        self.process = context.Process(target=_work, args=(theirs, function, initialise, arguments), daemon=True)
        with (
            theirs,
            _no_interrupt(),
        ):  # this copy of the worker's end is closed, so that the pipe closes with the worker
            self.process.start()

    def begin(self, task: int, arguments: tuple) -> None:
        self.task = task
        with suppress(OSError):  # the worker may have just died
            self.connection.send(arguments)

    def receive(self) -> tuple[str, Any]:
        """Kind and content of the next message; ``_DEAD`` if the worker died, also in the middle of a message."""
        try:
            return self.connection.recv()
        except (EOFError, OSError):
            return _DEAD, None

    def exit_status(self) -> int | None:
        """The exit status of a worker that has closed its pipe."""
        self.process.join(_LAST_WORDS)
        return self.process.exitcode

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
    on_message: Callable[[Any], None],
) -> Generator[tuple[int, T | WorkerDied]]:
    """Run a function on the arguments of every task, started in order, and yield each result when it is there.

    Args:
      function: a function that a worker can import.
      tasks: arguments of each call.
      workers: number of processes.
      initialise, arguments: a function and its arguments, called once in every worker.
      on_message: called with every message of a worker, see ``send``.

    Yields:
      The number of the task, and its result or ``WorkerDied``.

    Raises:
      ChildProcessError: workers die before they have a task.
      InputError: the script of this process starts workers outside of its main part.
      Exception: that of a task, with the traceback of the worker as a note.
    """
    waiting = deque(range(len(tasks)))
    unfinished = len(tasks)
    deaths = Counter()  # of workers, by task
    early_deaths = 0  # of workers in a row that never became ready
    running: list[_Worker] = []
    try:
        while unfinished:
            while len(running) < min(workers, unfinished):
                running.append(_Worker(function, initialise, arguments))
            for worker in running:
                if waiting and worker.ready and worker.task is None:
                    task = waiting.popleft()
                    worker.begin(task, tasks[task])
            readable = wait([worker.connection for worker in running])
            for worker in [one for one in running if one.connection in readable]:
                kind, content = worker.receive()
                task = worker.task
                if kind == _MESSAGE:
                    on_message(content)
                elif kind == _READY:
                    worker.ready, early_deaths = True, 0
                elif kind == _ERROR:
                    raise content
                elif kind == _RESULT and task is not None:
                    worker.task, unfinished = None, unfinished - 1
                    yield task, content
                else:
                    if worker.exit_status() == _UNGUARDED:
                        raise InputError(f"workers must be 1 in this script, or it must have {_GUARDED}.")
                    running.remove(worker)
                    worker.end()
                    early_deaths += not worker.ready
                    if early_deaths == ATTEMPTS:
                        raise ChildProcessError(f"{ATTEMPTS} workers in a row died before they had a task")
                    if task is None:
                        continue
                    deaths[task] += 1
                    if deaths[task] < ATTEMPTS:
                        waiting.appendleft(task)
                    else:
                        unfinished -= 1
                        yield task, WorkerDied(f"a batch has killed its worker {ATTEMPTS} times")
    finally:
        for worker in running:
            worker.end()


_parent: Connection | None = None  # of a worker: its end of the pipe


def send(message: Any) -> None:
    """Send a message from a worker to the process that runs the tasks; no effect outside a worker."""
    if _parent is not None:
        _parent.send((_MESSAGE, message))


def _work(parent: Connection, function: Callable, initialise: Callable[..., None], arguments: tuple) -> None:
    """Main function of a worker: it ignores Ctrl-C, runs tasks, and ends with its parent."""
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
    """The error with its traceback as a note; a RuntimeError of its name and message if it cannot be pickled."""
    error.add_note(f"in a worker:\n{''.join(traceback.format_exception(error))}")
    try:
        return pickle.loads(pickle.dumps(error))
    except Exception:
        return RuntimeError(f"{type(error).__name__}: {error}")


def _end_with_parent() -> None:
    """Wait for the end of the parent process, then end this one."""
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


@contextmanager
def _no_interrupt() -> Iterator[None]:
    """Block Ctrl-C while a process starts. The process inherits the block, so Ctrl-C cannot end it with a traceback."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
