"""Ctrl-C while compiled code runs: the wait for its results ends at once, and the numba engine
stops.
"""

import time
from typing import TypeVar

import jax

from jaxgran.dynamics.numba_engine.ffi import engines_stopped

PATIENCE = 0.5  # seconds; longest wait for the end of what was interrupted
T = TypeVar("T")


def block_until_done(results: T) -> T:
    """The results when they are computed.

    A KeyboardInterrupt, as by Ctrl-C, stops every run of the numba engine in this process within
    one step. The engine ``Jax`` cannot be stopped: it finishes in the background, and its results
    are discarded.
    """
    try:
        return jax.block_until_ready(results)
    except KeyboardInterrupt:
        with engines_stopped():
            _wait(results)
        raise


def _wait(results: object) -> None:
    end = time.monotonic() + PATIENCE
    arrays = [leaf for leaf in jax.tree.leaves(results) if hasattr(leaf, "is_ready")]
    while time.monotonic() < end and not all(array.is_ready() for array in arrays):
        time.sleep(0.01)
