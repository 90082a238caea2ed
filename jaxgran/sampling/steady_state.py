"""Steps of one simulation: pack, heat, shear to the steady state, shorten the time step, sample.

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
differ by less than four standard errors of the noise about a linear trend.

A chunk lasts a quarter of the correlation strain, which is measured in the first chunks. So the
preparation takes at least three correlation strains. A sample lasts six, unless its strain is
given; below four its status is ``short_sample``. A sample that ends when its estimated error is
small lasts at least twice as long: of shorter ones, it would select those that underestimate their
error.
"""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from itertools import zip_longest
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxgran.cache.persistent_jit import persistent_jit
from jaxgran.contact.projected_methods import DEFAULT_SOLVER, ProjectedMethod
from jaxgran.dynamics.batch import run_batch, stack
from jaxgran.dynamics.engine import DEFAULT_NUMERICS, Engine, Numerics, checked_numerics
from jaxgran.dynamics.tally import Tally
from jaxgran.environment import usable_threads
from jaxgran.model.checks import (
    InputError,
    is_traced,
    key_shape,
    require,
    require_key,
    require_number,
)
from jaxgran.model.flow import (
    ShearFlow,
    flow_of_replica,
    require_sheared,
    steps_of_blocks,
    steps_of_strain,
)
from jaxgran.model.grains import Grains
from jaxgran.model.state import State
from jaxgran.model.status import GIVEN_UP, Status
from jaxgran.sampling.averages import averages
from jaxgran.sampling.correlation_strain import (
    LEAST_SAMPLE,
    RELAXATION_STRAIN,
    SAMPLE_CORRELATION_STRAINS,
    flow_correlation_strain,
    length_status,
)
from jaxgran.sampling.observe import AdvanceBatch, advance_batch
from jaxgran.sampling.packing import pack, require_room
from jaxgran.sampling.prediction import predicted
from jaxgran.sampling.sample import BLOCKS, Sample, relative_error
from jaxgran.sampling.sampler import check_precision
from jaxgran.sampling.timestep import (
    bounded_coarse_timestep,
    check_timestep,
    expected_temperature,
    timestep_ladder,
)
from jaxgran.statistics import drift

LONGEST_STRAIN = 256.0  # of a sample that is extended until its errors are small
LONGEST_CORRELATION_STRAINS = 32.0  # the same limit in correlation strains, where it is longer
_SHORTENING_STRAIN = 0.1  # strain at each time step between the coarse and the final one
_SHORTEST_CHUNK = 0.75  # strain of a chunk
_FEWEST_CHUNKS = 12  # before the first test for a steady state
LEAST_PREPARATION = _FEWEST_CHUNKS * _SHORTEST_CHUNK  # strain, where it is not given
_MEASURING_CHUNKS = 4  # which set the length of later chunks; the test leaves them out
_MOST_CHUNKS = 60  # before the flow counts as not steady
_LARGEST_STEADY_RATIO = 2.0  # drift over its standard error, below which it is noise
_LARGEST_STEADY_DRIFT = 0.1  # in ln T and ln P; a smaller drift is accepted
_LARGEST_STEADY_ERROR = (
    0.1  # of the drift, in ln T and ln P; above it the test is undecided until the last chunk
)
_LARGEST_LAST_RATIO = 4.0  # of the drift over the error of the noise, after the last chunk
_UNCOMPILED = (
    "{} cannot be transformed by jax.jit, jax.vmap or jax.grad, since it decides in Python: call "
    "it before, with a "
    "batch of keys for many states, and pass its state to what is transformed."
)


