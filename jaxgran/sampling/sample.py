"""What a sample is: sums over a strain of a flow, kept in blocks, and the averages with errors that
follow from them; see ``sampler`` for how it is taken.
"""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any, TypeVar

import jax
import numpy as np
from jaxtyping import Array, Float, Int

from jaxgran.dynamics.tally import Tally
from jaxgran.model.checks import InputError, is_traced, require_untraced
from jaxgran.model.display import WithError, rounded
from jaxgran.model.flow import ShearFlow
from jaxgran.model.status import LARGEST_DRIFT, Status, worse
from jaxgran.model.values import Indexable, in_numpy
from jaxgran.sampling.averages import averages
from jaxgran.sampling.correlation_strain import flow_correlation_strain, mass_of_grains
from jaxgran.sampling.observables import OBSERVABLES, Observables
from jaxgran.sampling.timestep import deepest_overlap, stress_error
from jaxgran.statistics import Estimates, correlation_length, merged_blocks, standard_errors

if TYPE_CHECKING:
    import xarray as xr

T = TypeVar("T")
BLOCKS = 32
ERROR_OBSERVABLES = (
    "force_ratio",
    "pressure",
    "shear_stress",
)  # a target for the relative error holds for these

_SHOWN = (
    *("force_ratio", "pressure", "shear_stress", "granular_temperature"),
    *("coordination_number", "macroscopic_friction", "inertial_number"),
)


def _computed_once(compute: Callable[["Sample"], T]) -> T:
    """A property that is computed at its first use, and again where JAX traces the sample, since a
    traced value must not outlive its trace. Arrays that are kept cannot be written to.
    """
    name = f"{compute.__name__}_value"

    def value(sample: "Sample") -> T:
        if is_traced(sample):
            return compute(sample)
        if name not in vars(sample):
            result = compute(sample)
            for leaf in jax.tree.leaves(result):
                if isinstance(leaf, np.ndarray):
                    leaf.flags.writeable = False
            vars(sample)[name] = result
        return vars(sample)[name]

    return property(value)  # type: ignore[return-value]


