"""Sample: what is measured of a flow over a strain, in blocks, so that every average has an error."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer
from jaxtyping import Array, Float, Int

from jaxgran.display import OF_SAMPLE
from jaxgran.dynamics import State, advance, require_state
from jaxgran.flow import InputError, ShearFlow, require_strain, require_whole, two_digits
from jaxgran.observables import EXTREME_OBSERVABLES, averages
from jaxgran.statistics import Estimates, correlation_length, jackknife
from jaxgran.tally import Tally

BLOCKS, MOST_BLOCKS = 32, 10**6
ERROR_OBSERVABLES = ("force_ratio", "pressure", "shear_stress")  # those that a relative error is asked for
_ROUNDING_STEPS = 20  # a grain at shear velocity must move by that many roundings of a position in one step


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Sample:
    """A measured strain of one replica; a batch has a leading (replicas,) axis everywhere.

    ==========  =========  ====  ============================================
    field       shape      unit  meaning
    ==========  =========  ====  ============================================
    tally       (blocks,)  –     sums over the steps of each block of strain
    area        ()         σ²    area of the cell
    shear_rate  ()         1/t   γ̇
    grains      static     –     number of grains
    ==========  =========  ====  ============================================

    The properties are averages over all blocks, in units of m, σ and the time unit t of the shear rate (1/γ̇ at the
    default γ̇ = 1); ``averages`` holds all of them by the names of ``observables.OBSERVABLES``.
    """

    tally: Tally
    area: Float[Array | np.ndarray, "*replicas"]
    shear_rate: Float[Array | np.ndarray, "*replicas"]
    grains: int = field(metadata={"static": True})

    __repr__, _repr_html_ = OF_SAMPLE

    @property
    def averages(self) -> dict[str, Array]:
        """All observables, averaged over the blocks."""
        return averages(self._total, self.area, self.grains, self.shear_rate)

    @property
    def force_ratio(self) -> Float[Array, "*replicas"]:
        """⟨F⟩/⟨F_bc⟩, the mean contact force over the mean force of binary collisions."""
        return self.averages["force_ratio"]

    @property
    def pressure(self) -> Float[Array, "*replicas"]:
        """Pressure, contact and kinetic, in m/t²."""
        return self.averages["pressure"]

    @property
    def shear_stress(self) -> Float[Array, "*replicas"]:
        """Shear stress −Σ^{xy}, contact and kinetic, in m/t²."""
        return self.averages["shear_stress"]

    @property
    def granular_temperature(self) -> Float[Array, "*replicas"]:
        """Granular temperature Σ m c²/(2N), in mσ²/t²."""
        return self.averages["granular_temperature"]

    @property
    def contact_stress(self) -> Float[Array, "*replicas 2 2"]:
        """Stress tensor of the contact forces, in m/t²."""
        return self.averages["contact_stress"]

    @property
    def binary_stress(self) -> Float[Array, "*replicas 2 2"]:
        """Stress tensor of the contact forces if all collisions were binary, in m/t²."""
        return self.averages["binary_stress"]

    @property
    def kinetic_stress(self) -> Float[Array, "*replicas 2 2"]:
        """Stress tensor of the peculiar motion, in m/t²."""
        return self.averages["kinetic_stress"]

    @property
    def stress_ratio(self) -> Float[Array, "*replicas 2 2"]:
        """Contact stress over binary stress, by component."""
        return self.averages["stress_ratio"]

    @property
    def status(self) -> Int[Array, "*replicas"]:
        """The worst status of the blocks."""
        return jnp.max(self.tally.status, axis=-1)

    @property
    def _total(self) -> Tally:
        return self.tally.total(axis=jnp.ndim(self.area))

    def errors(self) -> dict[str, np.ndarray]:
        """Standard errors of the averages of one replica, by the names of the observables (see ``jackknife``)."""
        if jnp.ndim(self.area):
            raise InputError("errors are those of one replica, and this sample holds a batch: index it first.")
        return estimates([self])[1]


def estimates(seeds: Sequence[Sample]) -> tuple[Estimates, Estimates]:
    """Averages over all blocks of some replicas of one flow, and their standard errors by the jackknife.

    Extremes are no averages: the entry of each is the largest of all blocks, and its error their standard deviation.
    """
    average, sums = _stacked(seeds)
    values, errors = jackknife(average, sums)
    extremes = {name: getattr(sums, field) for name, field in EXTREME_OBSERVABLES.items()}
    largest = {name: np.asarray(x.max()) for name, x in extremes.items()}
    spread = {name: np.asarray(x.std()) for name, x in extremes.items()}
    return values | largest, errors | spread


def relative_error(measured: Sample) -> float:
    """The largest relative standard error among ``ERROR_OBSERVABLES`` of one replica; infinite where one is unknown."""
    values, errors = estimates([measured])
    with np.errstate(invalid="ignore", divide="ignore"):
        worst = max(np.nan_to_num(errors[x] / abs(values[x]), nan=np.inf) for x in ERROR_OBSERVABLES)
    return float(worst)


def correlation_strains(seeds: Sequence[Sample]) -> Estimates:
    """Strain that counts as one independent sample, for every average over some replicas of one flow that are alike.

    The sampled strain of all replicas over this one is the effective sample size. A correlation shorter than a block
    cannot be seen: the strain of a block is returned for it.
    """
    average, sums = _stacked(seeds)
    lengths = correlation_length(average, sums)
    block = np.mean(sums.duration) * np.asarray(seeds[0].shear_rate)
    return {name: length * block for name, length in lengths.items() if name not in EXTREME_OBSERVABLES}


def _stacked(seeds: Sequence[Sample]) -> tuple[Callable[[Tally], dict[str, Array]], Tally]:
    """The averages as a function of sums, and the sums (seeds, blocks, ...) of some replicas of one flow."""
    first = seeds[0]
    sums = jax.tree.map(lambda *x: np.stack([np.asarray(one) for one in x]), *(seed.tally for seed in seeds))
    return partial(averages, area=first.area, grains=first.grains, shear_rate=first.shear_rate), sums


def sample(flow: ShearFlow, state: State, strain: float | Array, blocks: int = BLOCKS) -> tuple[State, Sample]:
    """Shear a flow and measure it; ``jit``, ``vmap`` and ``lax.map`` apply.

    Args:
      flow: parameters, those of the state.
      state: the flow at the beginning, best from ``prepare``.
      strain: strain γ̇t to sample, rounded to whole time steps. A change of it compiles nothing anew.
      blocks: number of equal parts that the tallies are kept for, static.

    Returns:
      The state at the end and the sample.

    Raises:
      ValueError: the strain is not a positive number, shorter than a time step for each block or longer than 2**31 - 1
        of them, or positions in float32 cannot resolve the time step.
    """
    require_state(flow, state)
    require_whole("blocks", blocks, 1, MOST_BLOCKS, "as a tally is kept for each")
    require_strain(flow, strain, blocks)
    check_precision(flow, state)
    return _sample(flow, state, strain, blocks)


@partial(jax.jit, static_argnames="blocks")
def _sample(flow: ShearFlow, state: State, strain: Array, blocks: int) -> tuple[State, Sample]:
    steps = jnp.round(strain / (flow.shear_rate * flow.timestep))
    edges = jnp.round(steps * jnp.arange(blocks + 1, dtype=steps.dtype) / blocks)
    state, tally = lax.scan(lambda now, n: advance(flow, now, n), state, jnp.diff(edges).astype(jnp.int32))
    return state, Sample(tally, state.side**2, jnp.asarray(flow.shear_rate, state.side.dtype), flow.grains)


def check_precision(flow: ShearFlow, state: State) -> None:
    """Raise a ValueError where the positions are too coarse for the time step; nothing while values are traced.

    In one step a grain at the velocity γ̇σ moves by γ̇ dt σ. In float32 a position in a cell of 20 σ is rounded to
    2e-6 σ. Motion is added to displacements since the last build of the lists, which are far smaller, so a flow goes
    wrong only where a step moves a pair by less than a rounding of its separation, 1e-7 σ; but the times that are
    summed up drift by 1e-3, and every program that reads the positions of two states sees their rounding. So the limit
    is that of the positions.
    """
    if any(isinstance(x, Tracer) for x in (flow.timestep, flow.shear_rate, state.side)):
        return
    rounding = np.finfo(state.positions.dtype).eps * float(np.max(state.side))
    least = _ROUNDING_STEPS * rounding
    if float(np.min(np.asarray(flow.timestep) * np.asarray(flow.shear_rate))) < least:
        raise InputError(
            f"timestep must be at least {two_digits(least, up=True)} / shear_rate for positions in "
            f"{state.positions.dtype}: "
            'use a longer one, or float64 (jax.config.update("jax_enable_x64", True)).'
        )
