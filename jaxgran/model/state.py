"""State: a sheared packing at one instant, the check of a state, and its energy and momentum."""

import math
from dataclasses import dataclass, replace
from typing import Any, Self

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from jaxgran.model.batches import Indexable, equal_values, in_numpy
from jaxgran.model.checks import InputError, is_traced, require_native
from jaxgran.model.display import are_numbers, rounded, text_of
from jaxgran.model.flow import ShearFlow, require_flow
from jaxgran.model.grains import Grains
from jaxgran.model.status import Status

_ROUNDING = 1e-5  # of a packing fraction or a diameter in float32, with some room


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
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

    __eq__ = equal_values

    def __repr__(self) -> str:
        cell = {"side": self.side, "tilt": self.tilt}
        numbers = self.grains.radii, self.grains.masses, self.velocities, *cell.values()
        if not are_numbers(*numbers) or np.ndim(self.velocities) < 2:
            return text_of("State", {"positions": self.positions, **cell})
        *replicas, grains, _ = np.shape(self.velocities)
        values = {
            "packing_fraction": self.packing_fraction,
            "granular_temperature": self.granular_temperature,
            **cell,
        }
        return text_of(
            "State",
            {
                **({"replicas": math.prod(replicas)} if replicas else {}),
                "grains": grains,
                **{name: rounded(value) for name, value in values.items()},
                "precision": str(self.velocities.dtype),
            },
        )

    @property
    def packing_fraction(self) -> Float[Array | np.ndarray, ""]:
        """Area of the grains over that of the cell, ν."""
        state = in_numpy(self)
        return (np.pi * state.grains.radii**2).sum(axis=-1) / state.side**2

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
    """Raise an InputError unless these are one flow and one state with its number of grains, in one
    precision.
    """
    require_flow(flow)
    if not isinstance(state, State) or jnp.shape(state.positions) != (flow.grains, 2):
        given = type(state).__name__
        if isinstance(state, State):
            given = f"of positions {jnp.shape(state.positions)}"
        raise InputError(
            f"state must be one State of {flow.grains} grains, best from prepare, not {given}."
        )
    precisions = sorted(
        {leaf.dtype.name for leaf in jax.tree.leaves(state) if hasattr(leaf, "dtype")}
    )
    if len(precisions) > 1:
        raise InputError(
            f"state must be of one precision, and its numbers are {' and '.join(precisions)}: "
            "jax.tree.map(lambda x: x.astype(float), state) makes them one."
        )
    require_native("state", state)


def require_match(flow: ShearFlow, state: State) -> None:
    """Raise an InputError if flow and state differ in packing fraction or polydispersity; traced
    values pass.

    The engines take both from the state. Sizes other than those of ``polydisperse`` belong to no
    polydispersity.
    """
    if is_traced(flow, state):
        return
    radii = np.sort(np.asarray(state.grains.radii, float))
    of_state = {
        "packing_fraction": float(np.pi * np.sum(radii**2) / np.asarray(state.side, float) ** 2)
    }
    quantiles = (2 * np.arange(radii.size) + 1) / radii.size - 1
    spread = (2 * radii[-1] - 1) / quantiles[-1]
    if spread > _ROUNDING and np.allclose(
        2 * radii, 1 + spread * quantiles, rtol=0, atol=_ROUNDING
    ):
        of_state["polydispersity"] = float(spread)
    for name, value in of_state.items():
        if abs(value - float(getattr(flow, name))) > _ROUNDING:
            raise InputError(
                f"{name} must be {value:.6g}, which the state has, not "
                f"{float(getattr(flow, name)):g}: a flow with "
                "another one begins with a state of its own, from prepare."
            )


def kinetic_energy(grains: Grains, velocities: Array) -> Float[Array, ""]:
    """Kinetic energy of the peculiar motion, Σ m c²/2."""
    return jnp.sum(grains.masses * jnp.sum(velocities**2, axis=-1)) / 2


def relative_momentum(grains: Grains, velocities: Array) -> Float[Array, ""]:
    """Total momentum over the sum of the momenta of the grains, |Σ m c| / Σ m |c|; zero at rest."""
    momenta = grains.masses[:, None] * velocities
    momenta = lax.stop_gradient(
        momenta
    )  # it measures rounding, and a norm has no derivative at rest
    scale = jnp.sum(jnp.linalg.norm(momenta, axis=-1))
    return jnp.linalg.norm(jnp.sum(momenta, axis=0)) / jnp.where(scale > 0, scale, 1)


def status_if_finite(*values: Array) -> Int[Array, ""]:
    """``Status.ok`` if all numbers are finite, or else ``Status.nonfinite``; the values have one
    shape.
    """
    finite = jnp.all(jnp.isfinite(jnp.stack(values)))
    return jnp.where(finite, Status.ok, Status.nonfinite).astype(jnp.int32)
