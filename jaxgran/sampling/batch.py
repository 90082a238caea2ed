"""Batches of replicas: flows stacked into one, and the functions that advance them.

All arrays of a batch have a leading (replicas,) axis. Only a ``Drive`` changes its states. ``advance_batch`` is the
plain one. Wrappers around it report progress, record frames or keep a journal.

JAX may see several devices, of this host or of all hosts that ``jax.distributed`` connects. Each device then advances
its share of the replicas. Devices wait for each other only at the end of a call. All hosts get all results.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array, Int

from jaxgran.dynamics.advance import advance
from jaxgran.dynamics.tally import Tally
from jaxgran.model.control_flow import AXIS
from jaxgran.model.flow import Engine, ShearFlow
from jaxgran.model.state import State

Report = Callable[[float], None]  # called with the replica-steps done since the last call
Drive = Callable[[ShearFlow, State, Array], tuple[State, Tally]]  # advances each replica by its number of steps
Wrap = Callable[[Drive], Drive]  # adds reports or records to a drive; states stay the same
_DEVICES = "devices"


def stack(flows: list[ShearFlow]) -> ShearFlow:
    """The flows as one batch: a ShearFlow whose numbers have a leading (replicas,) axis."""

    def joined(path, *values) -> Array:
        numbers = np.stack([np.asarray(value) for value in values])
        if path[-1].name == "max_iterations":
            return jnp.asarray(numbers, jnp.int32)
        return jnp.asarray(numbers, None if numbers.dtype.kind == "f" else float)

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


@jax.jit
def advance_batch(flow: ShearFlow, state: State, steps: Int[Array, " replicas"]) -> tuple[State, Tally]:
    """Advance every replica of a batch by its own number of steps: the plain ``Drive``."""
    return replicated(advance, flow.engine)(flow, state, steps)


def reporting(drive: Drive, report: Report | None) -> Drive:
    """The drive with a report of the replica-steps after each call; the drive itself without ``report``."""
    if report is None:
        return drive

    def driven(flow: ShearFlow, state: State, steps: Array) -> tuple[State, Tally]:
        state, tally = drive(flow, state, steps)
        report(float(np.sum(tally.steps)))
        return state, tally

    return driven
