"""Tasks in threads of this process: compiled programs run without the interpreter's lock, so
threads use all cores.
"""

import time
from collections.abc import Callable, Generator, Iterable, Sequence
from queue import SimpleQueue
from threading import Event, Thread
from typing import Any, TypeVar

import jax

from jaxgran.dynamics.interruption import PATIENCE, engines_stopped

_MESSAGE, _RESULT, _ERROR = range(3)
Send = Callable[[Any], None]
T = TypeVar("T")


class Cancelled(BaseException):
    """Raised by the ``send`` of a task whose result is no longer wanted."""


def in_threads(
    function: Callable[..., T], tasks: Sequence[tuple], threads: int, on_message: Send
) -> Generator[tuple[int, T]]:
    """Run a function on the arguments of every task, started in order, and yield each result when
    it is there.

    When the generator ends early, each thread ends at its next message. Ctrl-C also stops the numba
    engine, within one step. A thread that takes longer, as for a compilation, is left behind;
    Python ends after it.

    Args:
      function: called with the arguments of a task and ``send``. A long task calls ``send`` after
        each of its parts, before it uses what the part returned: a part that was stopped has no
        valid results, and ``send`` then raises.
      tasks: arguments of each call.
      threads: most threads at a time.
      on_message: called with everything that is sent, in the thread of the caller.

    Yields:
      The number of the task, and its result.

    Raises:
      BaseException: that of a task, with its traceback.
    """
    waiting, cancelled = iter(list(enumerate(tasks))), Event()  # the threads share this iterator
    events: SimpleQueue[tuple[int, Any]] = SimpleQueue()
    config: Any = jax.config
    x64, device = config.jax_enable_x64, config.jax_default_device

    def send(message: Any) -> None:
        if cancelled.is_set():
            raise Cancelled
        events.put((_MESSAGE, message))

    def work() -> None:
        with jax.enable_x64(x64), jax.default_device(device):  # each thread has its own
            for number, arguments in waiting:
                try:
                    events.put((_RESULT, (number, function(*arguments, send))))
                except BaseException as error:
                    events.put((_ERROR, error))
                    return

    running = [Thread(target=work, name=f"jaxgran-{k}") for k in range(min(threads, len(tasks)))]
    for thread in running:
        thread.start()
    unfinished = len(tasks)
    try:
        while unfinished:
            kind, content = events.get()
            if kind == _ERROR:
                raise content
            if kind == _MESSAGE:
                on_message(content)
            else:
                unfinished -= 1
                yield content
    except KeyboardInterrupt:
        cancelled.set()
        with engines_stopped():
            _join(running)
        raise
    finally:
        cancelled.set()
        _join(running)


def _join(threads: Iterable[Thread]) -> None:
    """Wait for the end of the threads, but not for long."""
    end = time.monotonic() + PATIENCE
    for thread in threads:
        thread.join(max(0.0, end - time.monotonic()))
