"""Sample: sums over a strain of a flow, kept in blocks, and the averages with errors that follow
from them.
"""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from jaxgran.contact.projected_methods import DEFAULT_SOLVER, ProjectedMethod
from jaxgran.dynamics.advance import advance_blocks
from jaxgran.dynamics.batch import checked_batch, shear_batch
from jaxgran.dynamics.engine import Engine, Numerics, checked_numerics
from jaxgran.dynamics.interruption import waited
from jaxgran.dynamics.tally import TABLE, Tally
from jaxgran.model.batches import Indexable, equal_values, in_numpy
from jaxgran.model.checks import (
    InputError,
    as_array,
    is_traced,
    require,
    require_untraced,
    require_whole,
    short_repr,
    two_digits,
)
from jaxgran.model.display import are_numbers, rounded, text_of
from jaxgran.model.flow import ShearFlow, require_strain, steps_of_blocks, steps_of_strain
from jaxgran.model.state import State, require_match, require_state
from jaxgran.model.status import Status
from jaxgran.sampling.averages import averages
from jaxgran.sampling.correlation_strain import flow_correlation_strain, length_status
from jaxgran.sampling.observables import OBSERVABLES, Averages
from jaxgran.sampling.observe import Observable, advance_and_observe
from jaxgran.statistics import (
    Estimates,
    correlation_length,
    error_correlation,
    merged_blocks,
    standard_errors,
)

if TYPE_CHECKING:
    import xarray as xr

BLOCKS = 32
MOST_BLOCKS = 10**6
ERROR_OBSERVABLES = (
    "force_ratio",
    "pressure",
    "shear_stress",
)  # a target for the relative error holds for these
_SMALLEST_MOTION = 20  # of a grain at velocity γ̇σ in one step, in roundings of a position

