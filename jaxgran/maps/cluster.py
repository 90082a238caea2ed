"""Tasks on the workers of a running Dask cluster, on this machine or started by Slurm.

The cluster replaces workers that die and repeats their tasks. It gives up a task whose workers have died too often.
"""

from collections.abc import Callable, Generator, Sequence
from typing import Any, TypeVar

from jaxgran.maps.pool import WorkerDied
from jaxgran.model.checks import InputError

T = TypeVar("T")
_PATIENCE = "10s"  # longest wait for an answer of the scheduler


def run_on_cluster(
    address: str,
    function: Callable[..., T],
    tasks: Sequence[tuple],
    configure: Callable[..., None],
    arguments: tuple,
) -> Generator[tuple[int, T | WorkerDied]]:
    """Run a function on the arguments of every task on a cluster, and yield each result when it is there.

    Args:
      address: address of the scheduler, such as ``tcp://127.0.0.1:8786``.
      function, tasks: as in ``pool.run_tasks``; the first tasks start first.
      configure, arguments: a function and its arguments, called on the worker before every task.

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
    with client:
        futures = {
            client.submit(_configured, configure, arguments, function, task, pure=False, priority=-number): number
            for number, task in enumerate(tasks)
        }
        for future in as_completed(list(futures), loop=client.loop):
            try:
                yield futures[future], future.result()
            except KilledWorker:
                yield futures[future], WorkerDied("a batch has killed its workers too often")
            future.release()


def _configured(configure: Callable[..., None], arguments: tuple, function: Callable[..., Any], task: tuple) -> Any:
    configure(*arguments)
    return function(*task)
