"""A process for each peer, so that none feels the memory, the threads or the garbage of another.

The main process asks one of them at a time, and all share one core.
"""

import multiprocessing
import time
from concurrent.futures import ProcessPoolExecutor
from importlib import import_module
from types import ModuleType

from benchmarks.peers.problem import Discs, Flow, Run, Stress, overlaps

_peer: ModuleType
_runs: dict[int, Run] = {}


class Worker:
    """The process of one peer: ``peer`` is the name of its module. Calls wait for their results."""

    def __init__(self, peer: str) -> None:
        self.peer = peer
        context = multiprocessing.get_context("spawn")
        self._pool = ProcessPoolExecutor(1, context, initializer=_initialise, initargs=(peer,))

    def begin(
        self, key: int, discs: Discs, flow: Flow, curve: str, setting: float, duration: float
    ) -> None:
        """Begin a run, which goes by the key from now on."""
        self._pool.submit(_begin, key, discs, flow, curve, setting, duration).result()

    def advance(self, key: int) -> tuple[Stress, tuple[float, float]]:
        """Stresses of one advance, and its seconds by the clock and of the processor."""
        return self._pool.submit(_advance, key).result()

    def overlaps(self, key: int) -> tuple[float, float]:
        """Mean and largest overlap at present."""
        return self._pool.submit(_overlaps, key).result()

    def close(self, key: int) -> None:
        """End a run."""
        self._pool.submit(_close, key).result()

    def shutdown(self) -> None:
        """End the process."""
        self._pool.shutdown()


def _initialise(peer: str) -> None:
    global _peer
    _peer = import_module(f"benchmarks.peers.{peer}")


def _begin(key: int, *arguments) -> None:
    _runs[key] = _peer.begin(*arguments)


def _advance(key: int) -> tuple[Stress, tuple[float, float]]:
    wall, cpu = time.perf_counter(), time.process_time()
    stress = _runs[key].advance()
    return stress, (time.perf_counter() - wall, time.process_time() - cpu)


def _overlaps(key: int) -> tuple[float, float]:
    return overlaps(_runs[key].discs())


def _close(key: int) -> None:
    _runs.pop(key).close()
