"""Progress of a map on standard error: points done, replica-steps per second, time left."""

import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import TypeVar

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

_SECONDS_BETWEEN_LINES = 10  # without a terminal
_T = TypeVar("_T")


class Meter:
    """Counts finished replicas and reports on standard error: a bar on a terminal, lines elsewhere.

    Args:
      costs: relative cost of a replica of each point.
      seeds: replicas of each point.
      quiet: whether to report nothing.
    """

    def __init__(self, costs: list[float], seeds: int, quiet: bool):
        self.costs, self.seeds, self.quiet = costs, seeds, quiet
        self.left = [seeds] * len(costs)
        self.done_steps, self.done_cost, self.known_cost = 0.0, 0.0, 0.0
        self.start = self.last_line = time.perf_counter()
        self.console = Console(stderr=True, quiet=quiet)
        self.bar = Progress(
            TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), console=self.console, transient=False
        )
        self.task = self.bar.add_task("compiling", total=sum(costs) * seeds)

    def steps(self, steps: float) -> None:
        """Count replica-steps."""
        self.done_steps += steps
        self._show()

    def resumed(self, points: Iterable[int]) -> None:
        """Count the replicas of an earlier run, by their points; the estimate of the time left leaves them out."""
        for point in points:
            self.left[point] -= 1
            self.known_cost += self.costs[point]

    def replica(self, point: int) -> None:
        """Count a finished replica of a point."""
        self.left[point] -= 1
        self.done_cost += self.costs[point]
        self._show()

    def _show(self) -> None:
        if self.console.is_terminal:
            self.bar.update(self.task, completed=self.known_cost + self.done_cost, description=self._line())
        elif time.perf_counter() - self.last_line > _SECONDS_BETWEEN_LINES:
            self.last_line = time.perf_counter()
            self.console.print(self._line(), highlight=False)

    def _line(self) -> str:
        seconds = time.perf_counter() - self.start
        points = sum(left == 0 for left in self.left)
        share = self.done_cost / max(sum(self.costs) * self.seeds - self.known_cost, 1e-9)
        left = f"{_duration(seconds / share - seconds)} left" if share > 0 else "estimating the time left"
        return f"{points}/{len(self.costs)} points, {self.done_steps / seconds:.3g} replica-steps/s, {left}"


@contextmanager
def progress(costs: list[float], seeds: int, quiet: bool) -> Iterator[Meter]:
    """A ``Meter`` that is shown while the block runs, and once more at its end."""
    meter = Meter(costs, seeds, quiet)
    if meter.console.is_terminal and not quiet:
        with meter.bar:
            yield meter
    else:
        meter.console.print(f"0/{len(costs)} points, compiling", highlight=False)
        yield meter
        meter.console.print(meter._line(), highlight=False)


def counted(items: Sequence[_T], words: str) -> Iterator[_T]:
    """The items one by one, with a progress bar on a terminal; ``words`` is its title."""
    console = Console(stderr=True)
    columns = TextColumn(words), BarColumn(), TextColumn("{task.completed}/{task.total}"), TimeElapsedColumn()
    with Progress(*columns, console=console, disable=not console.is_terminal) as bar:
        yield from bar.track(items)


def _duration(seconds: float) -> str:
    """A time as hours:minutes:seconds."""
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{seconds:02d}"