_SHOWN = (
    *("force_ratio", "pressure", "shear_stress", "granular_temperature"),
    *("coordination_number", "macroscopic_friction", "inertial_number"),
)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Sample(Averages, Indexable):
    """A measured strain of one replica; a batch has a leading (replicas,) axis everywhere.

    ==========  =========  ====  =================================================
    field       shape      unit  meaning
    ==========  =========  ====  =================================================
    tally       (blocks,)  –     sums over the steps of each block of strain
    area        ()         σ²    area of the cell
    shear_rate  ()         1/t   γ̇
    grains      static     –     number of grains
    ==========  =========  ====  =================================================

    Every observable is an attribute, such as ``sample.pressure``: the average over all blocks, in
    units of m, σ and the time unit t of the shear rate (1/γ̇ at the default γ̇ = 1). ``averages``
    has all of them by name, and ``errors()`` their standard errors. They are NumPy numbers, and JAX
    arrays only where JAX traces the sample. ``sample[0]`` is the sample of the first replica of a
    batch.
    """

    tally: Tally
    area: Float[Array | np.ndarray, "*replicas"]
    shear_rate: Float[Array | np.ndarray, "*replicas"]
    grains: int = field(metadata={"static": True})

    __eq__ = equal_values

    def __repr__(self) -> str:
        numbers = [getattr(self.tally, name) for name in TABLE]
        if (
            not are_numbers(*numbers, self.area, self.shear_rate)
            or np.ndim(self.tally.contact_moment) < 3
        ):
            return text_of("Sample", {"grains": self.grains, "area": self.area})
        sample = in_numpy(self)
        single, averages, status = not self._axes, sample.averages, np.asarray(sample.status)
        counts = Counter(Status(int(code)).name for code in status.flat).most_common()
        names = (name if single else f"{name} ({count})" for name, count in counts)
        return text_of(
            "Sample",
            {
                **({} if single else {"replicas": status.size}),
                "grains": self.grains,
                "strain": rounded(sample.strain),
                **{name: averages[name] for name in _SHOWN},
                "status": ", ".join(names),
            },
            sample.errors() if single else None,
        )

    @property
    def _axes(self) -> tuple[int, ...]:
        return np.shape(self.area)

    @property
    def averages(self) -> Mapping[str, Array | np.ndarray]:
        """All observables over all blocks, by name."""
        return averages(self._total, self.area, self.grains, self.shear_rate)

    @property
    def strain(self) -> Float[Array | np.ndarray, "*replicas"]:
        """The sampled strain, in whole time steps."""
        return self._total.duration * in_numpy(self.shear_rate)

    @property
    def status(self) -> Int[Array | np.ndarray, "*replicas"]:
        """The worst status, see ``Tally.outcome``; ``short_sample`` below four correlation
        strains.
        """
        return self._total.outcome

    @property
    def observed_sums(self) -> Any:
        """Sums over the steps of each block of what ``observe`` returns, a pytree; None without
        ``observe``.
        """
        return self.tally.observed

    @property
    def _total(self) -> Tally:
        return in_numpy(self.tally).total(axis=np.ndim(self.area))

    def errors(self) -> dict[str, np.ndarray]:
        """Standard errors of the averages by the names of the observables, see ``standard_errors``.

        Those of a batch are of each replica by itself, with its axes.

        Raises:
          InputError: JAX transforms this function.
        """
        require_untraced("errors()", "take it of the finished sample", self)
        here = in_numpy(self)
        if not np.ndim(here.area):
            return estimates([here])[1]
        each = [here[place].errors() for place in range(len(here.area))]
        return {name: np.stack([errors[name] for errors in each]) for name in each[0]}

    def to_dataset(self) -> "xr.Dataset":
        """The averages as an ``xarray.Dataset``, named as in a map: NAME, NAME_stderr, and the
        strain and the status.

        A batch has the dimension ``replica``, and tensors have ``axis_a`` and ``axis_b``.
        ``long_name`` says what a variable is. ``reduced_unit`` is its unit in m, σ and t. If
        ``observe`` returned a dictionary of numbers or arrays, their means are there too; an array
        has the dimensions NAME_dim_0, NAME_dim_1, …

        Raises:
          InputError: JAX transforms this function, or ``observe`` returned a name that an average
            has.
        """
        require_untraced("to_dataset()", "take it of the finished sample", self)
        from jaxgran.sampling.sample_dataset import dataset_of

        return dataset_of(self)

    def observed(self, estimate: Callable[[Any], Any] = lambda means: means) -> tuple[Any, Any]:
        """Means over all time steps of what ``observe`` returned, and their standard errors, for
        one replica.

        Args:
          estimate: a function of the means, such as a ratio of two of them. The errors are those of
            its result, see ``standard_errors``.

        Returns:
          Values and errors, two pytrees of the form that ``estimate`` returns.

        Raises:
          InputError: the sample was made without ``observe``, or it holds a batch, or JAX
            transforms this function.
        """
        if self.observed_sums is None:
            raise InputError(
                "observed() needs a sample that was made with observe=, and this one was made "
                "without."
            )
        if np.ndim(self.area):
            raise InputError(
                "observed() needs the sample of one replica, such as sample[0] of this batch."
            )
        require_untraced("observed()", "take it of the finished sample", self)

        return observed_estimates([self], estimate)


def observed_estimates(
    seeds: Sequence[Sample], estimate: Callable[[Any], Any] = lambda means: means
) -> tuple[Any, Any]:
    """``Sample.observed`` over several replicas of one flow."""

    def estimate_of_sums(sums: Any, steps: Array) -> Any:
        return estimate(jax.tree.map(lambda x: x / steps, sums))

    def leaves_by_number(parts: tuple[Any, Array]) -> dict[str, Array]:
        leaves = jax.tree.leaves(jax.vmap(estimate_of_sums)(*parts))
        return {str(k): leaf for k, leaf in enumerate(leaves)}

    parts = ((seed.observed_sums, seed.tally.steps) for seed in seeds)
    sums = jax.tree.map(lambda *x: np.stack([np.asarray(one) for one in x]), *parts)
    total = jax.tree.map(lambda x: x.sum(axis=(0, 1)), sums)
    structure = jax.tree.structure(jax.eval_shape(estimate_of_sums, *total))
    values, errors = standard_errors(leaves_by_number, sums, durations(seeds))
    return structure.unflatten(values.values()), structure.unflatten(errors.values())


