"""Protocol of one measurement: pack, heat, shear to the steady state, shorten the time step, sample.

The stresses hardly depend on the time step, the force ratio does, and after a change of the time step the contact
network needs a strain of up to a half to forget the old one. So the steady state is reached at a coarse step, the step
is then shortened geometrically, and the network relaxes over a strain of 0.5 at the final one before it is sampled.

Stationarity is a statistical statement. The flow is sheared in chunks, and the temperature T and pressure P of each are
recorded. Of the later two thirds of the record, the means of ln T and ln P over the first and the second half must
differ by less than twice the standard error of that difference or by less than 0.1, and that error must be at most 0.1;
if both hold for both, the flow is steady. The error counts chunks as correlated at least as much as the memory of the
flow says.
"""

from dataclasses import replace
from functools import partial
from itertools import pairwise, zip_longest
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxgran.dynamics.tally import Tally
from jaxgran.model.checks import require_key, require_number
from jaxgran.model.flow import ShearFlow, require_flow, require_sheared
from jaxgran.model.grains import Grains
from jaxgran.model.state import State
from jaxgran.model.status import Status
from jaxgran.sampling.batch import Drive, advance_batch, replicated, stack
from jaxgran.sampling.observables import averages
from jaxgran.sampling.packing import pack, require_room
from jaxgran.sampling.sample import BLOCKS, Sample, check_precision, relative_error
from jaxgran.sampling.timestep import COARSE_TIMESTEP, bounded_coarse_timestep, check_timestep, timestep_ladder
from jaxgran.statistics import drift
from jaxgran.theory.gaussian_moments import gaussian_moments, mixture_moments
from jaxgran.theory.steady_shear import SteadyShear

RELAXATION_STRAIN = 0.5  # at the final time step
LONGEST_STRAIN = 256.0  # of a sample that is made longer until its errors are small
_SHORTENING_STRAIN = 0.1  # at each time step between
_SHORTEST_CHUNK = 0.75  # strain
_FEWEST_CHUNKS, _MOST_CHUNKS = 12, 60
_SIGNIFICANT, _LEVEL, _PRECISE = 2.0, 0.1, 0.1
_SAMPLE_SIGNIFICANT, _SAMPLE_LEVEL = 4.0, 0.2  # a sample drifts that exceeds both, in errors and in ln P or ln T
_CLUSTER_STRAIN = 1.0  # in which the clusters of a dissipative flow wander: blocks of a sample that are closer, agree
_DRIFT_BLOCKS = 16
_SIZE_CLASSES = 8  # of grains of one's own, for kinetic theory
_ELASTIC = 0.99  # above it theory's temperature diverges; the start is taken from here


class Batch(NamedTuple):
    """Replicas on their way through the protocol: everything has a leading (replicas,) axis."""

    flow: ShearFlow
    state: State
    status: Int[np.ndarray, " replicas"]
    strain: Float[np.ndarray, " replicas"]  # sheared before the sample


def prepare(flow: ShearFlow, key: Array, equilibrate: float | None = None, grains: Grains | None = None) -> State:
    """A flow in its steady state at its time step, ready to be sampled.

    Args:
      flow: parameters of one flow.
      key: JAX random key; the same key gives the same state.
      equilibrate: strain to shear at the coarse time step, or None to shear until the flow is steady. A given
        strain is taken as it is, though a map calls a point whose strain is shorter than its memory not steady.
      grains: discs of one's own, see ``own_grains``; None for diameters uniform in σ ± ``polydispersity``.

    Returns:
      The state after packing, heating, shearing and relaxing.

    Raises:
      ValueError: the flow is not sheared, a grain of thermal speed would cross more than a tenth of a diameter in one
        step, float32 positions cannot resolve the step, or the grains are not as ``pack`` accepts them.
      RuntimeError: the flow did not become steady, or ended with a bad status.
    """
    require_flow(flow)
    require_key(key)
    if equilibrate is not None:
        words = "None or a number of at least 0 and at most 1e6"
        require_number("equilibrate", equilibrate, lambda x: (x >= 0) & (x <= 1e6), words)
    require_sheared(flow)
    batch = prepare_batch(stack([flow]), key[None], equilibrate, grains=_as_batch(flow, grains))
    tolerated = Status.ok if equilibrate is None else Status.not_steady
    if batch.status[0] > tolerated:
        raise RuntimeError(f"the flow could not be prepared: {Status(batch.status[0]).name}.")
    return jax.tree.map(lambda x: x[0], batch.state)


