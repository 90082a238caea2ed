"""State: a sheared packing at one instant, the check of a state, and its energy and momentum."""

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any, Self

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from jaxgran.model.checks import InputError, concrete_or_none, is_traced, require_native, two_digits
from jaxgran.model.display import rounded
from jaxgran.model.flow import RANGES, ShearFlow, require_flow
from jaxgran.model.grains import Grains
from jaxgran.model.status import Status
from jaxgran.model.values import Indexable, in_numpy

_ROUNDING = 1e-5  # of a packing fraction in float32, with some room
_POSITIVE = ("radii", "masses", "side")
_SMALLEST_MOTION = 20  # of a grain at velocity γ̇σ in one step, in roundings of a position
ENABLE_X64 = 'jax.config.update("jax_enable_x64", True)'


@dataclass(frozen=True, eq=False, repr=False)
class State(Indexable):
    """A sheared packing at one instant.

    ==========  ===========  ====  =====================================================
    field       shape        unit  meaning
    ==========  ===========  ====  =====================================================
    grains      Grains       –     radii and masses
    positions   (grains, 2)  σ     centres, wrapped into the cell
    velocities  (grains, 2)  σ/t   peculiar velocities c; in the laboratory frame c + γ̇ y x̂
    side        ()           σ     side ℓ of the cell
    tilt        ()           –     offset of the image row above, in ℓ, in [−½, ½)
    ==========  ===========  ====  =====================================================
    """

    grains: Grains
    positions: Float[Array, "grains 2"]
    velocities: Float[Array, "grains 2"]
    side: Float[Array, ""]
    tilt: Float[Array, ""]

    def _shown(self) -> dict[str, Any]:
        *replicas, grains, _ = np.shape(self.velocities)
        return {
            **({"replicas": math.prod(replicas)} if replicas else {}),
            "grains": grains,
            "packing_fraction": rounded(self.packing_fraction),
            "granular_temperature": rounded(self.granular_temperature),
            "side": rounded(self.side),
            "tilt": rounded(self.tilt),
            "precision": str(self.velocities.dtype),
        }

    def without_momentum(self) -> Self:
        """The same state seen from its centre of mass, as ``sample`` requires it; also of a batch.

        Examples:
          >>> grains = Grains(radii=np.array([0.5, 0.5]), masses=np.array([1.0, 3.0]))
          >>> velocities = np.array([[4.0, 0.0], [0.0, 0.0]])
          >>> state = State(grains, np.array([[0.0, 0.0], [2.0, 2.0]]), velocities, 4.0, 0.0)
          >>> state.without_momentum().velocities.tolist()
          [[3.0, 0.0], [-1.0, 0.0]]
        """
        masses = self.grains.masses[..., None]
        momentum = (masses * self.velocities).sum(axis=-2, keepdims=True)
        mean = momentum / masses.sum(axis=-2, keepdims=True)
        return replace(self, velocities=self.velocities - mean)

    @property
    def packing_fraction(self) -> Float[Array | np.ndarray, ""]:
        """Area of the grains over that of the cell, ν."""
        radii, side = in_numpy((self.grains.radii, self.side))  # other parts may be traced
        return (np.pi * radii**2).sum(axis=-1) / side**2

    @property
    def granular_temperature(self) -> Float[Array | np.ndarray, ""]:
        """Σ m c² / 2N, in mσ²/t²."""
        state = in_numpy(self)
        squares = (state.velocities**2).sum(axis=-1)
        return (state.grains.masses * squares).sum(axis=-1) / (2 * squares.shape[-1])

    @property
    def _axes(self) -> tuple[int, ...]:
        return np.shape(self.side)

    def __getitem__(self, place: Any) -> Self:
        axes, grains = self._axes, self.grains
        if axes and np.ndim(grains.radii) == 1:  # the replicas share them
            grains = jax.tree.map(lambda x: jnp.broadcast_to(x, (*axes, *x.shape)), grains)
        return super(State, replace(self, grains=grains)).__getitem__(place)


