"""Progress of a map on standard error: points done, share of the work, replica-steps per second,
time left.
"""

import math
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from jaxgran.maps.batches import predicted_cost, replica_ids
from jaxgran.maps.replica import Advance, Point, ReplicaId
from jaxgran.maps.settings import MapSettings

_SECONDS_BETWEEN_LINES = 10  # without a terminal
_LEAST_DONE = 0.01  # share of the work before which compilation is most of the time
_MOST_STARTED = 0.95  # largest share that counts as done before a replica is finished


class Meter:
    """How much of a map is done, reported on standard error: a bar on a terminal, lines elsewhere.

    A finished replica counts by its cost. A running one counts by the cost of the strain it has
    been sheared so far, up to ``_MOST_STARTED``, since the strain that it needs is not known in
    advance.

    Args:
      settings: the map.
      costs: relative cost of a replica of each point.
      quiet: whether to report nothing.
      seconds: what all replicas take, as far as it is known before any is run; infinite where it is
        not.
    """

    def __init__(
        self,
        settings: MapSettings,
        costs: Mapping[Point, float],
        quiet: bool,
        seconds: float = math.inf,
    ):
        self.flows, self.costs, self.quiet = settings.flows, costs, quiet
        self.left = Counter(replica.point for replica in replica_ids(settings))  # by point
        self.running: dict[ReplicaId, float] = {}  # share of each replica that has been started
        self.total = sum(count * costs[point] for point, count in self.left.items())
        self.done_steps, self.done_cost, self.resumed_cost = 0.0, 0.0, 0.0
        self.start = self.last_line = time.perf_counter()
        self.seconds = seconds
        self.console = Console(stderr=True, quiet=quiet)
        self.bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            TimeElapsedColumn(),
            console=self.console,
            transient=False,
        )
        self.task = self.bar.add_task(self.first_line(), total=self.total)

    def advanced(self, advance: Advance) -> None:
        """Count the steps of an advance."""
        self.done_steps += float(np.sum(advance.steps))
        columns = np.asarray(advance.timestep).tolist(), np.asarray(advance.steps).tolist()
        for replica, timestep, steps in zip(advance.ids, *columns, strict=True):
            cost = steps * timestep * predicted_cost(self.flows[replica.point], timestep)
            share = self.running.get(replica, 0.0) + cost / self.costs[replica.point]
            self.running[replica] = min(share, _MOST_STARTED)
        self._show()

    def resumed(self, replicas: Iterable[ReplicaId]) -> None:
        """Count the replicas of an earlier run, which the estimate of the time left excludes."""
        for replica in replicas:
            self.left[replica.point] -= 1
            self.resumed_cost += self.costs[replica.point]

    def finished(self, replica: ReplicaId) -> None:
        """Count a finished replica."""
        self.running.pop(replica, None)
        self.left[replica.point] -= 1
        self.done_cost += self.costs[replica.point]
        self._show()

    @property
    def _cost_of_run(self) -> float:
        """Cost of the work of this run so far."""
        return self.done_cost + sum(
            self.costs[replica.point] * share for replica, share in self.running.items()
        )

    def _show(self) -> None:
        if self.console.is_terminal:
            self.bar.update(
                self.task, completed=self.resumed_cost + self._cost_of_run, description=self._line()
            )
        elif time.perf_counter() - self.last_line > _SECONDS_BETWEEN_LINES:
            self.last_line = time.perf_counter()
            self.console.print(self._line(), highlight=False)

    def first_line(self) -> str:
        """The line before anything is done."""
        is_long = 1 <= self.seconds < math.inf
        expected = f", about {duration(self.seconds)} expected" if is_long else ""
        return f"0/{len(self.left)} points, compiling{expected}"

    def _line(self) -> str:
        seconds, done = time.perf_counter() - self.start, self._cost_of_run
        points = sum(seeds == 0 for seeds in self.left.values())
        percent = 100 * (self.resumed_cost + done) / self.total
        whole = max(self.total - self.resumed_cost, 0.0)
        if done > _LEAST_DONE * whole:
            time_left = duration(seconds * max(whole - done, 0.0) / done)
        elif math.isinf(self.seconds):
            time_left = "unknown time"
        else:
            time_left = f"about {duration(self.seconds * whole / self.total)}"
        speed = f"{self.done_steps / seconds:.3g} replica-steps/s"
        done_points = f"{points}/{len(self.left)} points"
        return f"{percent:.0f} % of the work done, {done_points}, {speed}, {time_left} left"


@contextmanager
def progress(
    settings: MapSettings, costs: Mapping[Point, float], quiet: bool, seconds: float = math.inf
) -> Iterator[Meter]:
    """A ``Meter`` that is shown while the block runs, and once more at its end."""
    meter = Meter(settings, costs, quiet, seconds)
    if meter.console.is_terminal and not quiet:
        with meter.bar:
            yield meter
    else:
        meter.console.print(meter.first_line(), highlight=False)
        yield meter
        meter.console.print(meter._line(), highlight=False)


def duration(seconds: float) -> str:
    """A time as hours:minutes:seconds."""
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{seconds:02d}"
