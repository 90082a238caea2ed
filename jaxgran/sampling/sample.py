"""Sample: what is measured of a flow over a strain, in blocks, so that every average has an error."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer
from jaxtyping import Array, Float, Int

from jaxgran.contact.network import Contacts
from jaxgran.dynamics.advance import advance
from jaxgran.dynamics.engine import select_engine
from jaxgran.dynamics.plain import advance_observed
from jaxgran.dynamics.snapshots import Snapshot, snapshot_of
from jaxgran.dynamics.tally import Tally
from jaxgran.model.checks import InputError, require_whole, shown, two_digits
from jaxgran.model.display import Row, arrays, display_methods, rounded, statuses
from jaxgran.model.flow import ShearFlow, require_strain
from jaxgran.model.state import State, require_state
from jaxgran.model.status import Status
from jaxgran.sampling.observables import EXTREME_OBSERVABLES, averages
from jaxgran.statistics import Estimates, correlation_length, jackknife

BLOCKS, MOST_BLOCKS = 32, 10**6
ERROR_OBSERVABLES = ("force_ratio", "pressure", "shear_stress")  # those that a relative error is asked for
_ROUNDING_STEPS = 20  # a grain at shear velocity must move by that many roundings of a position in one step


_SHOWN = {
    "force_ratio": "",
    "pressure": "m/t²",
    "shear_stress": "m/t²",
    "granular_temperature": "mσ²/t²",
    "coordination_number": "",
    "macroscopic_friction": "",
    "inertial_number": "",
}


def _rows(sample: "Sample") -> list[Row]:
    known = arrays(*vars(sample.tally).values(), sample.area, sample.shear_rate)
    if not known or np.ndim(sample.tally.contact_moment) < 3:
        return [Row("grains", sample.grains), Row("area", sample.area, "σ²")]
    here = jax.tree.map(np.asarray, sample)
    averages, one = here.averages, here.area.ndim == 0
    errors = here.errors() if one else {}
    sums = here._total
    return [
        *[Row("replicas", count) for count in here.area.shape],
        Row("grains", here.grains),
        Row("strain", rounded(sums.duration * here.shear_rate)),
        *(Row(name, averages[name], unit, errors.get(name)) for name, unit in _SHOWN.items()),
        Row("status", statuses(here.status)),
    ]


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
    own         (blocks,)  –     sums over the steps of what ``observe`` found
                                 in each, a pytree; None without it
    ==========  =========  ====  ============================================

    The properties are averages over all blocks, in units of m, σ and the time unit t of the shear rate (1/γ̇ at the
    default γ̇ = 1); ``averages`` holds all of them by the names of ``observables.OBSERVABLES``.
    """

    tally: Tally
    area: Float[Array | np.ndarray, "*replicas"]
    shear_rate: Float[Array | np.ndarray, "*replicas"]
    grains: int = field(metadata={"static": True})
    own: Any = None

    __repr__, _repr_html_ = display_methods("Sample", _rows)

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

    def observed(self, estimate: Callable[[Any], Any] = lambda means: means) -> tuple[Any, Any]:
        """Means over all time steps of what was observed in one replica, and their standard errors (see ``jackknife``).

        Args:
          estimate: what to make of the means, a function of arrays: a ratio of two of them, say. The errors are those
            of its result.

        Returns:
          Two pytrees of arrays, as the estimate returns them.
        """
        if self.own is None or jnp.ndim(self.area):
            raise InputError(
                "what was observed is that of one replica, sampled with observe and indexed if in a batch."
            )

        def one(sums: Any, steps: Array) -> Any:
            return estimate(jax.tree.map(lambda x: x / steps, sums))

        def named(part: tuple[Any, Array]) -> dict[str, Array]:
            found = jax.tree.leaves(jax.vmap(one)(*part))
            return {str(k): leaf for k, leaf in enumerate(found)}

        sums = jax.tree.map(lambda x: np.asarray(x)[None], (self.own, self.tally.steps))
        total = jax.tree.map(lambda x: x.sum(axis=(0, 1)), sums)
        structure = jax.tree.structure(jax.eval_shape(one, *total))
        values, errors = jackknife(named, sums)
        return structure.unflatten(values.values()), structure.unflatten(errors.values())


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