def require_state(flow: ShearFlow, state: State) -> None:
    """Raise an InputError unless these are one flow and one state of it: a state of its shapes, in
    one precision, finite, with positive sizes and masses, of the packing fraction of the flow, and
    without a pair of grains nearer than half of their contact distance.

    The engines take the packing fraction and the grains from the state. Of traced numbers only
    shapes and precision are checked.
    """
    require_flow(flow)
    if not isinstance(state, State):
        raise InputError(
            f"state must be one State of {flow.grains} grains, best from prepare, not "
            f"{type(state).__name__}."
        )
    arrays = _arrays_of(state)
    _require_arrays(flow.grains, arrays)
    known = {name: concrete_or_none(x) for name, x in arrays.items()}
    for name, numbers in known.items():
        if numbers is not None and not np.all(_accepts(name, numbers, np)):
            words = "positive and finite" if name in _POSITIVE else "finite"
            raise InputError(f"state must have only {words} {name}, best from prepare.")
    radii, positions, side, tilt = (known[x] for x in ("radii", "positions", "side", "tilt"))
    if radii is None or side is None:
        return
    nu = concrete_or_none(flow.packing_fraction)
    if nu is not None and not _has_fraction_of(flow, state):
        raise InputError(
            f"packing_fraction must be {float(state.packing_fraction):.6g}, which the state has, "
            f"not {nu:g}: a flow with another one begins with a state of its own, from prepare."
        )
    if positions is not None and tilt is not None:
        _require_apart(radii, positions, float(side), float(tilt))


def status_at_start(flow: ShearFlow, state: State) -> Int[Array, ""]:
    """``Status.nonfinite`` unless an engine can advance a state: it has passed ``require_state``,
    the numbers of the flow are finite, and in the ranges of ``ShearFlow``.

    Traced values are known in compiled code only.
    """
    arrays = {name: jnp.asarray(x) for name, x in _arrays_of(state).items()}
    return _nonfinite_unless(
        jnp.all(x)
        for x in (
            *(_accepts(name, x, jnp) for name, x in arrays.items()),
            *map(jnp.isfinite, jax.tree.leaves(flow)),
            jnp.asarray(flow.timestep) > 0,
            jnp.asarray(flow.shear_rate) >= 0,
            *(RANGES[x][0](jnp.asarray(getattr(flow, x))) for x in ("restitution", "activation")),
            _has_fraction_of(flow, state),
        )
    )


def _arrays_of(state: State) -> dict[str, Any]:
    arrays = {**vars(state.grains), **vars(state)}
    del arrays["grains"]
    return arrays


def _accepts(name: str, numbers: Any, xp: Any) -> Any:
    """Which numbers of an array of a state are accepted, by NumPy or ``jax.numpy``."""
    finite = xp.isfinite(numbers)
    return finite & (numbers > 0) if name in _POSITIVE else finite


def _has_fraction_of(flow: ShearFlow, state: State) -> Any:
    return abs(state.packing_fraction - flow.packing_fraction) <= _ROUNDING