def estimates(seeds: Sequence[Sample]) -> tuple[Estimates, Estimates]:
    """Averages over all blocks of several replicas of one flow, and their ``standard_errors``.

    For an extreme, such as the largest overlap, the value is the largest of all blocks. Its error
    is the standard deviation over the blocks.
    """
    average, sums = _stacked(seeds)
    values, errors = standard_errors(average, sums, durations(seeds))
    by_block = average(sums)
    extremes = {name: by_block[name] for name, one in OBSERVABLES.items() if one.extreme}
    largest = {name: np.asarray(x.max()) for name, x in extremes.items()}
    spread = {name: np.asarray(x.std() if x.size > 1 else np.nan) for name, x in extremes.items()}
    return values | largest, errors | spread


def relative_error(measured: Sample) -> float:
    """The largest relative standard error of ``ERROR_OBSERVABLES`` of one replica; infinite if one
    is not known.
    """
    values, errors = estimates([measured])
    with np.errstate(invalid="ignore", divide="ignore"):
        worst = max(
            np.nan_to_num(errors[x] / abs(values[x]), nan=np.inf) for x in ERROR_OBSERVABLES
        )
    return float(worst)


def correlation_strains(seeds: Sequence[Sample]) -> Estimates:
    """Strain of one independent sample, for every average over replicas of one flow.

    The sampled strain of all replicas over this strain is the effective sample size. A correlation
    shorter than a block of the longest replica cannot be resolved: the result is then the strain of
    this block.
    """
    average, sums = _stacked(seeds)
    strains = durations(seeds)
    lengths = correlation_length(average, sums, strains)
    count = merged_blocks(strains, *sums.duration.shape).sum()
    block = np.sum(sums.duration) / count * np.asarray(seeds[0].shear_rate)
    return {
        name: length * block for name, length in lengths.items() if not OBSERVABLES[name].extreme
    }


def error_correlation_of(seeds: Sequence[Sample], first: str, second: str) -> float:
    """Correlation of the errors of two averages over replicas of one flow."""
    average, sums = _stacked(seeds)

    def pair(sums: Tally) -> dict[str, Array]:
        found = average(sums)
        return {name: found[name] for name in (first, second)}

    return float(error_correlation(pair, sums, durations(seeds))[0, 1])


def durations(seeds: Sequence[Sample]) -> np.ndarray:
    """The sampled time of each replica, (seeds,)."""
    return np.array([np.sum(seed.tally.duration) for seed in seeds])


def _stacked(seeds: Sequence[Sample]) -> tuple[Callable[[Tally], dict[str, Array]], Tally]:
    """The averages as a function of sums, and the sums (seeds, blocks, ...) of the replicas of one
    flow.
    """
    first = seeds[0]
    sums = jax.tree.map(
        lambda *x: np.stack([np.asarray(one) for one in x]), *(seed.tally for seed in seeds)
    )
    return partial(
        averages, area=first.area, grains=first.grains, shear_rate=first.shear_rate
    ), sums


