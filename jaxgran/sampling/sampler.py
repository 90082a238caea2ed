"""Shears flows, one or a batch, and samples them in blocks of strain."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxgran.contact.projected_methods import DEFAULT_SOLVER, ProjectedMethod
from jaxgran.dynamics.advance import advance_replica, engine_of
from jaxgran.dynamics.batch import Arguments, checked_batch, shear_batch
from jaxgran.dynamics.engine import Engine, Numerics, checked_numerics, select_engine
from jaxgran.dynamics.interruption import block_until_done
from jaxgran.dynamics.observer import Observe
from jaxgran.dynamics.tally import Tally
from jaxgran.environment import usable_threads
from jaxgran.model.checks import (
    InputError,
    as_array,
    is_traced,
    require,
    require_function,
    require_static_function,
    require_whole,
)
from jaxgran.model.flow import (
    ShearFlow,
    flow_of_state,
    in_dtype,
    require_strain,
    steps_of_blocks,
    steps_of_strain,
)
from jaxgran.model.state import State, check_precision, require_state
from jaxgran.sampling.blocks import advance_by_block, sample_of_blocks
from jaxgran.sampling.correlation_strain import length_status, total_mass
from jaxgran.sampling.observe import advance_batch
from jaxgran.sampling.sample import BLOCKS, Sample

MOST_BLOCKS = 10**6
_LARGEST_MOMENTUM = 1e-4  # |Σ m c| over Σ m |c| at the start; rounding leaves 1e-6 at most


def sample(
    flow: ShearFlow,
    state: State,
    strain: float | Array,
    blocks: int = BLOCKS,
    observe: Observe | None = None,
    callback: Callable[[State, Sample], Any] | None = None,
    *,
    solver: ProjectedMethod = DEFAULT_SOLVER,
    engine: Engine | None = None,
) -> tuple[State, Sample]:
    """Shear a flow, or a batch of flows, and average its observables; ``jit``, ``vmap`` and
    ``lax.map`` apply.

    A batch is a flow or a state whose arrays have a leading (replicas,) axis; values without it are
    shared. Every replica has the results that a call of its own would have. ``jax.vmap`` of this
    function does the same. On a processor, a batch runs on all cores, and batches of all sizes
    share one compilation.

    The numba engine takes all blocks in one call, unless there is ``observe`` or ``callback``. Then
    every block begins with a new list of near pairs, and its trajectory differs by rounding, which
    grows as in any chaotic flow.

    The result of ``observe`` is averaged over **every** time step, in the same run (see
    ``observer``). A few instants are not enough for contact forces: at a short time step, most
    instants of a collisional flow have no contact with a force. A function of the forces, which are
    ``impulses / timestep``, is averaged exactly. Positions and velocities are observed once a free
    flight, in its middle; their averages are accurate to second order in the strain of a flight.

    Args:
      flow: parameters of the state, with its packing fraction; or those (replicas,) of a batch.
      state: the flow at the beginning, usually from ``prepare``; or a batch of states.
      strain: strain γ̇t to sample, rounded to whole time steps; for a batch also (replicas,). A new
        value does not recompile.
      blocks: number of equal parts of the strain, static; a tally is kept for each.
      observe: a function of a ``Snapshot`` that returns a pytree of arrays to average. It is
        static, and each new function is compiled, so define it once and not as a lambda in a loop.
        If it uses traced values from outside, the engine ``Jax`` runs, and is compiled with it. The
        contacts are those of a step with an approaching contact, before the impulses act; other
        steps have none. The size of their buffers varies, so ``observe`` must return sums over
        contacts or over grains.
      callback: called after each block with the state and the sample so far, or those of the
        batch; if its result is true, the sample ends. JAX transformations do not apply then.
      solver: solves the contacts of each step, by default ``BarzilaiBorwein()``. New numbers in it
        do not recompile.
      engine: ``Jax()`` or ``Numba()``; None for the fastest that can do this, see ``advance``.

    Returns:
      The final state and the sample; those of a batch have a leading (replicas,) axis.

    Raises:
      InputError: (a ValueError) the axes of a batch differ; the state is not one of this flow, has
        numbers that are not finite, or a total momentum; the flow is not sheared; the strain is not
        a positive number, is shorter than one time step a block, or is longer than 2**31 - 1 time
        steps; positions in float32 cannot resolve the time step; the result of ``observe`` is not
        summed over contacts; or the engine cannot do this.

    Examples:
      The fabric of the contacts that carry a force:

      >>> import jaxgran as jg
      >>> flow = ShearFlow(grains=32, restitution=0.5, packing_fraction=0.7, timestep=1e-3)
      >>> state = jg.prepare(flow, jax.random.key(0), equilibrate=0.4)
      >>> def observe(snapshot):
      ...     normals = snapshot.contacts.normals
      ...     loaded = (snapshot.impulses > 0).astype(normals.dtype)
      ...     fabric = jnp.einsum("c,ca,cb->ab", loaded, normals, normals)
      ...     return {"fabric": fabric, "contacts": jnp.sum(loaded)}
      >>> state, measured = sample(flow, state, 0.4, observe=observe)
      >>> fabric, error = measured.observed(lambda mean: mean["fabric"] / mean["contacts"])
      >>> round(float(fabric.trace()), 6), bool(measured.errors()["pressure"] > 0)
      (1.0, True)
    """
    require_whole("blocks", blocks, 1, MOST_BLOCKS, "as a tally is kept for each")
    strain = as_array(strain)
    require("strain", strain, lambda x: (x > 0) & np.isfinite(x), "a positive number")
    check = partial(_require_sheared_state, blocks)
    batch = checked_batch(check, flow, state, strain)
    numerics = checked_numerics(solver, engine)
    require_static_function("observe", observe)
    require_function("callback", callback)
    if callback is None:
        if batch is None:
            flow, strain = in_dtype((flow_of_state(flow), strain), state.side.dtype)
            return block_until_done(_sample(flow, state, strain, numerics, blocks, observe))
        flows, states, strains = batch
        flows, strains = in_dtype((flow_of_state(flows), strains), states.side.dtype)
        return shear_batch(_sample, numerics, (flows, states, strains), (blocks, observe))
    if is_traced(flow, numerics, state, strain):
        raise InputError("callback must be None where a sample is transformed, as by jax.jit.")
    replicas = batch or checked_batch(
        check, flow, jax.tree.map(lambda x: jnp.asarray(x)[None], state), strain
    )
    assert replicas is not None
    return _sample_with_callback(replicas, batch is None, numerics, blocks, observe, callback)


def _require_sheared_state(blocks: int, flow: ShearFlow, state: State, strain: Any) -> None:
    """Raise an InputError unless a flow can shear a state by a strain of so many blocks."""
    require_state(flow, state)
    require_strain(flow, strain, blocks)
    check_precision(flow, state)
    if is_traced(state.velocities, state.grains.masses):
        return
    momenta = np.asarray(state.grains.masses)[:, None] * np.asarray(state.velocities)
    total, scale = np.linalg.norm(momenta.sum(axis=0)), np.linalg.norm(momenta, axis=1).sum()
    if total > _LARGEST_MOMENTUM * scale:
        raise InputError(
            f"state must have no total momentum, as temperature and stresses would contain it, and "
            f"it has {total / scale:.2g} of the sum of the momenta of its grains: "
            "state.without_momentum() removes it."
        )


@partial(jax.jit, static_argnames=("blocks", "observe"))
def _sample(
    flow: ShearFlow,
    state: State,
    strain: Array,
    numerics: Numerics,
    blocks: int,
    observe: Observe | None = None,
) -> tuple[State, Sample]:
    """The sample of one replica, in one compiled program."""
    steps = steps_of_blocks(steps_of_strain(flow, strain), blocks)
    end, tally = advance_replica(flow, state, steps, numerics, observe)
    engine = engine_of(flow, numerics, state, observe).name
    measured = Sample(tally, end.side**2, total_mass(end.grains), flow, engine)
    return end, _with_length(measured)


def _sample_with_callback(
    batch: Arguments,
    single: bool,
    numerics: Numerics,
    blocks: int,
    observe: Observe | None,
    callback: Callable[[State, Sample], Any],
) -> tuple[State, Sample]:
    """The sample of a batch, or of a batch of a single replica, block by block."""
    flow, start, strain = batch
    engine = select_engine(numerics, start).name

    def so_far(end: State, tallies: Sequence[Tally]) -> tuple[State, Sample]:
        """The sample in NumPy: JAX would compile this again for each number of blocks."""
        measured = _with_length(replace(sample_of_blocks(flow, end, tallies), engine=engine))
        state, measured = jax.tree.map(lambda x: x[0] if single else x, (end, measured))
        return jax.tree.map(jnp.asarray, state), measured

    advance = partial(advance_batch, observe=observe, threads=usable_threads())
    given_up = np.zeros(np.shape(start.side), bool)
    ended = advance_by_block(
        advance,
        (flow, numerics, start),
        strain,
        blocks,
        given_up,
        stop=lambda *done: callback(*so_far(*done)),
    )
    state, measured = so_far(*ended)
    return state, jax.tree.map(jnp.asarray, measured)


def _with_length(measured: Sample) -> Sample:
    """The sample with the status ``short_sample`` in its last block where it is short, see
    ``correlation_strain``.
    """
    of_length = length_status(measured.strain, measured.correlation_strain)
    status = measured.tally.status
    xp = jnp if isinstance(status, jax.Array) else np
    worst = xp.maximum(status, xp.asarray(of_length, status.dtype)[..., None])
    is_last = xp.arange(status.shape[-1]) == status.shape[-1] - 1
    tally = replace(measured.tally, status=xp.where(is_last, worst, status))
    return replace(measured, tally=tally)
