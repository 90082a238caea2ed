"""The process that a benchmark runs in: settings of JAX, which it reads when it starts."""

import os
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
ONE_CORE = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"


def set_up(one_core: bool) -> None:
    """Double precision, and where it is asked for one core, for this process and all that it
    starts.
    """
    if "jax" in sys.modules:
        raise RuntimeError("JAX has been imported before it was set up.")
    os.environ["JAX_ENABLE_X64"] = "1"
    if one_core:
        os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {ONE_CORE}".strip()
        os.environ["OMP_NUM_THREADS"] = "1"