def prepare_batch(
    flow: ShearFlow,
    keys: Array,
    equilibrate: float | None = None,
    drive: Drive = advance_batch,
    coarse_timestep: float = COARSE_TIMESTEP,
    grains: Grains | None = None,
) -> Batch:
    """``prepare`` for a batch of flows: problems are statuses of single replicas, never exceptions.

    Grains of one's own have a leading (replicas,) axis like all else.
    """
    theory = predicted(flow, grains)
    check_timestep(flow, theory, grains)
    state, packed = _heated(flow, keys, theory.granular_temperature, grains)
    check_precision(flow, state)
    status = np.where(np.asarray(packed), Status.ok, Status.infeasible)
    coarse = replace(flow, timestep=bounded_coarse_timestep(flow, theory, coarse_timestep, grains))
    batch = Batch(coarse, state, status, np.zeros(len(status)))
    if equilibrate is None:
        batch = _until_steady(batch, theory, drive)
    else:
        too_short = equilibrate < _memory(batch, theory)
        batch = _sheared(batch, np.full(len(status), equilibrate), drive) if equilibrate > 0 else batch
        batch = batch._replace(status=np.maximum(batch.status, np.where(too_short, Status.not_steady, Status.ok)))
    return _shortened(batch, flow, drive)


def sample_batch(
    batch: Batch, strain: float, drive: Drive = advance_batch, error: float | None = None
) -> tuple[Batch, Sample]:
    """Sample every replica of a batch in blocks of equal strain; a drift within the sample makes it not steady.

    Args:
      batch: prepared replicas.
      strain: strain to sample.
      drive: advances the batch; what it does is all that changes the state.
      error: relative standard error of each of ``ERROR_OBSERVABLES`` until which the strain of a replica is doubled,
        as long as it stays within ``LONGEST_STRAIN``; None to sample the strain as it is.
    """
    strains = np.full(len(batch.status), strain)
    batch, tally = _blocks(batch, strains / BLOCKS, BLOCKS, drive)
    while error is not None:
        worst = np.array([relative_error(one) for one in _split(_as_sample(batch, tally))])
        extended = (worst > error) & (2 * strains <= LONGEST_STRAIN) & (batch.status < Status.nonfinite)
        if not extended.any():
            break
        strains = np.where(extended, 2 * strains, strains)
        batch, more = _blocks(batch, np.where(extended, strains / BLOCKS, 0), BLOCKS // 2, drive)
        tally = jax.tree.map(partial(_where_replica, extended), _doubled(tally, more), tally)
    measured = _as_sample(batch, tally)
    merged = jax.tree.map(lambda x: x.reshape(x.shape[0], _DRIFT_BLOCKS, -1, *x.shape[2:]), tally).total(axis=2)
    area, shear_rate = (np.asarray(x)[:, None] for x in (measured.area, measured.shear_rate))
    by_block = _averages(merged, area, batch.flow.grains, shear_rate)
    memory = np.maximum(_CLUSTER_STRAIN, _memory(batch, predicted(batch.flow)))
    correlation = np.exp(-strains / _DRIFT_BLOCKS / memory)
    series = np.log(np.stack([by_block["pressure"], by_block["granular_temperature"]], axis=1))
    drifting = [any(_drifts(one, rho) for one in pair) for pair, rho in zip(series, correlation, strict=True)]
    status = np.maximum(batch.status, np.where(drifting, Status.not_steady, Status.ok))
    return batch._replace(status=np.maximum(status, tally.status.max(axis=1))), measured


@jax.jit
def predicted(flow: ShearFlow, grains: Grains | None = None) -> SteadyShear:
    """Kinetic theory's prediction for every flow of a batch, with α held below 0.99 (where T diverges).

    Grains of one's own are taken as a mixture of eight classes, by diameter and then by mass.
    """
    alpha = jnp.minimum(flow.restitution, _ELASTIC)
    if grains is None:
        return jax.vmap(gaussian_moments)(alpha, flow.packing_fraction, flow.shear_rate, flow.polydispersity)
    return jax.vmap(mixture_moments)(alpha, flow.packing_fraction, flow.shear_rate, *jax.vmap(_classes)(grains))


def _classes(grains: Grains) -> tuple[Float[Array, " classes"], Float[Array, " classes"]]:
    """Mean diameters and masses of equal shares of the grains, in the order of their diameters and masses."""
    order = jnp.lexsort((grains.masses, grains.radii))
    edges = np.arange(_SIZE_CLASSES + 1) * order.size // _SIZE_CLASSES
    members = [order[first:last] for first, last in pairwise(edges)]
    diameters = jnp.stack([2 * jnp.mean(grains.radii[one]) for one in members])
    return diameters / jnp.mean(diameters), jnp.stack([jnp.mean(grains.masses[one]) for one in members])


def heated(flow: ShearFlow, key: Array, temperature: float = 1.0, grains: Grains | None = None) -> State:
    """A random packing with Gaussian velocities of a granular temperature: the beginning of a free cooling, or of any
    flow that one equilibrates oneself.

    Args:
      flow: parameters of one flow, sheared or not.
      key: JAX random key; the same key gives the same state.
      temperature: Σ m c²/(2N) in mσ²/t², exactly. Grains of all masses have it on average, and no total momentum.
      grains: discs of one's own, see ``own_grains``; None for diameters uniform in σ ± ``polydispersity``.

    Raises:
      ValueError: the temperature is not a positive number, or the grains are not as ``pack`` accepts them.
      RuntimeError: no packing was found.
    """
    require_flow(flow)
    require_key(key)
    require_number("temperature", temperature, lambda x: (x > 0) & np.isfinite(x), "a positive number")
    state, found = _heated(stack([flow]), key[None], jnp.asarray([temperature], float), _as_batch(flow, grains))
    if not found[0]:
        raise RuntimeError("no packing without overlap was found: the packing fraction is too high for these grains.")
    return jax.tree.map(lambda x: x[0], state)


def _as_batch(flow: ShearFlow, grains: Grains | None) -> Grains | None:
    """Grains of one's own as those of a batch of one, if they suit the flow."""
    if grains is None:
        return None
    require_room(flow, grains)
    return jax.tree.map(lambda x: jnp.asarray(x, float)[None], grains)


@jax.jit
def _heated(
    flow: ShearFlow, keys: Array, temperature: Array, grains: Grains | None = None
) -> tuple[State, Bool[Array, " replicas"]]:
    """Packings with Gaussian velocities of the given temperature and no total momentum."""

    def one(flow: ShearFlow, key: Array, temperature: Array, grains: Grains | None):
        pack_key, heat_key = jax.random.split(key)
        state, found = pack(flow, pack_key, grains)
        masses = state.grains.masses[:, None]
        velocities = jax.random.normal(heat_key, state.positions.shape, masses.dtype) / jnp.sqrt(masses)
        velocities = velocities - jnp.sum(masses * velocities, axis=0, keepdims=True) / jnp.sum(masses)
        now = jnp.sum(masses * velocities**2) / (2 * flow.grains)
        return replace(state, velocities=velocities * jnp.sqrt(temperature / now)), found

    return replicated(one)(flow, keys, temperature, grains)


def _chunk(batch: Batch, strain: np.ndarray, drive: Drive) -> tuple[Batch, Tally]:
    """Advance every replica by its own strain; replicas that are no longer finite stay where they are."""
    alive = batch.status < Status.nonfinite
    steps = np.round(strain / (np.asarray(batch.flow.shear_rate) * np.asarray(batch.flow.timestep)))
    state, tally = drive(batch.flow, batch.state, jnp.asarray(np.where(alive, steps, 0), jnp.int32))
    tally = jax.tree.map(np.asarray, tally)
    lost = np.where(tally.status >= Status.infeasible, tally.status, Status.ok)  # the rest is for the sample to judge
    return batch._replace(state=state, status=np.maximum(batch.status, lost)), tally


def _blocks(batch: Batch, strain: np.ndarray, count: int, drive: Drive) -> tuple[Batch, Tally]:
    """Advance every replica by its own strain a number of times, and keep the tally of each, (replicas, count)."""
    tallies = []
    for _ in range(count):
        batch, tally = _chunk(batch, strain, drive)
        tallies.append(tally)
    return batch, jax.tree.map(lambda *x: np.stack(x, axis=1), *tallies)


def _doubled(tally: Tally, more: Tally) -> Tally:
    """As many blocks of twice the strain: those of a tally joined in pairs, and half as many new ones."""
    pairs = jax.tree.map(lambda x: x.reshape(x.shape[0], -1, 2, *x.shape[2:]), tally).total(axis=2)
    return jax.tree.map(lambda old, new: np.concatenate([old, new], axis=1), pairs, more)


def _where_replica(chosen: np.ndarray, new: Array, old: Array) -> np.ndarray:
    return np.where(chosen.reshape(-1, *(1,) * (np.ndim(old) - 1)), new, old)


def _as_sample(batch: Batch, tally: Tally) -> Sample:
    side, shear_rate = np.asarray(batch.state.side), np.asarray(batch.flow.shear_rate)
    return Sample(tally, side**2, shear_rate, batch.flow.grains)


def _split(measured: Sample) -> list[Sample]:
    return [jax.tree.map(lambda x, k=k: x[k], measured) for k in range(len(measured.area))]


def _sheared(batch: Batch, strain: np.ndarray, drive: Drive, longest: float = 1.0) -> Batch:
    """Shear every replica by its own strain, in chunks short enough to report progress."""
    chunks = max(1, int(np.ceil(np.max(strain) / longest)))
    for _ in range(chunks):
        batch, _ = _chunk(batch, strain / chunks, drive)
    return batch._replace(strain=batch.strain + strain)


def _memory(batch: Batch, theory: SteadyShear) -> np.ndarray:
    """Strain that a flow remembers: that of its contact network, or that in which the shear heats it if longer."""
    density = batch.flow.grains / np.asarray(batch.state.side) ** 2
    heating = density * np.asarray(theory.granular_temperature) / np.asarray(theory.shear_stress)
    return np.maximum(RELAXATION_STRAIN, heating)


def _until_steady(batch: Batch, theory: SteadyShear, drive: Drive) -> Batch:
    """Shear in chunks until every replica is steady or has used up its chunks; steady ones wait."""
    memory = _memory(batch, theory)
    chunk = np.maximum(_SHORTEST_CHUNK, memory / 2)
    correlation = np.exp(-chunk / memory)
    count = len(batch.status)
    steady, record = np.zeros(count, bool), []
    area, shear_rate = np.asarray(batch.state.side) ** 2, np.asarray(batch.flow.shear_rate)
    for chunks in range(1, _MOST_CHUNKS + 1):
        waiting = steady | (batch.status == Status.nonfinite)
        if waiting.all():
            break
        batch, tally = _chunk(batch, np.where(waiting, 0, chunk), drive)
        batch = batch._replace(strain=batch.strain + np.where(waiting, 0, chunk))
        now = _averages(tally, area, batch.flow.grains, shear_rate)
        record.append(np.log(np.stack([now["granular_temperature"], now["pressure"]])))
        if chunks >= _FEWEST_CHUNKS:
            late = np.stack(record[chunks // 3 :])
            level = [steady[k] or all(_is_level(late[:, q, k], correlation[k]) for q in (0, 1)) for k in range(count)]
            steady = steady | (np.array(level) & ~waiting)
    bad = np.where(steady, Status.ok, Status.not_steady)
    return batch._replace(status=np.maximum(batch.status, bad))


def _shortened(batch: Batch, flow: ShearFlow, drive: Drive) -> Batch:
    """Shorten the time step geometrically from the coarse one to that of the flow, and relax at the final one.

    Every replica goes down a ladder of its own, computed alone, whatever the others of its batch do; those that are at
    the foot of theirs wait.
    """
    coarse, final = np.asarray(batch.flow.timestep), np.asarray(flow.timestep)
    ladders = [timestep_ladder(*ends) for ends in zip(coarse[:, None], final[:, None], strict=True)]
    for rungs in zip_longest(*ladders, fillvalue=np.nan):
        going = np.isfinite(rungs)
        between = jnp.asarray(np.where(going, rungs, final), batch.state.side.dtype)
        batch = batch._replace(flow=replace(flow, timestep=between))
        batch = _sheared(batch, np.where(going, _SHORTENING_STRAIN, 0.0), drive)
    batch = batch._replace(flow=flow)
    relaxation = np.where(coarse > final, RELAXATION_STRAIN, 0.0)
    return _sheared(batch, relaxation, drive) if relaxation.any() else batch


def _is_level(series: np.ndarray, least_correlation: float = 0.0) -> bool:
    """Whether the halves of a series agree within the noise or a tenth, and the noise is small."""
    difference, error = drift(series, least_correlation)
    return bool(error <= _PRECISE and abs(difference) <= max(_SIGNIFICANT * error, _LEVEL))


def _drifts(series: np.ndarray, least_correlation: float = 0.0) -> bool:
    """Whether the halves of a sample differ beyond doubt and by more than matters; True where it is not finite."""
    difference, error = drift(series, least_correlation)
    return not abs(difference) <= max(_SAMPLE_SIGNIFICANT * error, _SAMPLE_LEVEL)


def _averages(tally: Tally, area: np.ndarray, grains: int, shear_rate: np.ndarray) -> dict[str, np.ndarray]:
    with np.errstate(invalid="ignore"):
        return jax.tree.map(np.asarray, partial(averages, grains=grains)(tally, area=area, shear_rate=shear_rate))
