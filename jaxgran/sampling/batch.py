"""Batches of replicas: flows stacked into one, and what advances them together.

A batch carries a leading (replicas,) axis on everything. All that changes its states is a ``Drive``; what is wrapped
around the plain one tells of its progress or keeps a journal.

Where JAX sees several devices, of this host or of all those that ``jax.distributed`` has brought together, each of them
takes its share of the replicas, with loops of its own: devices wait for each other at the end of a call only, and all
hosts hold the results of all.
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

Report = Callable[[float], None]  # told the replica-steps done since the last call
Drive = Callable[[ShearFlow, State, Array], tuple[State, Tally]]  # advances a batch, each replica by its own steps
Wrap = Callable[[Drive], Drive]  # adds to what a drive does, and changes no state
_DEVICES = "devices"


def stack(flows: list[ShearFlow]) -> ShearFlow:
    """One ShearFlow of a batch: every number with a leading (replicas,) axis."""

    def joined(path, *values) -> Array:
        numbers = np.stack([np.asarray(value) for value in values])
        if path[-1].name == "max_iterations":
            return jnp.asarray(numbers, jnp.int32)
        return jnp.asarray(numbers, None if numbers.dtype.kind == "f" else float)

    return jax.tree_util.tree_map_with_path(joined, *flows)


def in_lockstep(engine: Engine = "auto") -> bool:
    """Whether the replicas of a batch advance together: on an accelerator, and everywhere if the engine jax is named.

    Then a batch waits for its slowest replica. On a processor that is what ``engine="jax"`` is asked for: the batch as
    one array program. Where "auto" takes the engine jax there, replicas go one after another, which is faster.
    """
    return engine == "jax" or jax.default_backend() != "cpu"


def replicated(function: Callable, engine: Engine = "auto") -> Callable:
    """The function of one replica for a batch: ``vmap`` with a named axis ``in_lockstep``, or else ``lax.map``.

    On several devices every one does so with its share of the replicas.
    """

    def in_turn(*arguments):
        return lax.map(lambda one: function(*one), arguments)

    together = jax.vmap(function, axis_name=AXIS) if in_lockstep(engine) else in_turn
    return together if jax.device_count() == 1 else _shared_out(together)


def _shared_out(together: Callable) -> Callable:
    """A function of a batch that hands every device an equal share, the last one in part copies of others."""
    devices = jax.devices()
    mesh = Mesh(np.asarray(devices), (_DEVICES,))

    def share(*arguments):
        return jax.tree.map(lambda x: lax.all_gather(x, _DEVICES, tiled=True), together(*arguments))

    shares = jax.shard_map(
        share, mesh=mesh, in_specs=PartitionSpec(_DEVICES), out_specs=PartitionSpec(), check_vma=False
    )

    def shared_out(*arguments):
        count = len(jax.tree.leaves(arguments)[0])
        if count == 1:
            return together(*arguments)
        places = np.arange(-(-count // len(devices)) * len(devices)) % count
        filled = jax.tree.map(lambda x: x[places], arguments)
        return jax.tree.map(lambda x: x[:count], shares(*filled))

    return shared_out


@jax.jit
def advance_batch(flow: ShearFlow, state: State, steps: Int[Array, " replicas"]) -> tuple[State, Tally]:
    """Advance every replica of a batch by its own number of steps: the plain ``Drive`` of the protocol."""
    return replicated(advance, flow.engine)(flow, state, steps)


def reporting(drive: Drive, report: Report | None) -> Drive:
    """A drive that tells how many replica-steps it has done."""
    if report is None:
        return drive

    def driven(flow: ShearFlow, state: State, steps: Array) -> tuple[State, Tally]:
        state, tally = drive(flow, state, steps)
        report(float(np.sum(tally.steps)))
        return state, tally

    return driven
