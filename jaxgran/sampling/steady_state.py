"""Preparation of a flow: pack, heat, shear to the steady state, shorten the time step.

The stresses hardly depend on the time step, but the force ratio does. After a change of the time
step, the contact network needs a strain of up to 0.5 to adapt. So the flow is sheared to its steady
state at a coarse time step. The step is then shortened geometrically. At the final step the network
relaxes over a strain of 0.5 before the sample begins.

The test for a steady state is statistical. The flow is sheared in chunks, and the temperature T and
pressure P of each chunk are recorded. The last two thirds of the record are split into halves. The
means of ln T in the two halves must differ by less than twice the standard error of their
difference, or by less than 0.1, and this error must be at most 0.1. The same holds for ln P. In
this error, chunks are correlated over at least the correlation strain of the flow. Small systems
fluctuate more, so a flow that is undecided after the last chunk still counts as steady if the means
differ by less than four standard errors of the noise about a linear trend. How often this decides
rightly is in ``thresholds``.

A chunk lasts a quarter of the correlation strain, which is measured in the first chunks. So the
preparation takes at least three correlation strains.
"""

from dataclasses import replace
from functools import partial
from itertools import zip_longest
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxgran.contact.projected_methods import DEFAULT_SOLVER, ProjectedMethod
from jaxgran.dynamics.batch import run_batch
from jaxgran.dynamics.engine import DEFAULT_NUMERICS, Engine, Numerics, checked_numerics
from jaxgran.environment import usable_threads
from jaxgran.model.checks import require, require_number
from jaxgran.model.flow import ShearFlow, require_sheared
from jaxgran.model.grains import Grains
from jaxgran.model.state import State, check_precision
from jaxgran.model.status import GIVEN_UP, Status
from jaxgran.sampling.blocks import Batch, shear_by_block
from jaxgran.sampling.correlation_strain import flow_correlation_strain, total_mass
from jaxgran.sampling.drift import is_level, is_level_noise
from jaxgran.sampling.heated import heat_replica, replicas_of_keys, require_uncompiled
from jaxgran.sampling.observe import AdvanceBatch, advance_batch
from jaxgran.sampling.prediction import predicted
from jaxgran.sampling.sample import Sample
from jaxgran.sampling.thresholds import (
    FEWEST_CHUNKS,
    MEASURING_CHUNKS,
    MOST_CHUNKS,
    RELAXATION_STRAIN,
    SHORTENING_STRAIN,
    SHORTEST_CHUNK,
)
from jaxgran.sampling.timestep import (
    bounded_coarse_timestep,
    check_timestep,
    expected_temperature,
    timestep_ladder,
)


class NotPrepared(RuntimeError):
    """A flow, or some of a batch, could not be prepared.

    Attributes:
      states: what was reached, of all replicas.
      status: their statuses, (replicas,) for a batch.
    """

    def __init__(self, message: str, states: State, status: Any):
        super().__init__(message, states, status)
        self.states, self.status = states, status

    def __str__(self) -> str:
        return self.args[0]


