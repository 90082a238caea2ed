"""Tasks for the tests of the pool, in a module that a worker imports in no time."""

import os
import signal
import struct
import time
from pathlib import Path

from jaxgran.maps import pool
from jaxgran.maps.pool import send


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


def die_in_the_middle_of_a_word(folder: str, number: int) -> int:
    """At first, announce a message of a thousand bytes, say four of them, and die."""
    mark = Path(folder) / f"{number}"
    if not mark.exists():
        mark.touch()
        assert pool._parent is not None
        os.write(pool._parent.fileno(), struct.pack("!i", 1000) + b"half")
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def interrupt_itself(number: int) -> int:
    os.kill(os.getpid(), signal.SIGINT)
    return number


class Stubborn(Exception):
    """An exception that no other process can read."""

    def __init__(self, one: int, other: int):
        super().__init__(f"{one} and {other}")


def fail_stubbornly() -> None:
    raise Stubborn(1, 2)


def fail_to_prepare() -> None:
    raise ValueError("nothing is ready")


def die_before_it_begins() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def fail(number: int) -> None:
    raise ValueError(f"task {number} is wrong")
