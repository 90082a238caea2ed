"""Batches of replicas: flows stacked into one, and the functions that advance them.

All arrays of a batch have a leading (replicas,) axis. Only an ``AdvanceBatch`` changes its states.
``advance_batch`` is the plain one. Wrappers around it report progress, record frames or keep a
journal. An ``ObserveBatch`` also takes a function of a user's, whose sums come with the tally.

JAX may see several devices, of this host or of all hosts that ``jax.distributed`` connects. Each
device then advances its share of the replicas. Devices wait for each other only at the end of a
call. All hosts get all results.
"""

from collections.abc import Callable
from functools import lru_cache, wraps
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import Mesh, PartitionSpec
from jax.typing import ArrayLike
from jaxtyping import Array

from jaxgran.cache.persistent_jit import persistent_jit
from jaxgran.dynamics.advance import register_numba
from jaxgran.dynamics.engine import Numerics, in_lockstep
from jaxgran.dynamics.interruption import waited
from jaxgran.dynamics.tally import Tally
from jaxgran.dynamics.threads import in_threads
from jaxgran.environment import usable_threads
from jaxgran.model.control_flow import AXIS
from jaxgran.model.flow import ShearFlow
from jaxgran.model.state import State
from jaxgran.sampling.observe import Observable, advance_and_observe

Report = Callable[
    [ArrayLike, ArrayLike], None
]  # called with time step and number of steps of each replica
# Advances each replica by its number of steps, and a wrapper that adds reports or records and
# leaves the states alone.
AdvanceBatch = Callable[[ShearFlow, Numerics, State, Array], tuple[State, Tally]]
AdvanceWrapper = Callable[[AdvanceBatch], AdvanceBatch]


class ObserveBatch(Protocol):
    """An ``AdvanceBatch`` that can observe the replicas while it advances them."""

    def __call__(
        self,
        flow: ShearFlow,
        numerics: Numerics,
        state: State,
        steps: Array,
        observe: Observable | None = None,
    ) -> tuple[State, Tally]: ...


_DEVICES = "devices"
_GROUP = 4  # replicas of a compiled program that advances them in turn


def stack(flows: list[ShearFlow]) -> ShearFlow:
    """The flows as one batch: a ShearFlow whose numbers have a leading (replicas,) axis."""

    def joined(*values) -> np.ndarray:
        numbers = np.stack([np.asarray(value) for value in values])
        kind = numbers.dtype if numbers.dtype.kind == "f" else np.dtype(float)
        return numbers.astype(jax.dtypes.canonicalize_dtype(kind))

    return jax.tree.map(joined, *flows)


def for_replicas(numerics: Numerics, count: int) -> Numerics:
    """The same numerics for every replica of a batch: numbers of the solver with a leading
    (replicas,) axis.
    """

    def repeated(value: Any) -> np.ndarray:
        number = np.asarray(value)
        kind = (
            np.dtype(np.int32)
            if number.dtype.kind in "iu"
            else jax.dtypes.canonicalize_dtype(number.dtype)
        )
        return np.broadcast_to(number.astype(kind), (count, *number.shape))

    return jax.tree.map(repeated, numerics)


def replicated(function: Callable, lockstep: bool) -> Callable:
    """The function of one replica for a batch: ``vmap`` with a named axis in lockstep, otherwise
    ``lax.map``.

    With several devices, each computes its share of the replicas.
    """

    def in_turn(*arguments):
        return lax.map(lambda one: function(*one), arguments)

    batched = jax.vmap(function, axis_name=AXIS) if lockstep else in_turn
    return batched if jax.device_count() == 1 else _on_all_devices(batched)


