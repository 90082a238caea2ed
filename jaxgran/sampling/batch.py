"""Batches of replicas: flows stacked into one, and the functions that advance them.

All arrays of a batch have a leading (replicas,) axis. Only a ``Drive`` changes its states. ``advance_batch`` is the
plain one. Wrappers around it report progress, record frames or keep a journal.

JAX may see several devices, of this host or of all hosts that ``jax.distributed`` connects. Each device then advances
its share of the replicas. Devices wait for each other only at the end of a call. All hosts get all results.
"""

from collections.abc import Callable
from functools import wraps

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array

from jaxgran.cache.persistent_jit import persistent_jit
from jaxgran.dynamics.advance import advance, register_numba
from jaxgran.dynamics.interruption import waited
from jaxgran.dynamics.tally import Tally
from jaxgran.model.choices import Engine
from jaxgran.model.control_flow import AXIS
from jaxgran.model.flow import ShearFlow
from jaxgran.model.state import State

Report = Callable[[float], None]  # called with the replica-steps done since the last call
AdvanceBatch = Callable[[ShearFlow, State, Array], tuple[State, Tally]]  # advances each replica by its number of steps
AdvanceWrapper = Callable[[AdvanceBatch], AdvanceBatch]  # adds reports or records to a drive; states stay the same
_DEVICES = "devices"
_GROUP = 4  # replicas of a compiled program that advances them in turn


def stack(flows: list[ShearFlow]) -> ShearFlow:
    """The flows as one batch: a ShearFlow whose numbers have a leading (replicas,) axis."""

    def joined(path, *values) -> np.ndarray:
        numbers = np.stack([np.asarray(value) for value in values])
        if path[-1].name == "max_iterations":
            return numbers.astype(np.int32)
        kind = numbers.dtype if numbers.dtype.kind == "f" else np.dtype(float)
        return numbers.astype(jax.dtypes.canonicalize_dtype(kind))

    return jax.tree_util.tree_map_with_path(joined, *flows)


def in_lockstep(engine: Engine = "auto") -> bool:
    """Whether the replicas of a batch advance together: on an accelerator, and with ``engine="jax"`` on any device.

    The batch is then one array program and waits for its slowest replica. On a processor, "auto" advances one replica
    after another, which is faster, also where it selects the engine "jax".
    """
    return engine == "jax" or jax.default_backend() != "cpu"


def replicated(function: Callable, engine: Engine = "auto") -> Callable:
    """The function of one replica for a batch: with ``vmap`` and a named axis if ``in_lockstep``, or else ``lax.map``.

    With several devices, each computes its share of the replicas.
    """

    def in_turn(*arguments):
        return lax.map(lambda one: function(*one), arguments)

    batched = jax.vmap(function, axis_name=AXIS) if in_lockstep(engine) else in_turn
    return batched if jax.device_count() == 1 else _on_all_devices(batched)


def _on_all_devices(batched: Callable) -> Callable:
    """The function of a batch with equal shares on all devices; copies of replicas fill the last share."""
    devices = jax.devices()
    mesh = Mesh(np.asarray(devices), (_DEVICES,))

    def gathered(*arguments):
        return jax.tree.map(lambda x: lax.all_gather(x, _DEVICES, tiled=True), batched(*arguments))

    sharded = jax.shard_map(
        gathered, mesh=mesh, in_specs=PartitionSpec(_DEVICES), out_specs=PartitionSpec(), check_vma=False
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


def batch_program(function: Callable, register: Callable[[], None] = lambda: None) -> Callable:
    """The compiled function of one replica for a batch; its first argument is the flow.

    Replicas that advance in turn do so in groups of one size. So one compiled program serves batches of any size. For
    ``register`` see ``kept_jit``.
    """

    @wraps(function)
    def all_replicas(flow, *arguments):
        return replicated(function, flow.engine)(flow, *arguments)

    @wraps(function)
    def group(real, arguments):
        def one(real, arguments):
            empty = jax.eval_shape(function, *arguments)
            zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), empty)
            return lax.cond(real, lambda: function(*arguments), lambda: zeros)

        return lax.map(lambda each: one(*each), (real, arguments))

    together, in_group = persistent_jit(all_replicas, register), persistent_jit(group, register)

    @wraps(function)
    def program(flow, *arguments):
        if in_lockstep(flow.engine) or jax.device_count() > 1:
            return waited(together(flow, *arguments))
        batch = jax.tree.map(_on_host, (flow, *arguments))
        count = len(jax.tree.leaves(batch)[0])
        groups = []
        for first in range(0, count, _GROUP):
            places = np.arange(first, first + _GROUP)
            filled = jax.tree.map(lambda x, k=places: x[np.minimum(k, count - 1)], batch)
            groups.append(jax.tree.map(np.asarray, waited(in_group(places < count, filled))))
        return jax.tree.map(lambda *x: np.concatenate(x)[:count], *groups)

    return program


def _on_host(array: Array) -> Array | np.ndarray:
    """The array in memory of the host, where the numbers of a replica are cheap to take; random keys stay with JAX."""
    return array if jax.dtypes.issubdtype(array.dtype, jax.dtypes.prng_key) else np.asarray(array)


advance_batch: AdvanceBatch = batch_program(advance, register_numba)  # the plain one


def reporting(drive: AdvanceBatch, report: Report | None) -> AdvanceBatch:
    """The drive with a report of the replica-steps after each call; the drive itself without ``report``."""
    if report is None:
        return drive

    def driven(flow: ShearFlow, state: State, steps: Array) -> tuple[State, Tally]:
        state, tally = drive(flow, state, steps)
        report(float(np.sum(tally.steps)))
        return state, tally

    return driven
