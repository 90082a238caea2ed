"""Batches of replicas: their checks, and who advances them on which cores.

All arrays of a batch have a leading (replicas,) axis. The results of a replica do not depend on its
batch, to the bit.

==========================  ========================================================================
where                       how the replicas of a batch advance
==========================  ========================================================================
a processor                 ``sample`` and ``prepare`` call the compiled function of one replica for
                            each, in threads on several cores (``run_batch``)
an accelerator              in lockstep, in one compiled function of the batch
within ``jit``, ``vmap``, … by ``vmap``, or in turn (``over_replicas``)
==========================  ========================================================================
"""

from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from functools import partial
from queue import SimpleQueue
from threading import Event
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Float

from jaxgran.dynamics.engine import Numba, Numerics, select_engine
from jaxgran.dynamics.interruption import PATIENCE, block_until_done, engines_stopped
from jaxgran.environment import on_processor, usable_threads
from jaxgran.model.checks import InputError, is_traced
from jaxgran.model.flow import ShearFlow
from jaxgran.model.state import State

Arguments = tuple[Any, ...]  # a flow, a state and numbers
Send = Callable[[Any], None]
T = TypeVar("T")
_DIMENSIONS = (1, 1, 2, 2, 0, 0)  # of the arrays of one state, in the order of its leaves


def stack(flows: Sequence[ShearFlow]) -> ShearFlow:
    """The flows as one batch: a ShearFlow whose numbers have a leading (replicas,) axis."""

    def joined(*values) -> np.ndarray:
        numbers = np.stack([np.asarray(value) for value in values])
        return numbers.astype(jnp.result_type(float))

    return jax.tree.map(joined, *flows)


def checked_batch(
    check: Callable[..., Any], flow: Any, state: Any, *numbers: Any
) -> Arguments | None:
    """The arguments of a batch, broadcast to a leading (replicas,) axis; None where flow and state
    are single ones.

    Args:
      check: called with the arguments of each replica, or of the first where JAX traces them;
        raises an InputError.

    Raises:
      InputError: the axes differ in length, or there are several, or the arguments of a replica do
        not pass.
    """
    batch = _batch_of(flow, state, *numbers)
    if batch is None:
        check(flow, state, *numbers)
    elif is_traced(batch):
        check(*jax.tree.map(lambda x: x[0], batch))
    else:
        for replica in replicas_of(batch):
            check(*replica)
    return batch


def _batch_of(flow: Any, state: Any, *numbers: Any) -> Arguments | None:
    if not (isinstance(flow, ShearFlow) and isinstance(state, State)):
        return None
    shapes = {*map(np.shape, jax.tree.leaves(flow)), np.shape(state.side)} - {()}
    if not shapes:
        return None
    shapes |= {np.shape(x) for x in numbers} - {()}
    if (0,) in shapes:
        raise InputError("a batch must have at least one replica.")
    if len(shapes) > 1 or len(max(shapes)) > 1:
        raise InputError(
            "a batch must have one axis of replicas, the same in the flow, the state and all "
            f"numbers, not those of {', '.join(map(str, sorted(shapes)))}."
        )

    def with_axis(x: Any, dimensions: int = 0) -> Any:
        if not hasattr(x, "ndim"):
            x = jnp.asarray(x, state.side.dtype if isinstance(x, float) else None)
        return jnp.broadcast_to(x, (*max(shapes), *x.shape)) if x.ndim == dimensions else x

    leaves, structure = jax.tree.flatten(state)
    states = jax.tree.unflatten(structure, map(with_axis, leaves, _DIMENSIONS))
    return jax.tree.map(with_axis, flow), states, *map(with_axis, numbers)


def replicas_of(batch: Any) -> Iterator[Any]:
    """The replicas of a batch, with arrays of NumPy, of which one is taken without a compilation;
    random keys stay with JAX.
    """

    def on_host(x: Any) -> Any:
        is_key = jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key)
        return x if is_key else np.asarray(x)

    arrays = jax.tree.map(on_host, batch)
    for k in range(len(jax.tree.leaves(arrays)[0])):
        yield jax.tree.map(lambda x, k=k: x[k], arrays)


def over_replicas(function: Callable[..., T], numerics: Numerics, batch: Arguments) -> T:
    """The function of one replica for a batch that JAX may trace: by ``vmap``, which advances the
    replicas as they do best, or in turn where the engine ``Jax`` takes a processor.
    """
    if isinstance(select_engine(numerics, batch[1]), Numba) or not on_processor():
        return jax.vmap(function)(*batch)
    return lax.map(lambda replica: function(*replica), batch)


def shear_batch(
    function: Callable[..., Any], numerics: Numerics, batch: Arguments, static: tuple = ()
) -> Any:
    """The results of ``function(flow, state, strain, numerics, *static)``, compiled, for all
    replicas of a batch; JAX may trace it.
    """
    if is_traced(batch, numerics):

        def of_replica(*replica: Any) -> Any:
            return function(*replica, numerics, *static)

        return over_replicas(of_replica, numerics, batch)
    flow, _, strain = batch
    costs = predicted_cost(flow) * np.asarray(strain)
    results = run_batch(function, batch, (numerics,), static, costs, usable_threads())
    return jax.tree.map(jnp.asarray, results)