def prepare(
    flow: ShearFlow,
    key: Array,
    equilibrate: float | None = None,
    grains: Grains | None = None,
    *,
    solver: ProjectedMethod = DEFAULT_SOLVER,
    engine: Engine | None = None,
) -> State:
    """A flow in its steady state at its time step, ready for ``sample``; or many of them at once.

    A batch of keys gives a batch of states. Each is, to rounding, what its flow and key alone give.

    Args:
      flow: parameters of one flow; or numbers (replicas,) of several flows.
      key: JAX random key; the same key gives the same state. Keys (replicas,) prepare a batch.
      equilibrate: strain at the coarse time step, or None to shear until the flow is steady. A
        given strain is not checked here. A map gives the status ``not_steady`` if it is shorter
        than the correlation strain of the flow.
      grains: given discs, see ``own_grains``, those of all replicas or with a leading (replicas,)
        axis; None for diameters uniform in σ ± ``polydispersity``.
      solver, engine: as in ``sample``, for all replicas.

    Returns:
      The state after packing, heating, shearing and relaxing; that of a batch has a leading
      (replicas,) axis.

    Raises:
      InputError: (a ValueError) the flow is not sheared, elastic grains are to become steady, a
        grain of thermal speed would cross more than a tenth of a diameter in one step, float32
        positions cannot resolve the step, ``pack`` does not accept the grains, or the engine cannot
        do this. Or this function, which decides in Python when a flow is steady, is called within
        ``jax.jit``, ``jax.vmap`` or a derivative.
      RuntimeError: the flow, or one of the batch, did not become steady or ended with a bad status.
        Its attributes ``states`` and ``status`` have what was reached, with those of the others.

    Examples:
      >>> flows = ShearFlow(grains=16, restitution=[0.5, 0.9], packing_fraction=0.5, timestep=1e-3)
      >>> states = prepare(flows, jax.random.split(jax.random.key(0), 2), equilibrate=0.4)
      >>> states[0].positions.shape, states.tilt.shape
      ((16, 2), (2,))
    """
    require_uncompiled("prepare", flow, key, grains)
    flows, keys, discs, single = replicas_of_keys(flow, key, grains)
    if equilibrate is not None:
        words = "None or a number of at least 0 and at most 1e6"
        require_number("equilibrate", equilibrate, lambda x: (x >= 0) & (x <= 1e6), words)
    else:
        words = "below 1 where a steady state is wanted, as elastic grains only heat up: give "
        words += "`equilibrate`, or begin with `jg.heated`"
        require("restitution", flow.restitution, lambda x: x < 1, words)
    require_sheared(flow)
    numerics = checked_numerics(solver, engine)
    on_all_cores = partial(advance_batch, threads=usable_threads())
    batch = prepare_batch(flows, keys, equilibrate, on_all_cores, grains=discs, numerics=numerics)
    tolerated = Status.ok if equilibrate is None else Status.not_steady
    states = jax.tree.map(lambda x: jnp.asarray(x[0] if single else x), batch.state)
    failed = {k: Status(x).name for k, x in enumerate(batch.status) if x > tolerated}
    if single and failed:
        raise NotPrepared(f"the flow could not be prepared: {failed[0]}.", states, batch.status[0])
    if failed:
        names = ", ".join(f"{k} ({name})" for k, name in failed.items())
        raise NotPrepared(
            f"not all replicas could be prepared: {names}; the attribute `states` of this error "
            "has the others.",
            states,
            batch.status,
        )
    return states


def prepare_batch(
    flow: ShearFlow,
    keys: Array | np.ndarray,
    equilibrate: float | None = None,
    advance: AdvanceBatch = advance_batch,
    grains: Grains | None = None,
    numerics: Numerics = DEFAULT_NUMERICS,
) -> Batch:
    """``prepare`` for a batch of flows: a failure is the status of its replica, not an exception.

    Given grains have a leading (replicas,) axis too. ``numerics`` are those of all replicas.
    """
    theory = predicted(flow, grains)
    check_timestep(flow, theory, grains)
    mass = 1.0 if grains is None else np.mean(grains.masses, axis=-1)
    expected = expected_temperature(
        theory.granular_temperature, flow.packing_fraction, flow.shear_rate, mass
    )
    temperature = expected.astype(theory.granular_temperature.dtype)
    state, packed = run_batch(heat_replica, (flow, keys, temperature, grains))
    check_precision(flow, state)
    status = np.where(np.asarray(packed), Status.ok, Status.infeasible)
    coarse = replace(flow, timestep=bounded_coarse_timestep(flow, theory, grains))
    predictions = {
        name: getattr(theory, name) for name in ("granular_temperature", "pressure", "shear_stress")
    }
    correlation_strain = flow_correlation_strain(
        predictions,
        flow.grains,
        total_mass(state.grains),
        np.asarray(state.side) ** 2,
        flow.shear_rate,
    )
    batch = Batch(coarse, numerics, state, status, np.zeros(len(status)), correlation_strain)
    if equilibrate is None:
        batch = _until_steady(batch, advance)
    elif equilibrate > 0:
        batch = _sheared(batch, np.full(len(status), equilibrate), advance, measure=True)
    if equilibrate is not None:
        too_short = equilibrate < batch.correlation_strain
        batch = batch._replace(
            status=np.maximum(batch.status, np.where(too_short, Status.not_steady, Status.ok))
        )
    return _shortened(batch, flow, advance)


