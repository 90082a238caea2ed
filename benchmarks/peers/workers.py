"""What the process of a peer does, so that none feels the memory, the threads or the garbage of
another. Runs go by a number.
"""

import time
from importlib import import_module

from benchmarks.peers.problem import Discs, Flow, Run, Stress, deepest

_runs: dict[int, Run] = {}


def begin(
    key: int, peer: str, discs: Discs, flow: Flow, curve: str, setting: float, duration: float
) -> None:
    """Begin a run of a peer, past a first round that is left out."""
    _runs[key] = import_module(peer).begin(discs, flow, curve, setting, duration)
    _runs[key].advance()


def advance(key: int) -> tuple[Stress, float, float]:
    """Stresses of one round, its seconds of the processor, and the largest overlap at its end."""
    start = time.process_time()
    stress = _runs[key].advance()
    return stress, time.process_time() - start, deepest(_runs[key].discs())


def close(key: int) -> None:
    """End a run."""
    _runs.pop(key).close()
