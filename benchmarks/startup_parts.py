"""The command line with timers in it, for ``startup``: what the main process spends its time on, as JSON."""

import json
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

SECONDS = dict.fromkeys(("tracing", "compiling", "loading programs", "flows", "figures"), 0.0)
_TRACING = ("/jax/core/compile/jaxpr_trace_duration", "/jax/core/compile/jaxpr_to_mlir_module_duration")
_COMPILING = "/jax/core/compile/backend_compile_duration"


@contextmanager
def counted(part: str) -> Iterator[None]:
    """Count the seconds of a block; what other timers count in it is theirs."""
    others, start = sum(SECONDS.values()), time.perf_counter()
    try:
        yield
    finally:
        SECONDS[part] += time.perf_counter() - start - (sum(SECONDS.values()) - others)


def timed(part: str, function: Callable) -> Callable:
    """The function with its seconds counted."""

    def call(*arguments, **named):
        with counted(part):
            return function(*arguments, **named)

    return call


def listen(event: str, seconds: float, **_) -> None:
    """Count what JAX reports."""
    if event in _TRACING:
        SECONDS["tracing"] += seconds
    elif event == _COMPILING:
        SECONDS["compiling"] += seconds


def put_timers(command: str) -> None:
    """Put timers into the modules that a command uses."""
    if command in ("run", "map"):
        from jax import monitoring

        from jaxgran import programs
        from jaxgran.maps import ratio_map as ratio_map_module

        monitoring.register_event_duration_secs_listener(listen)
        programs._loaded = timed("loading programs", programs._loaded)
        ratio_map_module.advance_batch = timed("flows", ratio_map_module.advance_batch)
    if command in ("map", "plot"):
        from jaxgran.plotting import map_figures

        map_figures.save_figures = timed("figures", map_figures.save_figures)


if __name__ == "__main__":
    from jaxgran.cli.app import main

    put_timers(sys.argv[1])
    try:
        main()
    finally:
        Path(os.environ["STARTUP_PARTS"]).write_text(json.dumps(SECONDS))
