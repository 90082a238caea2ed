"""Tasks on the workers of a running Dask cluster, on this machine or started by Slurm.

The cluster replaces workers that die and repeats their tasks. It gives up on a task whose workers
have died too often.
"""

import logging
from collections.abc import Callable, Generator, Sequence
from typing import Any, TypeVar

import jax

from jaxgran.cache.folder import programs_folder, use_cache
from jaxgran.environment import precision
from jaxgran.maps.attributes import first_difference
from jaxgran.maps.provenance import deciding, made_with
from jaxgran.model.checks import InputError

T = TypeVar("T")
Provenance = dict[str, dict[str, None]]  # values by name, each once, in their order
_PATIENCE = "10s"  # longest wait for an answer of the scheduler


def run_on_cluster(
    address: str, function: Callable[..., T], tasks: Sequence[tuple], made: Provenance | None = None
) -> Generator[tuple[int, T | None]]:
    """Run a function on the arguments of every task on a cluster, with the precision of this
    process.

    Workers keep compiled programs on disk if this process does.

    Args:
      address: address of the scheduler, such as ``tcp://127.0.0.1:8786``.
      function: a function that a worker can import.
      tasks: arguments of each call; the first tasks start first.
      made: receives, by name, each ``made_with`` of the workers once.

    Yields:
      The number of a finished task and its result; None if the cluster gave up on it.

    Raises:
      InputError: (a ValueError) Dask is not installed, no scheduler answers at the address, or a
        worker has other versions than this process.
      ConnectionError: the scheduler has gone.
    """
    try:
        from dask.distributed import CancelledError, Client, KilledWorker, as_completed
        from distributed.comm import CommClosedError
    except ImportError:
        raise InputError("a scheduler needs Dask: pip install 'jaxgran[cluster]'.") from None
    try:
        client = Client(address, timeout=_PATIENCE, set_as_default=False)
    except (OSError, ValueError) as error:
        raise InputError(
            f"no scheduler answers at {address!r}: {' '.join(str(error).split())[:80]}."
        ) from None
    x64, caching = precision() == "float64", programs_folder() is not None
    versions = deciding(made_with())
    with client:
        # Not ``client.get_executor()``: a future of it whose result is on its way when the
        # scheduler dies never ends.
        futures = {
            client.submit(
                _on_worker, x64, caching, function, task, pure=False, priority=-number
            ): number
            for number, task in enumerate(tasks)
        }
        for future in as_completed(list(futures), loop=client.loop):
            number = futures.pop(future)
            try:
                of_worker, result = future.result()
            except KilledWorker:
                yield number, None
                continue
            except (CancelledError, CommClosedError):
                # without the tracebacks of its attempts to connect again
                logging.getLogger("distributed.client").setLevel(logging.CRITICAL)
                raise ConnectionError(f"the scheduler at {address} has gone") from None
            if difference := first_difference(deciding(of_worker), versions):
                name, other, required = difference
                raise InputError(
                    "workers must have the versions of this process, and one has "
                    f"{name.removeprefix('version_')} {other!r}, not {required!r}."
                )
            if made is not None:
                for name, value in of_worker.items():
                    made.setdefault(name, {})[value] = None
            yield number, result


def _on_worker(
    x64: bool, caching: bool, function: Callable[..., Any], task: tuple
) -> tuple[dict[str, str], Any]:
    """What a worker computes with, and the result of the function."""
    jax.config.update("jax_enable_x64", x64)
    if caching:
        use_cache()
    return made_with(), function(*task)
