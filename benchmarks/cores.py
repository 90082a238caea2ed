"""The work of a benchmark on all cores, each task in one of their processes."""

import multiprocessing
from collections.abc import Callable, Hashable, Sequence
from concurrent.futures import ProcessPoolExecutor
from typing import Any, TypeVar

from jaxgran.environment import usable_cores

Task = TypeVar("Task", bound=Hashable)
Answer = TypeVar("Answer")


def on_all_cores(
    measured: Callable[[Task], Answer], tasks: Sequence[Task], cost: Callable[[Task], Any]
) -> list[Answer]:
    """What is measured of each task, in their order; the dearest begin first."""
    with ProcessPoolExecutor(usable_cores(), multiprocessing.get_context("spawn")) as pool:
        dear_first = sorted(tasks, key=cost, reverse=True)
        done = {task: pool.submit(measured, task) for task in dear_first}
        return [done[task].result() for task in tasks]
