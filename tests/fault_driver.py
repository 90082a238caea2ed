"""The command line with a fault built in, chosen by the environment variable FAULT."""

import os
import resource
import signal
import sys
import time
from types import SimpleNamespace
from typing import Any

# as the command line does, before JAX is imported
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")

from jaxgran.maps import batches, blocks, run

# Seconds between two blocks of a sample: a small map then lasts until something happens to it
PAUSE = 0.04
blocks.SECONDS = 0.1  # so that its batches keep their blocks
batches.batch_size = lambda *_: 2
# Drawing takes as long as such a map.
figures: Any = SimpleNamespace(save_figures=lambda *_, **__: [], pictures_beside=lambda _: set())
modules: dict[str, Any] = sys.modules
modules["jaxgran.plotting.map_figures"] = figures
advance_batch = run.advance_batch
FAULT = os.environ.get("FAULT", "")


def advance_slowly(*arguments):
    time.sleep(PAUSE)
    return advance_batch(*arguments)


run.advance_batch = advance_slowly

if FAULT == "disc full":
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    most = 80_000  # bytes; more than a replica, less than a map
    resource.setrlimit(resource.RLIMIT_FSIZE, (most, most))

if __name__ == "__main__":
    from jaxgran.cli.app import program

    # a shell ignores it for what it runs in the background
    signal.signal(signal.SIGINT, signal.default_int_handler)

    program()
