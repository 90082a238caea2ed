"""Tasks on the workers of a running Dask cluster, on this machine or started by Slurm.

The cluster replaces workers that die and repeats their tasks. It gives up on a task whose workers have died too often.
"""

from collections.abc import Callable, Generator, Sequence
from typing import Any, TypeVar

import jax

from jaxgran.model.checks import InputError

T = TypeVar("T")
_PATIENCE = "10s"  # longest wait for an answer of the scheduler


def run_on_cluster(address: str, function: Callable[..., T], tasks: Sequence[tuple]) -> Generator[tuple[int, T | None]]:
    """Run a function on the arguments of every task on a cluster, with the precision of this process.

    Args:
      address: address of the scheduler, such as ``tcp://127.0.0.1:8786``.
      function: a function that a worker can import.
      tasks: arguments of each call; the first tasks start first.

    Yields:
      The number of a finished task and its result; None if the cluster gave up on it.

    Raises:
      InputError: (a ValueError) Dask is not installed, or no scheduler answers at the address.
    """
    try:
        from dask.distributed import Client, KilledWorker, as_completed
    except ImportError:
        raise InputError("a scheduler needs Dask: pip install 'jaxgran[cluster]'.") from None
    try:
        client = Client(address, timeout=_PATIENCE, set_as_default=False)
    except (OSError, ValueError) as error:
        raise InputError(f"no scheduler answers at {address!r}: {' '.join(str(error).split())[:80]}.") from None
    x64 = jax.config.read("jax_enable_x64")
    with client:
        futures = {
            client.submit(_with_precision, x64, function, task, pure=False, priority=-number): number
            for number, task in enumerate(tasks)
        }
        for future in as_completed(list(futures), loop=client.loop):
            try:
                yield futures[future], future.result()
            except KilledWorker:
                yield futures[future], None
            future.release()


def _with_precision(x64: bool, function: Callable[..., Any], task: tuple) -> Any:
    jax.config.update("jax_enable_x64", x64)
    return function(*task)
