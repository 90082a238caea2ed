"""How long a call takes: time of the processor, of this process, so that other work on the machine
counts little.
"""

import time
from collections.abc import Callable
from typing import TypeVar

import numpy as np

SHORTEST, MOST_CALLS, LONG = (
    2e-3,
    200,
    0.02,
)  # seconds of a timing, calls in it, seconds of a call that is timed once
Answer = TypeVar("Answer")


def timed(call: Callable[[], Answer], timings: int = 3) -> tuple[float, Answer]:
    """Seconds of a call and what it returned: of one if it is long, else the median of timings of
    many.
    """
    start = time.process_time()
    answer = call()
    once = time.process_time() - start
    if once > LONG:
        return once, answer
    repeats, seconds = int(np.clip(SHORTEST / max(once, 1e-6), 1, MOST_CALLS)), []
    for _ in range(timings):
        start = time.process_time()
        for _ in range(repeats):
            call()
        seconds.append((time.process_time() - start) / repeats)
    return float(np.median(seconds)), answer