def run_batch(
    function: Callable[..., Any],
    batch: Arguments,
    shared: tuple = (),
    static: tuple = (),
    costs: Float[np.ndarray, " replicas"] | None = None,
    threads: int = 1,
) -> Any:
    """The results of a function of one replica for all replicas of a batch.

    Args:
      function: called as ``function(*replica, *shared, *static)``; compiled for one replica, so
        that batches of any size need no further compilation on a processor.
      batch: arguments with a leading (replicas,) axis.
      shared, static: arguments that all replicas have in common; the latter are not traced.
      costs: relative cost of each replica. Threads begin with the most expensive ones.
      threads: most threads on a processor.
    """
    if not on_processor():
        return block_until_done(_together(function, static, shared, batch))
    replicas = list(replicas_of(batch))

    def run(k: int, _: Send = lambda _: None) -> Any:
        return jax.tree.map(np.asarray, block_until_done(function(*replicas[k], *shared, *static)))

    order = range(len(replicas)) if costs is None else np.argsort(-costs, kind="stable").tolist()
    if min(threads, len(replicas)) == 1:
        results = {k: run(k) for k in order}
    else:
        tasks = in_threads(run, [(k,) for k in order], threads, lambda _: None)
        results = {order[number]: result for number, result in tasks}
    return jax.tree.map(lambda *x: np.array(x), *(results[k] for k in range(len(replicas))))


@partial(jax.jit, static_argnums=(0, 1))
def _together(function: Callable[..., T], static: tuple, shared: tuple, batch: Arguments) -> T:
    """The replicas of a batch in lockstep."""
    return jax.vmap(lambda *replica: function(*replica, *shared, *static))(*batch)


def predicted_cost(flow: ShearFlow, timestep: Any = None) -> Any:
    """Relative cost of a unit of strain of a flow, or of each of a batch, at its own or another
    time step: a fit to measured times.

    The cost is proportional to the number of grains. Dense and dissipative flows form contact
    networks; the second factor is their cost at dt = 1e-3. Steps without a contact are jumped over,
    so ten times as many steps cost little more than twice as much.
    """
    timestep = flow.timestep if timestep is None else timestep
    numbers = flow.restitution, flow.packing_fraction, timestep
    alpha, nu, dt = (np.asarray(x, float) for x in numbers)
    network = 8 + 600 * (1 - alpha) * np.exp((nu - 0.8) / 0.04)
    return flow.grains * network * (1e-3 / dt) ** 0.35


class Cancelled(BaseException):
    """Raised by the ``send`` of a task whose result is no longer wanted."""


def in_threads(
    function: Callable[..., T], tasks: Sequence[tuple], threads: int, on_message: Send
) -> Generator[tuple[int, T]]:
    """Run a function on the arguments of every task, started in order in threads of this process,
    and yield each result when it is there. Compiled programs run without the interpreter's lock.

    When the generator ends early, each thread ends at its next message or task. Ctrl-C also stops
    the numba engine, within one step. A thread that takes longer, as for a compilation, is left
    behind; Python ends after it.

    Args:
      function: called with the arguments of a task and ``send``. A long task calls ``send`` after
        each of its parts, before it uses what the part returned: a part that was stopped has no
        valid results, and ``send`` then raises.
      tasks: arguments of each call.
      threads: most threads at a time.
      on_message: called with everything that is sent, in the thread of the caller.

    Yields:
      The number of the task, and its result.

    Raises:
      BaseException: that of a task, with its traceback.
    """
    events: SimpleQueue[Any] = SimpleQueue()  # messages and futures that are done
    cancelled = Event()
    config: Any = jax.config
    x64, device = config.jax_enable_x64, config.jax_default_device

    def send(message: Any) -> None:
        if cancelled.is_set():
            raise Cancelled
        events.put(message)

    def call(arguments: tuple) -> T:
        if cancelled.is_set():
            raise Cancelled
        with jax.enable_x64(x64), jax.default_device(device):  # each thread has its own
            return function(*arguments, send)

    def end() -> None:
        cancelled.set()
        pool.shutdown(wait=False, cancel_futures=True)
        running = [future for future in futures if future.running()]
        pool.shutdown(wait=not wait(running, PATIENCE).not_done)

    pool = ThreadPoolExecutor(threads, thread_name_prefix="jaxgran-batch")
    futures: dict[Future, int] = {}
    try:
        for number, arguments in enumerate(tasks):
            future = pool.submit(call, arguments)
            futures[future] = number
            future.add_done_callback(events.put)
        while futures:
            event = events.get()
            if isinstance(event, Future):
                yield futures.pop(event), event.result()
            else:
                on_message(event)
    except KeyboardInterrupt:
        with engines_stopped():
            end()
        raise
    finally:
        end()