def _require_arrays(grains: int, arrays: dict[str, Any]) -> None:
    """Raise an InputError unless the arrays have the shapes of a state, and one precision."""
    vectors, numbers = ("positions", "velocities"), ("side", "tilt")
    for name, x in arrays.items():
        shape = (grains, 2) if name in vectors else () if name in numbers else (grains,)
        if not hasattr(x, "dtype") and not isinstance(x, (int, float)):
            raise InputError(
                f"state must have arrays, and its {name} has the type {type(x).__name__}: "
                "jnp.asarray makes an array of a list."
            )
        if np.shape(x) != shape:
            raise InputError(
                f"state must be one State of {grains} grains, best from prepare, of {name} "
                f"{shape}, not {np.shape(x)}."
            )
    precisions = sorted({np.dtype(x.dtype).name for x in arrays.values() if hasattr(x, "dtype")})
    if len(precisions) > 1 or not {*precisions} <= {"float32", "float64"}:
        raise InputError(
            f"state must be of one precision, and its numbers are {' and '.join(precisions)}: "
            "jax.tree.map(lambda x: x.astype(float), state) makes them one."
        )
    require_native("state", arrays)
    if precisions == ["float64"] and jnp.result_type(float) != np.float64:
        raise InputError(
            "state must be of the precision in which JAX computes, float32, not float64: begin "
            f"with {ENABLE_X64}."
        )


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
    slowest = np.finfo(state.positions.dtype).smallest_normal ** (1 / 3)
    if (slow := float(np.min(np.asarray(flow.shear_rate, float)))) < slowest:
        raise InputError(
            f"shear_rate must be at least {two_digits(slowest, up=True)} in "
            f"{state.positions.dtype}, not {slow:g}: its cube would underflow."
        )
    least = _SMALLEST_MOTION * rounding
    if float(np.min(np.asarray(flow.timestep) * np.asarray(flow.shear_rate))) < least:
        raise InputError(
            f"timestep must be at least {two_digits(least, up=True)} / shear_rate for positions in "
            f"{state.positions.dtype}: use a longer one, or float64 "
            f"({ENABLE_X64})."
        )


def _require_apart(radii: np.ndarray, positions: np.ndarray, side: float, tilt: float) -> None:
    """Raise an InputError if two grains are nearer than half of their contact distance, which no
    time step leaves.
    """
    from scipy.spatial import KDTree

    rows = np.floor(positions[:, 1] / side)
    x, y = positions[:, 0] - rows * tilt * side, positions[:, 1] - rows * side
    x = x - side * np.floor(x / side)
    reach = float(np.max(radii))  # half of the largest contact distance
    row, column = (k.reshape(-1, 1) for k in np.mgrid[-1:2, -1:2])
    images = np.stack([x + (column + row * (tilt - np.rint(tilt))) * side, y + row * side], axis=-1)
    images = images.reshape(-1, 2)
    near = np.flatnonzero(np.all((images >= -reach) & (images < side + reach), axis=-1))
    i, j = near[KDTree(images[near]).query_pairs(reach, output_type="ndarray")].T
    distances = np.linalg.norm(images[i] - images[j], axis=-1)
    i, j = i % len(radii), j % len(radii)
    too_near = (distances < (radii[i] + radii[j]) / 2) & (i != j)
    if np.any(too_near):
        k = np.flatnonzero(too_near)[0]
        raise InputError(
            "state must have grains that are further apart than half of their contact distance, "
            f"and the centres of grains {i[k]} and {j[k]} are {distances[k]:.3g} diameters apart."
        )


def kinetic_energy(grains: Grains, velocities: Array) -> Float[Array, ""]:
    """Kinetic energy of the peculiar motion, Σ m c²/2."""
    return jnp.sum(grains.masses * jnp.sum(velocities**2, axis=-1)) / 2


def relative_momentum(grains: Grains, velocities: Array) -> Float[Array, ""]:
    """Total momentum over the sum of the momenta of the grains, |Σ m c| / Σ m |c|; zero at rest."""
    momenta = grains.masses[:, None] * velocities
    momenta = lax.stop_gradient(momenta)  # rounding, and a norm has no derivative at rest
    scale = jnp.sum(jnp.linalg.norm(momenta, axis=-1))
    return jnp.linalg.norm(jnp.sum(momenta, axis=0)) / jnp.where(scale > 0, scale, 1)


def status_if_finite(*values: Array) -> Int[Array, ""]:
    """``Status.ok`` if all numbers are finite, or else ``Status.nonfinite``."""
    return _nonfinite_unless(jnp.all(jnp.isfinite(x)) for x in values)


def _nonfinite_unless(conditions: Iterable[Array]) -> Int[Array, ""]:
    """``Status.ok`` if all conditions hold, or else ``Status.nonfinite``."""
    holds = jnp.all(jnp.stack([*conditions]))
    return jnp.where(holds, Status.ok, Status.nonfinite).astype(jnp.int32)