def sample(
    flow: ShearFlow,
    state: State,
    strain: float | Array,
    blocks: int = BLOCKS,
    observe: Observable | None = None,
    callback: Callable[[State, Sample], Any] | None = None,
    *,
    solver: ProjectedMethod = DEFAULT_SOLVER,
    engine: Engine | None = None,
) -> tuple[State, Sample]:
    """Shear a flow, or a batch of flows, and average its observables; ``jit``, ``vmap`` and
    ``lax.map`` apply.

    A batch is a flow or a state whose arrays have a leading (replicas,) axis; what lacks it is the
    same for all. Each replica has the results of its own call. ``jax.vmap`` of this function does
    the same. A batch is shared out to all cores of a processor, and batches of any size need one
    compilation there.

    The numba engine takes all blocks in one call, unless there is ``observe`` or ``callback``. Then
    every block begins with a new list of near pairs, and its trajectory differs by rounding, which
    grows as in any chaotic flow.

    The result of ``observe`` is averaged over **every** time step, in the same run (see
    ``observer``). A few instants do not suffice for contact forces: at a short time step, most
    instants of a collisional flow have no contact with a force. A function of the forces, which are
    ``impulses / timestep``, is averaged exactly. Positions and velocities are observed once a free
    flight; their averages are accurate up to the strain of a flight, about 1e-3.

    Args:
      flow: parameters of the state, with its packing fraction and polydispersity; or those
        (replicas,) of a batch.
      state: the flow at the beginning, usually from ``prepare``; or a batch of states.
      strain: strain γ̇t to sample, rounded to whole time steps; for a batch also (replicas,). A new
        value does not recompile.
      blocks: number of equal parts of the strain, static; a tally is kept for each.
      observe: a function of a ``Snapshot`` that returns a pytree of arrays to average. It is
        static: each new function, such as a lambda that is written anew, is compiled, so define it
        once. Beside the numba engine this takes about 2 s. Where the engine ``Jax`` runs, or the
        function uses values from outside that JAX traces, that engine is compiled with it, in about
        20 s. The next process loads the program. The contacts are those of a step with an
        approaching contact, before the impulses act; other steps have none. The size of their
        buffers varies, so ``observe`` must return sums over contacts or over grains.
      callback: called after each block with the state and the sample so far; if its result is true,
        the sample ends. One block is then compiled at a time, and neither batches nor JAX
        transformations apply.
      solver: solves the contacts of each step, by default ``BarzilaiBorwein()``. New numbers in it
        do not recompile.
      engine: ``Jax()`` or ``Numba()``; None for the fastest that can do this, see ``advance``.

    Returns:
      The final state and the sample; those of a batch have a leading (replicas,) axis.

    Raises:
      InputError: (a ValueError) the axes of a batch differ; the state has another packing fraction
        or polydispersity than the flow; the flow is not sheared; the strain is not a positive
        number, is shorter than one time step a block, or is longer than 2**31 - 1 time steps;
        positions in float32 cannot resolve the time step; the result of ``observe`` is not summed
        over contacts; or the engine cannot do this.

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
    batch = checked_batch(partial(_require_sheared_state, blocks), flow, state, strain)
    numerics = checked_numerics(solver, engine)
    for name, function in (("observe", observe), ("callback", callback)):
        if function is not None and not callable(function):
            raise InputError(f"{name} must be a function or None, not {short_repr(function)}.")
    if callback is None:
        if batch is None:
            return waited(_sample(flow, state, strain, numerics, blocks, observe))
        option = "" if observe is None else "observe"
        return shear_batch(_sample, numerics, batch, (blocks, observe), option)
    if batch or is_traced(flow, numerics, state, strain):
        raise InputError(
            "callback must be None for a batch, and where a sample is transformed, as by jax.jit."
        )
    return _sample_with_callback(
        flow, numerics, state, _steps_of_blocks(flow, strain, blocks), observe, callback
    )


def _require_sheared_state(blocks: int, flow: ShearFlow, state: State, strain: Any) -> None:
    """Raise an InputError unless a flow can shear a state by a strain of so many blocks."""
    require_state(flow, state)
    require_strain(flow, strain, blocks)
    require_match(flow, state)
    check_precision(flow, state)


@partial(jax.jit, static_argnames=("blocks", "observe"))
def _sample(
    flow: ShearFlow,
    state: State,
    strain: Array,
    numerics: Numerics,
    blocks: int,
    observe: Observable | None = None,
) -> tuple[State, Sample]:
    end, measured = _sample_blocks(
        flow, numerics, state, _steps_of_blocks(flow, strain, blocks), observe
    )
    return end, _with_length(measured, end)


def _steps_of_blocks(flow: ShearFlow, strain: float | Array, blocks: int) -> Int[Array, " blocks"]:
    return steps_of_blocks(steps_of_strain(flow, strain), blocks)


def _sample_blocks(
    flow: ShearFlow,
    numerics: Numerics,
    state: State,
    steps: Int[Array, " blocks"],
    observe: Observable | None,
) -> tuple[State, Sample]:
    """The final state and the sample of blocks with the given numbers of time steps."""

    def block(state: State, steps: Array) -> tuple[State, Tally]:
        return advance_and_observe(flow, numerics, state, steps, observe)

    if observe is None:
        state, tally = advance_blocks(flow, numerics, state, steps)
    else:
        state, tally = lax.scan(block, state, steps)
    shear_rate = jnp.asarray(flow.shear_rate, state.side.dtype)
    return state, Sample(tally, state.side**2, shear_rate, flow.grains)


_sample_one_block = jax.jit(_sample_blocks, static_argnames="observe")


def _sample_with_callback(
    flow: ShearFlow,
    numerics: Numerics,
    state: State,
    steps_of_blocks: Int[Array, " blocks"],
    observe: Observable | None,
    callback: Callable,
) -> tuple[State, Sample]:
    """The sample, block by block, with a call of ``callback`` after each."""
    parts: list[Sample] = []
    for steps in np.asarray(steps_of_blocks):
        measured = _sample_one_block(flow, numerics, state, jnp.asarray([steps]), observe)
        state, part = waited(measured)
        parts.append(part)
        if callback(state, _with_length(_joined(parts), state)):
            break
    return state, _with_length(_joined(parts), state)


def _with_length(measured: Sample, state: State) -> Sample:
    """The sample with the status ``short_sample`` in its last block where it is short, see
    ``correlation_strain``.
    """
    tally, grains = measured.tally, measured.grains
    total = averages(tally.total(axis=0), measured.area, grains, measured.shear_rate)
    mass = jnp.sum(state.grains.masses)
    correlation = flow_correlation_strain(total, grains, mass, measured.area, measured.shear_rate)
    status = length_status(jnp.sum(tally.duration) * measured.shear_rate, correlation)
    last = jnp.maximum(tally.status[-1], jnp.asarray(status, tally.status.dtype))
    return replace(
        measured, tally=replace(tally, status=jnp.asarray(tally.status).at[-1].set(last))
    )


def _joined(parts: list[Sample]) -> Sample:
    """One sample from successive samples of the same flow."""
    tallies = (part.tally for part in parts)
    tally = jax.tree.map(
        lambda *x: jnp.asarray(np.concatenate([np.asarray(one) for one in x])), *tallies
    )
    return replace(parts[-1], tally=tally)


def check_precision(flow: ShearFlow, state: State) -> None:
    """Raise an InputError if positions cannot resolve the time step; traced values are not checked.

    In one step a grain at velocity γ̇σ moves by γ̇ dt σ. In float32 a position in a cell of 20 σ is
    rounded to 2e-6 σ.

    The engines add the motion to displacements since the last build of the lists, which are far
    smaller. So a flow is wrong only if a step moves a pair by less than the rounding of its
    separation, 1e-7 σ. But summed times drift by 1e-3, and programs that compare the positions of
    two states see their rounding. So the limit is that of positions.
    """
    if is_traced(flow.timestep, flow.shear_rate, state.side):
        return
    rounding = np.finfo(state.positions.dtype).eps * float(np.asarray(state.side).max())
    least = _SMALLEST_MOTION * rounding
    if float(np.min(np.asarray(flow.timestep) * np.asarray(flow.shear_rate))) < least:
        raise InputError(
            f"timestep must be at least {two_digits(least, up=True)} / shear_rate for positions in "
            f"{state.positions.dtype}: "
            'use a longer one, or float64 (jax.config.update("jax_enable_x64", True)).'
        )