@dataclass(frozen=True, eq=False, repr=False)
class Sample(Observables, Indexable):
    """A measured strain of one replica; a batch has a leading (replicas,) axis everywhere.

    ======  =========  ====  =================================================
    field   shape      unit  meaning
    ======  =========  ====  =================================================
    tally   (blocks,)  –     sums over the steps of each block of strain
    area    ()         σ²    area of the cell
    mass    ()         m     mass of all grains
    flow    ShearFlow  –     parameters of the flow, in the precision of the sums
    engine  static     –     name of the engine that ran; "" where it is not known
    ======  =========  ====  =================================================

    Every observable is an attribute, such as ``sample.pressure``: the average over all blocks, in
    units of m, σ and the time unit t of the shear rate (1/γ̇ at the default γ̇ = 1). ``averages``
    has all of them by name, and ``errors()`` their standard errors. They are NumPy numbers, and JAX
    arrays only where JAX traces the sample. ``sample[0]`` is the sample of the first replica of a
    batch.
    """

    tally: Tally
    area: Float[Array | np.ndarray, "*replicas"]
    mass: Float[Array | np.ndarray, "*replicas"]
    flow: ShearFlow
    engine: str = field(default="", metadata={"static": True})

    def _shown(self) -> dict[str, Any]:
        single, status = not self._axes, np.asarray(self.status)
        averages, errors = self.averages, self.errors() if single else {}
        counts = Counter(Status(int(code)).name for code in status.flat).most_common()
        names = (name if single else f"{name} ({count})" for name, count in counts)
        return {
            **({} if single else {"replicas": status.size}),
            "grains": self.flow.grains,
            "strain": rounded(self.strain),
            **{name: WithError(averages[name], errors.get(name)) for name in _SHOWN},
            "status": ", ".join(names),
        }

    @property
    def _axes(self) -> tuple[int, ...]:
        return np.shape(self.area)

    @property
    def averages(self) -> Mapping[str, Array | np.ndarray]:
        """All observables over all blocks, by name."""
        return dict(self._averages)

    @property
    def strain(self) -> Float[Array | np.ndarray, "*replicas"]:
        """The sampled strain, in whole time steps."""
        return self._total.duration * in_numpy(self.flow.shear_rate)

    @property
    def correlation_strain(self) -> Float[Array | np.ndarray, "*replicas"]:
        """The strain of one independent sample, see ``flow_correlation_strain``."""
        return _correlation_strain(self, self.averages)

    @property
    def timestep_error(self) -> Float[Array | np.ndarray, "*replicas"]:
        """Bound on the relative error of pressure and shear stress from the time step, that of the
        intervals of a map, see ``stress_error``.
        """
        flow, mass, area = in_numpy((self.flow, self.mass, self.area))
        of_unit_diameter = mass / mass_of_grains(flow.packing_fraction, area)
        temperature = self.averages["granular_temperature"] / of_unit_diameter
        return stress_error(flow.timestep * temperature**0.5, flow.packing_fraction, flow.grains)

    @property
    def status(self) -> Int[Array | np.ndarray, "*replicas"]:
        """The worst status: ``short_sample`` below four correlation strains, ``not_steady`` if the
        total momentum has become a part of the averages, ``deep_overlap`` if contacts overlap by
        more than ``deepest_overlap`` on average.
        """
        total, flow = self._total, in_numpy(self.flow)
        deep = total.overlap > deepest_overlap(flow.packing_fraction, flow.grains) * total.contacts
        status = worse(total.status, deep, Status.deep_overlap)
        return worse(status, total.momentum_drift > LARGEST_DRIFT, Status.not_steady)

    @property
    def observed_sums(self) -> Any:
        """Sums over the steps of each block of what ``observe`` returns, a pytree; None without
        ``observe``.
        """
        return self.tally.observed

    def errors(self) -> dict[str, np.ndarray]:
        """Standard errors of the averages by the names of the observables, see ``standard_errors``;
        those of a batch are of each replica.

        Raises:
          InputError: JAX transforms this function.
        """
        require_untraced("errors()", "take it of the finished sample", self)
        return dict(self._errors)

    @_computed_once
    def _total(self) -> Tally:
        return in_numpy(self.tally).total(axis=np.ndim(self.area))

    @_computed_once
    def _averages(self) -> Mapping[str, Array | np.ndarray]:
        return averages(self._total, self.area, self.flow.grains, self.flow.shear_rate)

    @_computed_once
    def _errors(self) -> dict[str, np.ndarray]:
        sample = in_numpy(self)
        if not self._axes:
            return estimates([sample])[1]
        of_replicas = [replica.errors() for replica in sample]
        return {name: np.stack([errors[name] for errors in of_replicas]) for name in of_replicas[0]}

    def to_dataset(self) -> "xr.Dataset":
        """The averages as an ``xarray.Dataset``, named as in a map: NAME, NAME_stderr, the strain,
        the status and the parameters of the flow. Its attributes say what ran.

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
    sums = jax.tree.map(lambda *x: np.stack(list(map(np.asarray, x))), *parts)
    total = jax.tree.map(lambda x: x.sum(axis=(0, 1)), sums)
    structure = jax.tree.structure(jax.eval_shape(estimate_of_sums, *total))
    values, errors = standard_errors(leaves_by_number, sums, *lengths(seeds))
    return structure.unflatten(values.values()), structure.unflatten(errors.values())


def estimates(seeds: Sequence[Sample]) -> tuple[Estimates, Estimates]:
    """Averages over all blocks of several replicas of one flow, and their ``standard_errors``.

    For an extreme, such as the largest overlap, the value is the largest of all blocks. Its error
    is the standard deviation over the blocks. Averages that differ from their value without
    clusters only where grains collide in clusters have at least the error of ``_unseen``.
    """
    average, sums = _stacked(seeds)
    values, errors = standard_errors(average, sums, *lengths(seeds))
    for name, error in _unseen(values, np.sum(sums.collisions)).items():
        errors[name] = np.hypot(errors[name], error)
    by_block = average(sums)
    extremes = {name: by_block[name] for name, row in OBSERVABLES.items() if row.extreme}
    largest = {name: np.asarray(x.max()) for name, x in extremes.items()}
    spread = {name: np.asarray(x.std() if x.size > 1 else np.nan) for name, x in extremes.items()}
    return values | largest, errors | spread


def _unseen(values: Estimates, collisions: np.ndarray) -> Estimates:
    """Standard errors of the averages that only clusters change, from clusters that a sample may
    have missed.

    Of n collisions without any in a cluster, up to 3/n may be in clusters with a probability of 5 %
    (the rule of three), which is 1.96 standard errors. A cluster adds about the impulse of another
    mean collision, and has two contacts.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        missed = 3 / 1.96 / np.asarray(collisions)
        pressure = np.trace(values["binary_stress"]) / 2
        by_component = missed * pressure / np.abs(values["binary_stress"])
    return {
        "force_ratio": missed,
        "stress_ratio": by_component,
        "cluster_pressure_share": 2 * missed,
        "cluster_shear_share": 2 * by_component[0, 1],
    }


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
    durations, _ = lengths(seeds)
    in_blocks = correlation_length(average, sums, durations)
    count = merged_blocks(durations, *sums.duration.shape).sum()
    block = np.sum(sums.duration) / count * np.asarray(seeds[0].flow.shear_rate)
    return {
        name: length * block for name, length in in_blocks.items() if not OBSERVABLES[name].extreme
    }


def lengths(seeds: Sequence[Sample]) -> tuple[np.ndarray, float]:
    """The sampled time of each replica, (seeds,), and the correlation strain of the flow in this
    unit.
    """
    average, sums = _stacked(seeds)
    strain = _correlation_strain(seeds[0], average(sums.total(axis=(0, 1))))
    return np.sum(sums.duration, axis=1), float(strain / np.asarray(seeds[0].flow.shear_rate))


def _correlation_strain(sample: Sample, averages: Mapping[str, Any]) -> Any:
    """``flow_correlation_strain`` at some averages of the flow of a sample."""
    flow, mass, area = in_numpy((sample.flow, sample.mass, sample.area))
    return flow_correlation_strain(averages, flow.grains, mass, area, flow.shear_rate)


def _stacked(seeds: Sequence[Sample]) -> tuple[Callable[[Tally], dict[str, Array]], Tally]:
    """The averages as a function of sums, and the sums (seeds, blocks, ...) of the replicas of one
    flow.
    """
    first = seeds[0]
    sums = jax.tree.map(
        lambda *x: np.stack(list(map(np.asarray, x))), *(seed.tally for seed in seeds)
    )
    return partial(
        averages, area=first.area, grains=first.flow.grains, shear_rate=first.flow.shear_rate
    ), sums
