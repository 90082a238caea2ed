"""The work of a benchmark on all cores, each task in one of their processes."""

import json
import multiprocessing
from collections.abc import Callable, Hashable, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, TypeVar

from jaxgran.environment import usable_cores
from jaxgran.files import atomic_write

Task = TypeVar("Task", bound=Hashable)


def on_all_cores(
    measured: Callable[[Task], Any],
    tasks: Sequence[Task],
    cost: Callable[[Task], Any],
    folder: Path | None = None,
) -> list[Any]:
    """What is measured of each task, in their order; the dearest begin first.

    A folder keeps the answers as JSON, so that a run that was stopped goes on, see
    ``Output.unfinished``.
    """
    with ProcessPoolExecutor(usable_cores(), multiprocessing.get_context("spawn")) as pool:
        dear_first = sorted(tasks, key=cost, reverse=True)
        done = {task: pool.submit(_answer, measured, task, folder) for task in dear_first}
        try:
            return [done[task].result() for task in tasks]
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def _answer(measured: Callable[[Task], Any], task: Task, folder: Path | None) -> Any:
    if folder is None:
        return measured(task)
    file = folder / f"{task}.json"
    if not file.exists():
        answer = json.dumps(measured(task))
        folder.mkdir(parents=True, exist_ok=True)
        with atomic_write(file) as temporary:
            temporary.write_text(answer)
    return json.loads(file.read_text())