def _sheared(
    batch: Batch, strain: np.ndarray, advance: AdvanceBatch, measure: bool = False
) -> Batch:
    """Shear every replica by its own strain, in blocks of at most 1 so that progress can be
    reported.

    With ``measure`` the last block gives the correlation strain.
    """
    blocks = max(1, int(np.ceil(np.max(strain))))
    batch, sample = shear_by_block(batch, strain, blocks, advance)
    batch = batch._replace(strain=batch.strain + strain)
    last = replace(sample, tally=jax.tree.map(lambda x: x[:, -1:], sample.tally))
    return _with_correlation_strain(batch, last) if measure else batch


def _with_correlation_strain(batch: Batch, sample: Sample) -> Batch:
    return batch._replace(correlation_strain=sample.correlation_strain)


def _until_steady(batch: Batch, advance: AdvanceBatch) -> Batch:
    """Shear in chunks until every replica is steady, or ``MOST_CHUNKS`` times; steady replicas are
    not advanced.
    """
    count = len(batch.status)
    steady, record = np.zeros(count, bool), []
    for chunks in range(1, MOST_CHUNKS + 1):
        waiting = steady | (batch.status >= GIVEN_UP)
        if waiting.all():
            break
        chunk = np.maximum(SHORTEST_CHUNK, batch.correlation_strain / 4)
        correlation = np.exp(-2 * chunk / batch.correlation_strain)
        strain = np.where(waiting, 0, chunk)
        batch, sample = shear_by_block(batch, strain, 1, advance)
        batch, means = batch._replace(strain=batch.strain + strain), sample.averages
        if chunks <= MEASURING_CHUNKS:
            batch = _with_correlation_strain(batch, sample)
        record.append(np.log(np.stack([means["granular_temperature"], means["pressure"]])))
        if chunks >= FEWEST_CHUNKS:
            late = np.stack(record[chunks // 3 :])
            judge = is_level if chunks < MOST_CHUNKS else is_level_noise
            level = [
                steady[k] or all(judge(late[:, q, k], correlation[k]) for q in (0, 1))
                for k in range(count)
            ]
            steady = steady | (np.array(level) & ~waiting)
    status = np.where(steady, Status.ok, Status.not_steady)
    return batch._replace(status=np.maximum(batch.status, status))


def _shortened(batch: Batch, flow: ShearFlow, advance: AdvanceBatch) -> Batch:
    """Shorten the time step geometrically from the coarse one to that of the flow, and relax at the
    final one.

    Every replica has its own series of time steps, which does not depend on the other replicas of
    the batch. A replica whose series has ended is not advanced.
    """
    coarse, final = np.asarray(batch.flow.timestep), np.asarray(flow.timestep)
    ladders = [timestep_ladder(*ends) for ends in zip(coarse[:, None], final[:, None], strict=True)]
    for timesteps in zip_longest(*ladders, fillvalue=np.nan):
        active = np.isfinite(timesteps)
        current = np.where(active, timesteps, final).astype(batch.state.side.dtype)
        batch = batch._replace(flow=replace(flow, timestep=current))
        batch = _sheared(batch, np.where(active, SHORTENING_STRAIN, 0.0), advance)
    batch = batch._replace(flow=flow)
    relaxation = np.where(coarse > final, RELAXATION_STRAIN, 0.0)
    return _sheared(batch, relaxation, advance) if relaxation.any() else batch