class Batch(NamedTuple):
    """Replicas in preparation; all arrays but those of ``numerics`` have a leading (replicas,)
    axis.
    """

    flow: ShearFlow
    numerics: Numerics
    state: State
    status: Int[np.ndarray, " replicas"]
    strain: Float[np.ndarray, " replicas"]  # before the sample
    correlation_strain: Float[np.ndarray, " replicas"]


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

    A batch of keys gives as many states, each to rounding that of its own flow and key alone.

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
      InputError: (a ValueError) the flow is not sheared, a grain of thermal speed would cross more
        than a tenth of a diameter in one step, float32 positions cannot resolve the step, ``pack``
        does not accept the grains, or the engine cannot do this. Or this function, which decides in
        Python when a flow is steady, is called within ``jax.jit``, ``jax.vmap`` or a derivative.
      RuntimeError: the flow, or one of the batch, did not become steady or ended with a bad status.

    Examples:
      >>> flows = ShearFlow(grains=16, restitution=[0.5, 0.9], packing_fraction=0.5, timestep=1e-3)
      >>> states = prepare(flows, jax.random.split(jax.random.key(0), 2), equilibrate=0.4)
      >>> states[0].positions.shape, states.tilt.shape
      ((16, 2), (2,))
    """
    if is_traced(flow, key, grains):
        raise InputError(_UNCOMPILED.format("prepare"))
    flows, keys, discs, single = _replicas("prepare", flow, key, grains)
    if equilibrate is not None:
        words = "None or a number of at least 0 and at most 1e6"
        require_number("equilibrate", equilibrate, lambda x: (x >= 0) & (x <= 1e6), words)
    require_sheared(flow)
    numerics = checked_numerics(solver, engine)
    on_all_cores = partial(advance_batch, threads=usable_threads())
    batch = prepare_batch(flows, keys, equilibrate, on_all_cores, grains=discs, numerics=numerics)
    tolerated = Status.ok if equilibrate is None else Status.not_steady
    if single and batch.status[0] > tolerated:
        raise RuntimeError(f"the flow could not be prepared: {Status(batch.status[0]).name}.")
    failed = [
        f"{k} ({Status(status).name})"
        for k, status in enumerate(batch.status)
        if status > tolerated
    ]
    if failed:
        raise RuntimeError(f"not all replicas could be prepared: {', '.join(failed)}.")
    return jax.tree.map(lambda x: jnp.asarray(x[0] if single else x), batch.state)


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
    expected = expected_temperature(
        theory.granular_temperature, flow.packing_fraction, flow.shear_rate
    )
    temperature = expected.astype(theory.granular_temperature.dtype)
    state, packed = run_batch(_heated, (flow, keys, temperature, grains))
    check_precision(flow, state)
    status = np.where(np.asarray(packed), Status.ok, Status.infeasible)
    coarse = replace(flow, timestep=bounded_coarse_timestep(flow, theory, grains))
    predictions = {
        name: getattr(theory, name) for name in ("granular_temperature", "pressure", "shear_stress")
    }
    batch = Batch(coarse, numerics, state, status, np.zeros(len(status)), np.zeros(len(status)))
    batch = batch._replace(correlation_strain=_correlation_strain(batch, predictions))
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


def sample_batch(
    batch: Batch,
    strain: float | None,
    advance: AdvanceBatch = advance_batch,
    error: float | None = None,
) -> tuple[Batch, Sample]:
    """Sample every replica of a batch in blocks whose numbers of time steps differ by one at most.

    Args:
      batch: prepared replicas.
      strain: strain to sample, or None for six correlation strains of each flow, at least 8.
      advance: advances the batch.
      error: target for the relative standard error of each of ``ERROR_OBSERVABLES``. The strain of
        a replica begins with twice the one without a target, and is doubled until the target is
        reached, up to ``LONGEST_STRAIN`` or 32 correlation strains, where its status is
        ``strain_limit``. None samples ``strain`` only.
    """
    strains = (
        np.maximum(LEAST_SAMPLE, SAMPLE_CORRELATION_STRAINS * batch.correlation_strain)
        if strain is None
        else np.full_like(batch.correlation_strain, strain)
    )
    if error is not None and strain is None:
        strains = 2 * strains
    longest = np.maximum(LONGEST_STRAIN, LONGEST_CORRELATION_STRAINS * batch.correlation_strain)
    imprecise = np.zeros(len(strains), bool)
    batch, tally = _blocks(batch, strains, BLOCKS, advance)
    while error is not None:
        imprecise = np.array([relative_error(one) for one in _as_sample(batch, tally)]) > error
        extended = imprecise & (2 * strains <= longest) & (batch.status < GIVEN_UP)
        if not extended.any():
            break
        batch, more = _blocks(batch, np.where(extended, strains, 0), BLOCKS // 2, advance)
        strains = np.where(extended, 2 * strains, strains)
        tally = jax.tree.map(partial(_where_replica, extended), _doubled(tally, more), tally)
    sample = _as_sample(batch, tally)
    batch = batch._replace(
        correlation_strain=_correlation_strain(batch, _averages(batch, sample._total))
    )
    of_length = length_status(strains, batch.correlation_strain)
    of_error = np.where(imprecise, Status.strain_limit, Status.ok)
    return batch._replace(
        status=np.maximum.reduce([batch.status, of_length, of_error, sample.status])
    ), sample


def heated(
    flow: ShearFlow, key: Array, temperature: float = 1.0, grains: Grains | None = None
) -> State:
    """A random packing with Gaussian velocities of a given granular temperature; or many of them at
    once.

    It is the start of a free cooling, or of a flow that the user equilibrates.

    Args:
      flow: parameters of one flow, sheared or not; or numbers (replicas,) of several flows.
      key: JAX random key; the same key gives the same state. Keys (replicas,) make a batch, as in
        ``prepare``.
      temperature: exact value of Σ m c²/(2N), in mσ²/t², of all replicas or (replicas,). Grains of
        every mass have this temperature on average. The total momentum is zero.
      grains: given discs, see ``own_grains`` and ``prepare``; None for diameters uniform in σ ±
        ``polydispersity``.

    Raises:
      InputError: (a ValueError) the temperature is not a positive number, ``pack`` does not accept
        the grains, or this function is called within ``jax.jit``, ``jax.vmap`` or a derivative.
      RuntimeError: no packing was found.
    """
    if is_traced(flow, key, temperature, grains):
        raise InputError(_UNCOMPILED.format("heated"))
    flows, keys, discs, single = _replicas("heated", flow, key, grains)

    def accepted(x: np.ndarray) -> Any:
        return (x > 0) & np.isfinite(x) & (x.shape in ((), (len(keys),) if not single else ()))

    require("temperature", temperature, accepted, "a positive number")
    temperatures = jnp.broadcast_to(jnp.asarray(temperature, float), len(keys))
    state, found = run_batch(_heated, (flows, keys, temperatures, discs))
    if not np.all(found):
        raise RuntimeError(
            "no packing without overlap was found: the packing fraction is too high for these "
            "grains."
        )
    return jax.tree.map(lambda x: jnp.asarray(x[0] if single else x), state)


def _replicas(
    name: str, flow: ShearFlow, key: Array, grains: Grains | None
) -> tuple[ShearFlow, Array, Grains | None, bool]:
    """Flows, keys and given grains with a leading (replicas,) axis, and whether they are those of
    one replica.

    InputError if the key is not one or several, if the others do not suit it, or if JAX compiles
    the function.
    """
    if is_traced(jnp.zeros(())):  # inside of ``jax.jit``, whatever the arguments are
        raise InputError(_UNCOMPILED.format(name))
    shape = key_shape(key)
    if shape is None or len(shape) > 1 or shape == (0,):
        require_key(key)
    single, count = shape == (), 1 if not shape else shape[0]
    flows = [flow_of_replica(flow, k, count) for k in range(count)]
    keys = key[None] if single else key
    if grains is None:
        return stack(flows), keys, None, single
    batched = not single and isinstance(grains, Grains) and np.ndim(grains.radii) == 2
    discs = [
        jax.tree.map(lambda x, k=k: np.asarray(x)[k], grains) if batched else grains
        for k in range(count)
    ]
    for one, its in zip(flows, discs, strict=True):
        require_room(one, its)
    return (
        stack(flows),
        keys,
        jax.tree.map(lambda *x: jnp.asarray(np.stack(x), float), *discs),
        single,
    )


def _heated_replica(
    flow: ShearFlow, key: Array, temperature: Array, grains: Grains | None
) -> tuple[State, Bool[Array, ""]]:
    """A packing with Gaussian velocities of a given temperature and no total momentum; False if
    none was found.
    """
    key = jax.random.wrap_key_data(key) if key.dtype == jnp.uint32 else key
    pack_key, heat_key = jax.random.split(key)
    state, found = pack(flow, pack_key, grains)
    masses = state.grains.masses[:, None]
    velocities = jax.random.normal(heat_key, state.positions.shape, masses.dtype) / jnp.sqrt(masses)
    velocities = velocities - jnp.sum(masses * velocities, axis=0, keepdims=True) / jnp.sum(masses)
    drawn = jnp.sum(masses * velocities**2) / (2 * flow.grains)
    return replace(state, velocities=velocities * jnp.sqrt(temperature / drawn)), found


_heated = persistent_jit(_heated_replica)


def _chunk(batch: Batch, strain: np.ndarray, advance: AdvanceBatch) -> tuple[Batch, Tally]:
    """Advance every replica by its own strain."""
    return _advanced(batch, steps_of_strain(batch.flow, strain), advance)


def _advanced(batch: Batch, steps: np.ndarray, advance: AdvanceBatch) -> tuple[Batch, Tally]:
    """Advance every replica by its own number of time steps; one that is given up stays as it
    is.
    """
    unfinished = batch.status < GIVEN_UP
    counts = np.where(unfinished, steps, 0).astype(np.int32)
    state, tally = advance(batch.flow, batch.numerics, batch.state, counts)
    tally = jax.tree.map(np.asarray, tally)
    failed = np.where(
        tally.status >= GIVEN_UP, tally.status, Status.ok
    )  # the sample reports milder ones
    return batch._replace(state=state, status=np.maximum(batch.status, failed)), tally


def _blocks(
    batch: Batch, strain: np.ndarray, count: int, advance: AdvanceBatch
) -> tuple[Batch, Tally]:
    """Advance every replica by its own strain in ``count`` blocks, and keep all tallies, (replicas,
    count).
    """
    tallies = []
    for steps in steps_of_blocks(steps_of_strain(batch.flow, strain), count).T:
        batch, tally = _advanced(batch, steps, advance)
        tallies.append(tally)
    return batch, jax.tree.map(lambda *x: np.stack(x, axis=1), *tallies)


def _doubled(tally: Tally, more: Tally) -> Tally:
    """The same number of blocks with twice the strain: pairs of old blocks joined, then the new
    blocks ``more``.
    """
    pairs = jax.tree.map(lambda x: x.reshape(x.shape[0], -1, 2, *x.shape[2:]), tally).total(axis=2)
    return jax.tree.map(lambda old, new: np.concatenate([old, new], axis=1), pairs, more)


def _where_replica(chosen: np.ndarray, new: Array, old: Array) -> np.ndarray:
    """``new`` in chosen replicas and ``old`` in the others."""
    return np.where(chosen.reshape(-1, *(1,) * (np.ndim(old) - 1)), new, old)


def _as_sample(batch: Batch, tally: Tally) -> Sample:
    """The sample of a batch from its tallies, (replicas, blocks)."""
    side, shear_rate = np.asarray(batch.state.side), np.asarray(batch.flow.shear_rate)
    return Sample(tally, side**2, shear_rate, batch.flow.grains)


def _sheared(
    batch: Batch, strain: np.ndarray, advance: AdvanceBatch, measure: bool = False
) -> Batch:
    """Shear every replica by its own strain, in chunks of at most 1 so that progress can be
    reported.

    With ``measure`` the last chunk gives the correlation strain.
    """
    chunks = max(1, int(np.ceil(np.max(strain))))
    for steps in steps_of_blocks(steps_of_strain(batch.flow, strain), chunks).T:
        batch, tally = _advanced(batch, steps, advance)
        if measure:
            batch = batch._replace(
                correlation_strain=_correlation_strain(batch, _averages(batch, tally))
            )
    return batch._replace(strain=batch.strain + strain)


def _correlation_strain(batch: Batch, averages: Mapping[str, np.ndarray]) -> np.ndarray:
    """Correlation strain of each flow of a batch, see ``flow_correlation_strain``."""
    masses = np.ascontiguousarray(
        batch.state.grains.masses
    )  # or the order of the sum would depend on their place
    mass, area = np.sum(masses, axis=-1), np.asarray(batch.state.side) ** 2
    return flow_correlation_strain(averages, batch.flow.grains, mass, area, batch.flow.shear_rate)


def _until_steady(batch: Batch, advance: AdvanceBatch) -> Batch:
    """Shear in chunks until every replica is steady, or ``_MOST_CHUNKS`` times; steady replicas are
    not advanced.
    """
    count = len(batch.status)
    steady, record = np.zeros(count, bool), []
    for chunks in range(1, _MOST_CHUNKS + 1):
        waiting = steady | (batch.status >= GIVEN_UP)
        if waiting.all():
            break
        chunk = np.maximum(_SHORTEST_CHUNK, batch.correlation_strain / 4)
        correlation = np.exp(-2 * chunk / batch.correlation_strain)
        batch, tally = _chunk(batch, np.where(waiting, 0, chunk), advance)
        batch = batch._replace(strain=batch.strain + np.where(waiting, 0, chunk))
        means = _averages(batch, tally)
        if chunks <= _MEASURING_CHUNKS:
            batch = batch._replace(correlation_strain=_correlation_strain(batch, means))
        record.append(np.log(np.stack([means["granular_temperature"], means["pressure"]])))
        if chunks >= _FEWEST_CHUNKS:
            late = np.stack(record[chunks // 3 :])
            judge = _is_level if chunks < _MOST_CHUNKS else _is_level_noise
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
        batch = _sheared(batch, np.where(active, _SHORTENING_STRAIN, 0.0), advance)
    batch = batch._replace(flow=flow)
    relaxation = np.where(coarse > final, RELAXATION_STRAIN, 0.0)
    return _sheared(batch, relaxation, advance) if relaxation.any() else batch


def _is_level(series: np.ndarray, least_correlation: float = 0.0) -> bool:
    """Whether the means of the two halves of a series agree, and the error of their difference is
    small.
    """
    difference, error = drift(series, least_correlation)
    return bool(
        error <= _LARGEST_STEADY_ERROR
        and abs(difference) <= max(_LARGEST_STEADY_RATIO * error, _LARGEST_STEADY_DRIFT)
    )


def _is_level_noise(series: np.ndarray, least_correlation: float = 0.0) -> bool:
    """Whether the means of the two halves of a long series agree within its noise, which may be
    large.
    """
    place = np.arange(len(series)) - (len(series) - 1) / 2
    slope = np.sum(place * series) / np.sum(place**2)
    difference, _ = drift(series)
    _, error = drift(series - slope * place, least_correlation)
    return bool(abs(difference) <= max(_LARGEST_LAST_RATIO * error, _LARGEST_STEADY_DRIFT))


def _averages(batch: Batch, tally: Tally) -> dict[str, np.ndarray]:
    """All observables of tallies of a batch, (replicas,), as NumPy arrays."""
    area, shear_rate = np.asarray(batch.state.side) ** 2, np.asarray(batch.flow.shear_rate)
    with np.errstate(invalid="ignore"):
        return jax.tree.map(np.asarray, averages(tally, area, batch.flow.grains, shear_rate))
