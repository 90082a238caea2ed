"""Tasks on the workers of a running Dask cluster, on this machine or started by Slurm.

The cluster replaces workers that die and repeats their tasks. It gives up on a task whose workers
have died too often.
"""

from collections.abc import Callable, Generator, Sequence
from typing import Any, TypeVar

import jax

from jaxgran.cache.folder import programs_folder, use_cache
from jaxgran.environment import precision
from jaxgran.maps.provenance import made_with, versions_of
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
    """
    try:
        from dask.distributed import Client, KilledWorker, as_completed
    except ImportError:
        raise InputError("a scheduler needs Dask: pip install 'jaxgran[cluster]'.") from None
    try:
        client = Client(address, timeout=_PATIENCE, set_as_default=False)
    except (OSError, ValueError) as error:
        raise InputError(
            f"no scheduler answers at {address!r}: {' '.join(str(error).split())[:80]}."
        ) from None
    x64, caching, here = (
        precision() == "float64",
        programs_folder() is not None,
        versions_of(made_with()),
    )
    with client:
        futures = {
            client.submit(
                _on_worker, x64, caching, function, task, pure=False, priority=-number
            ): number
            for number, task in enumerate(tasks)
        }
        for future in as_completed(list(futures), loop=client.loop):
            try:
                there, result = future.result()
                for name, version in versions_of(there).items():
                    if version != here[name]:
                        different = (
                            f"{name.removeprefix('version_')} {version!r}, not {here[name]!r}"
                        )
                        raise InputError(
                            "workers must have the versions of this process, and one has "
                            f"{different}."
                        )
                if made is not None:
                    for name, value in there.items():
                        made.setdefault(name, {})[value] = None
                yield futures[future], result
            except KilledWorker:
                yield futures[future], None
            future.release()


def _on_worker(
    x64: bool, caching: bool, function: Callable[..., Any], task: tuple
) -> tuple[dict[str, str], Any]:
    """What a worker computes with, and the result of the function."""
    jax.config.update("jax_enable_x64", x64)
    if caching:
        use_cache()
    return made_with(), function(*task)