def sample(
    flow: ShearFlow,
    state: State,
    strain: float | Array,
    blocks: int = BLOCKS,
    observe: Callable[[Snapshot], Any] | None = None,
    callback: Callable[[State, Sample], Any] | None = None,
) -> tuple[State, Sample]:
    """Shear a flow and measure it; ``jit``, ``vmap`` and ``lax.map`` apply.

    What ``observe`` returns is averaged over **every** time step, in the same pass (see ``observer``), since what
    contacts do cannot be had from a few instants: at a short time step most instants of a collisional flow have no
    contact that pushes. A function of the forces, which are ``impulses / timestep``, is averaged exactly. Positions and
    velocities are seen once a flight, so they are averaged up to the strain of a flight, about 1e-3. The means of two
    kinds of grains' temperature and of the contacts' fabric, as an example:

        def observe(seen):
            kinetic = seen.state.grains.masses * jnp.sum(seen.state.velocities**2, axis=1) / 2
            small, n = seen.state.grains.radii < 0.5, seen.contacts.normals
            pushes = (seen.impulses > 0).astype(n.dtype)
            return {
                "small": jnp.sum(jnp.where(small, kinetic, 0)) / jnp.sum(small),
                "large": jnp.sum(jnp.where(small, 0, kinetic)) / jnp.sum(~small),
                "fabric": jnp.einsum("c,ca,cb->ab", pushes, n, n),
                "contacts": jnp.sum(pushes),
            }

        state, measured = jg.sample(flow, state, 5.0, observe=observe)
        means, errors = measured.observed()
        fabric, error = measured.observed(lambda mean: mean["fabric"] / mean["contacts"])

    Args:
      flow: parameters, those of the state.
      state: the flow at the beginning, best from ``prepare``.
      strain: strain γ̇t to sample, rounded to whole time steps. A change of it compiles nothing anew.
      blocks: number of equal parts that the tallies are kept for, static.
      observe: what else to average, a function of a ``Snapshot`` that returns a pytree of arrays; looked at by the
        engine jax, which on a processor takes 5 to 7 times as long as the machine code; static, so that a new
        function compiles anew. The contacts of a snapshot are those of a step in which some approach, before they act,
        in buffers of several sizes: sum over them. A step without has none, so a mean over steps counts zero for it.
      callback: called after each block with the state and the sample so far; where it returns something true, the
        sample ends there. A block is then compiled instead of all of them, and no transformation applies.

    Returns:
      The state at the end and the sample.

    Raises:
      ValueError: the flow is not sheared, the strain is not a positive number, shorter than a time step for each block
        or longer than 2**31 - 1 of them, positions in float32 cannot resolve the time step, what is observed is no
        sums over the contacts, or the flow names an engine that cannot do what is asked.
    """
    require_state(flow, state)
    require_whole("blocks", blocks, 1, MOST_BLOCKS, "as a tally is kept for each")
    require_strain(flow, strain, blocks)
    check_precision(flow, state)
    for name, function in (("observe", observe), ("callback", callback)):
        if function is not None and not callable(function):
            raise InputError(f"{name} must be a function or None, not {shown(function)}.")
    if callback is None:
        return _sample(flow, state, strain, blocks, observe)
    if any(isinstance(x, Tracer) for x in jax.tree.leaves((flow, state, strain))):
        raise InputError("callback must be None where a sample is transformed, as by jax.jit or jax.vmap.")
    return _told_sample(flow, state, strain, blocks, observe, callback)


@partial(jax.jit, static_argnames=("blocks", "observe"))
def _sample(
    flow: ShearFlow, state: State, strain: Array, blocks: int, observe: Callable[[Snapshot], Any] | None = None
) -> tuple[State, Sample]:
    return _measured(flow, state, _steps_of_blocks(flow, strain, blocks), observe)


def _steps_of_blocks(flow: ShearFlow, strain: float | Array, blocks: int) -> Int[Array, " blocks"]:
    steps = jnp.round(strain / (flow.shear_rate * flow.timestep))
    edges = jnp.round(steps * jnp.arange(blocks + 1, dtype=steps.dtype) / blocks)
    return jnp.diff(edges).astype(jnp.int32)


def _measured(
    flow: ShearFlow, state: State, steps: Int[Array, " blocks"], observe: Callable[[Snapshot], Any] | None
) -> tuple[State, Sample]:
    """The sample of blocks of so many time steps."""
    if observe is not None:
        select_engine(flow, state, "observe")

    def block(now: State, steps: Array) -> tuple[State, tuple[Tally, Any]]:
        if observe is None:
            now, tally = advance(flow, now, steps)
            return now, (tally, None)
        now, tally, own = advance_observed(flow, now, steps, partial(_look, observe, flow))
        return now, (tally, own)

    state, (tally, own) = lax.scan(block, state, steps)
    return state, Sample(tally, state.side**2, jnp.asarray(flow.shear_rate, state.side.dtype), flow.grains, own)


def _look(
    observe: Callable[[Snapshot], Any], flow: ShearFlow, state: State, contacts: Contacts, impulses: Array
) -> Any:
    return observe(snapshot_of(flow, state, contacts, impulses, jnp.int32(Status.ok)))


_one_block = jax.jit(_measured, static_argnames="observe")


def _told_sample(
    flow: ShearFlow, state: State, strain: float | Array, blocks: int, observe: Any, callback: Callable
) -> tuple[State, Sample]:
    """The sample, block by block, each of which a callback is told of."""
    parts: list[Sample] = []
    for steps in np.asarray(_steps_of_blocks(flow, strain, blocks)):
        state, part = _one_block(flow, state, jnp.asarray([steps]), observe)
        parts.append(part)
        if callback(state, _joined(parts)):
            break
    return state, _joined(parts)


def _joined(parts: list[Sample]) -> Sample:
    """One sample of all blocks of some of one flow that follow each other."""
    every = ((part.tally, part.own) for part in parts)
    blocks = jax.tree.map(lambda *x: jnp.asarray(np.concatenate([np.asarray(one) for one in x])), *every)
    return replace(parts[-1], tally=blocks[0], own=blocks[1])


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
