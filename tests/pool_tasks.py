"""Tasks for the tests of the pool, in a module that a worker imports in no time."""

import os
import signal
import time
from pathlib import Path

from jaxgran.pool import send


def prepare() -> None:
    """Nothing to set up."""


def square(number: int) -> int:
    send(number)
    return number * number


def process_id(seconds: float) -> int:
    time.sleep(seconds)
    return os.getpid()


def die_at_first(folder: str, number: int, deaths: int) -> int:
    """Kill the own process a number of times, and count on disc how often."""
    for k in range(deaths):
        mark = Path(folder) / f"{number}-{k}"
        if not mark.exists():
            mark.touch()
            os.kill(os.getpid(), signal.SIGKILL)
    return number


def fail(number: int) -> None:
    raise ValueError(f"task {number} is wrong")
