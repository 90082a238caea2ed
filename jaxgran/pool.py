"""Tasks on worker processes that may die: a dead worker is replaced, and its task repeated.

Every worker is a process of its own with one task at a time, so that it is known which task a death has hit. A worker
ends when the process that started it is gone, however that ended. Tasks must be idempotent.
"""

import os
import signal
import threading
from collections import Counter, deque
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context, parent_process
from multiprocessing.connection import Connection
from typing import Any, TypeVar

ATTEMPTS = 3  # workers that a task may kill before it is given up
_POLL_SECONDS = 0.05
T = TypeVar("T")


class Died(Exception):
    """The task has killed its worker ``ATTEMPTS`` times."""


class _Worker:
    """A process with one task at a time, and the pipe through which it sends messages."""

    def __init__(self, initialise: Callable[..., None], arguments: tuple):
        context = get_context("spawn")
        self.messages, sender = context.Pipe(duplex=False)
        self.executor = ProcessPoolExecutor(1, context, _start, (sender, initialise, arguments))
        self._sender = sender  # the process is not started before its first task, and needs it then

    def read(self) -> list[Any]:
        """The messages that have come. They are short, so that a pipe takes them whole or not at all."""
        found = []
        while self.messages.poll():
            found.append(self.messages.recv())
        return found

    def end(self) -> None:
        processes = list((self.executor._processes or {}).values())
        self.executor.shutdown(wait=False, cancel_futures=True)
        for process in processes:
            process.terminate()
        self._sender.close()
        self.messages.close()


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
    """
    waiting, deaths = deque(range(len(tasks))), Counter()
    idle = [_Worker(initialise, arguments) for _ in range(min(workers, len(tasks)))]
    running: dict[Future, tuple[int, _Worker]] = {}
    try:
        while waiting or running:
            while waiting and idle:
                task, worker = waiting.popleft(), idle.pop()
                running[worker.executor.submit(function, *tasks[task])] = task, worker
            done, _ = wait(running, _POLL_SECONDS, FIRST_COMPLETED)
            for _, worker in running.values():
                for message in worker.read():
                    hear(message)
            for future in done:
                task, worker = running.pop(future)
                try:
                    result = future.result()
                except BrokenProcessPool:
                    worker.end()
                    idle.append(_Worker(initialise, arguments))
                    deaths[task] += 1
                    if deaths[task] < ATTEMPTS:
                        waiting.appendleft(task)
                    else:
                        yield task, Died(f"a batch has killed its worker {ATTEMPTS} times")
                else:
                    idle.append(worker)
                    yield task, result
    finally:
        for worker in [*idle, *(worker for _, worker in running.values())]:
            worker.end()


_sender: Connection | None = None


def send(message: Any) -> None:
    """Send a message from a worker to whoever runs the tasks."""
    if _sender is not None:
        _sender.send(message)


def _start(sender: Connection, initialise: Callable[..., None], arguments: tuple) -> None:
    """Set up a worker: Ctrl-C is left to the parent, and nothing outlives it."""
    global _sender
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _sender = sender
    threading.Thread(target=_end_with_parent, daemon=True).start()
    initialise(*arguments)


def _end_with_parent() -> None:
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