def _on_all_devices(batched: Callable) -> Callable:
    """The function of a batch with equal shares on all devices; copies of replicas fill the last
    share.
    """
    devices = jax.devices()
    mesh = Mesh(np.asarray(devices), (_DEVICES,))

    def gathered(*arguments):
        return jax.tree.map(lambda x: lax.all_gather(x, _DEVICES, tiled=True), batched(*arguments))

    sharded = jax.shard_map(
        gathered,
        mesh=mesh,
        in_specs=PartitionSpec(_DEVICES),
        out_specs=PartitionSpec(),
        check_vma=False,
    )

    def on_all_devices(*arguments):
        count = len(jax.tree.leaves(arguments)[0])
        if count == 1:
            return batched(*arguments)
        share = -(-count // len(devices))  # rounded up
        chosen = np.arange(share * len(devices)) % count
        filled = jax.tree.map(lambda x: x[chosen], arguments)
        return jax.tree.map(lambda x: x[:count], sharded(*filled))

    return on_all_devices


def batch_program(
    function: Callable,
    register: Callable[[], None] = lambda: None,
    compiled: Callable[[Callable, Callable[[], None]], Callable] = persistent_jit,
) -> Callable:
    """The compiled function of one replica for a batch, called with batched arguments and
    ``lockstep``.

    Replicas that advance in turn do so in groups of one size. So one compiled program serves
    batches of any size. For ``register`` see ``persistent_jit``.
    """

    @wraps(function)
    def in_turn(*arguments):
        return replicated(function, lockstep=False)(*arguments)

    @wraps(function)
    def together(*arguments):
        return replicated(function, lockstep=True)(*arguments)

    @wraps(function)
    def group(real, arguments):
        def one(real, arguments):
            empty = jax.eval_shape(function, *arguments)
            zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), empty)
            return lax.cond(real, lambda: function(*arguments), lambda: zeros)

        return lax.map(lambda each: one(*each), (real, arguments))

    everything = {True: compiled(together, register), False: compiled(in_turn, register)}
    in_group = compiled(group, register)

    @wraps(function)
    def program(*arguments, lockstep: bool):
        if lockstep or jax.device_count() > 1:
            return waited(everything[lockstep](*arguments))
        batch = jax.tree.map(_on_host, arguments)
        count = len(jax.tree.leaves(batch)[0])
        groups = []
        for first in range(0, count, _GROUP):
            places = np.arange(first, first + _GROUP)
            filled = jax.tree.map(lambda x, k=places: x[np.minimum(k, count - 1)], batch)
            groups.append(jax.tree.map(np.asarray, waited(in_group(places < count, filled))))
        return jax.tree.map(lambda *x: np.concatenate(x)[:count], *groups)

    return program


def _on_host(array: Array) -> Array | np.ndarray:
    """The array in memory of the host, where the numbers of a replica are cheap to take; random
    keys stay with JAX.
    """
    return array if jax.dtypes.issubdtype(array.dtype, jax.dtypes.prng_key) else np.asarray(array)


def _advance_replica(
    flow: ShearFlow, numerics: Numerics, state: State, steps: Array
) -> tuple[State, Tally]:
    return advance_and_observe(flow, numerics, state, steps, None)


_advance_replicas = batch_program(_advance_replica, register_numba)


@lru_cache(maxsize=8)
def _observe_replicas(observe: Observable) -> Callable:
    """The program of ``advance_batch`` with a user's function, of which no key for a file is
    known.
    """

    def observe_replica(
        flow: ShearFlow, numerics: Numerics, state: State, steps: Array
    ) -> tuple[State, Tally]:
        return advance_and_observe(flow, numerics, state, steps, observe)

    return batch_program(observe_replica, compiled=lambda function, _: jax.jit(function))


def advance_batch(
    flow: ShearFlow,
    numerics: Numerics,
    state: State,
    steps: Array,
    observe: Observable | None = None,
) -> tuple[State, Tally]:
    """Advance each replica of a batch by its number of time steps.

    Args:
      flow, state: those of the replicas, see ``stack``.
      numerics: those of the replicas, see ``for_replicas``.
      steps: (replicas,) numbers of time steps.
      observe: a function of a ``Snapshot``, see ``sample``; its sums are in ``Tally.observed``.

    Raises:
      InputError: the engine cannot do this.
    """
    program = _advance_replicas if observe is None else _observe_replicas(observe)
    return program(flow, numerics, state, steps, lockstep=in_lockstep())


def advance_on_all_cores(
    flow: ShearFlow, numerics: Numerics, state: State, steps: Array
) -> tuple[State, Tally]:
    """``advance_batch`` with the same bits; replicas that advance in turn are shared out to
    threads.
    """
    count = len(steps)
    threads = min(usable_threads(), count)
    if threads == 1 or in_lockstep() or jax.device_count() > 1:
        return advance_batch(flow, numerics, state, steps)
    batch = jax.tree.map(np.asarray, (flow, numerics, state, steps))

    def advanced(first: int, _: Callable) -> tuple[State, Tally]:
        return advance_batch(*jax.tree.map(lambda x: x[first : first + share], batch))

    share = min(_GROUP, -(-count // threads))
    shares = dict(
        in_threads(
            advanced, [(first,) for first in range(0, count, share)], threads, lambda _: None
        )
    )
    return jax.tree.map(lambda *x: np.concatenate(x), *(shares[k] for k in sorted(shares)))


def reporting(advance: ObserveBatch, report: Report) -> ObserveBatch:
    """The same advance with a report after each call."""

    def advance_and_report(
        flow: ShearFlow,
        numerics: Numerics,
        state: State,
        steps: Array,
        observe: Observable | None = None,
    ) -> tuple[State, Tally]:
        state, tally = advance(flow, numerics, state, steps, observe)
        report(flow.timestep, tally.steps)
        return state, tally

    return advance_and_report
