"""Coarse-grained fields of a snapshot: density, velocity, stress, dissipation and heat flux at any
points.

The Gaussian G(r) = exp(−r²/2w²)/2πw² spreads every grain over the plane. Quantities carried by
grains are weighted by G(r − r_i), quantities transferred by contacts by ∫₀¹ G(r − r_i + s σ_ij) ds,
the mean of G over the branch σ_ij = r_i − r_j between the centres. With these weights the fields
obey the balance equations of mass, momentum and energy exactly, at every point:

    ∂ρ/∂t = −∇·(ρV),   ∂(ρV)/∂t = −∇·(ρVV + Σ),   ∂(ρe)/∂t = −∇·(ρeV + Σ·V + J_Q) − ζ,

where Σ is the sum of the kinetic and contact stress, and ρe = ρV²/2 + tr Σ_k/2. A time step is an
instantaneous collision followed by a flight. Quantities carried by grains use the velocities after
the collision; forces are impulses over dt. The fields of a snapshot are those of the step that
begins with it, over which the densities change by dt times the right-hand sides: exactly for
contacts, to first order in dt for flight.

Sources: Lois, Lemaître and Carlson for ρ, ρV and Σ (their energy equation has the opposite signs on
the right); Goldhirsch and Goldenberg, Eur. Phys. J. E 9, 245 (2002), for the line integral.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.scipy.special import erf
from jaxtyping import Array, Float

from jaxgran.dynamics.snapshots import Snapshot, collided
from jaxgran.model.batches import equal_values
from jaxgran.model.cell import displacement
from jaxgran.model.checks import InputError, as_array, concrete_or_none, require, require_number
from jaxgran.model.state import State

_REACH = 6.0  # widths, at which the Gaussian has fallen to e⁻¹⁸ = 1.5e-8 of its peak
_POINTS_AT_ONCE = 8  # to bound the memory


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Fields:
    """Coarse-grained fields at points of the plane, in the laboratory frame (mean velocity γ̇ y
    x̂).

    ==============  ==============  =======  =======================================================
    field           shape           unit     meaning
    ==============  ==============  =======  =======================================================
    density         (points,)       m/σ²     ρ = Σ m G
    number_density  (points,)       1/σ²     Σ G
    velocity        (points, 2)     σ/t      V = Σ m v G / ρ; the mean flow γ̇ y x̂ where ρ = 0
    kinetic_stress  (points, 2, 2)  m/t²     Σ m (v − V)(v − V) G
    contact_stress  (points, 2, 2)  m/t²     Σ σ F ∫G over the contacts; positive for pressure
    heat_flux       (points, 2)     mσ/t³    J_Q = ½ Σ m |v − V|² (v − V) G + Σ σ F·((v̄_i +
                                             v̄_j)/2 − V) ∫G, with v̄ the
                                             mean of the velocities before and after the collision
    dissipation     (points,)       m/t³     ζ: energy lost in contacts, half of each loss at either
                                             grain; negative where a contact gains energy because
                                             its neighbours compress it
    ==============  ==============  =======  =======================================================
    """

    density: Float[Array, " points"]
    number_density: Float[Array, " points"]
    velocity: Float[Array, "points 2"]
    kinetic_stress: Float[Array, "points 2 2"]
    contact_stress: Float[Array, "points 2 2"]
    heat_flux: Float[Array, "points 2"]
    dissipation: Float[Array, " points"]

    __eq__ = equal_values

    @property
    def stress(self) -> Float[Array, "points 2 2"]:
        """Stress Σ, kinetic and contact, in m/t²."""
        return self.kinetic_stress + self.contact_stress

    @property
    def temperature(self) -> Float[Array, " points"]:
        """Granular temperature tr Σ_k / (2 Σ G), in mσ²/t², with Σ_k the kinetic stress; zero where
        no grain is near.
        """
        number = jnp.where(self.number_density > 0, self.number_density, 1)
        return jnp.trace(self.kinetic_stress, axis1=1, axis2=2) / (2 * number)


def fields_at(snapshot: Snapshot, points: Float[Array, "points 2"], width: float | Array) -> Fields:
    """Fields of a snapshot at any points of the plane; supports ``jit``, ``lax.map`` and
    differentiation.

    Args:
      snapshot: one snapshot.
      points: (points, 2) in σ, in the cell or any image of it, for example from ``grid``.
      width: standard deviation w of the Gaussian, in σ. Another width needs no recompilation.

    Returns:
      Fields of the step that begins with the snapshot; ρ, V and Σ_k are those after its collision.

    Raises:
      InputError: the width is not positive, or six widths are more than half the side minus the
        largest radius, so that two images of a grain would be within reach of a point.
    """
    if not isinstance(snapshot, Snapshot) or jnp.ndim(snapshot.state.positions) != 2:
        raise InputError(
            "snapshot must be a single Snapshot; series[-1] is the last one of a series."
        )
    points, accepted = as_array(points), "an array (points, 2) of finite numbers"
    require(
        "points", points, lambda x: x.ndim == 2 and x.shape[1] == 2 and np.isfinite(x), accepted
    )
    widest = _widest(snapshot.state)
    accepted = f"positive and at most {widest:.4g} in this cell"
    require_number("width", width, lambda x: (x > 0) & (x <= widest), accepted)
    return _fields_at(snapshot, points, width)


def grid(side: float | Array, count: int) -> Float[Array, "points 2"]:
    """A regular grid of points (count², 2) in the cell, row by row: ``reshape(count, count)`` gives
    axes (y, x).

    The square [0, L)² is one cell of the sheared lattice at any tilt.
    """
    ticks = (jnp.arange(count, dtype=jnp.result_type(side, float)) + 0.5) * (side / count)
    return jnp.stack([jnp.tile(ticks, count), jnp.repeat(ticks, count)], axis=-1)


def _widest(state: State) -> float:
    """The largest width that fits into the cell; infinite while JAX traces it."""
    side, radii = (concrete_or_none(x) for x in (state.side, state.grains.radii))
    return np.inf if side is None or radii is None else float((side / 2 - radii.max()) / _REACH)


@jax.jit
def _fields_at(snapshot: Snapshot, points: Array, width: Array) -> Fields:
    before, after, contacts = snapshot.state, collided(snapshot), snapshot.contacts
    side, tilt, masses = before.side, before.tilt, before.grains.masses
    shear = jnp.stack([snapshot.shear_rate, jnp.zeros_like(snapshot.shear_rate)])[None]
    loaded = snapshot.impulses > 0
    lengths = jnp.where(loaded, contacts.distances, 1)
    branches = contacts.normals * contacts.distances[:, None]
    middles = before.positions[contacts.j] + branches / 2
    forces = contacts.normals * (snapshot.impulses / snapshot.timestep)[:, None]
    mean = (before.velocities + after.velocities) / 2
    mean_i, mean_j = mean[contacts.i], mean[contacts.j]
    half_loss = -jnp.sum(forces * (mean_i - mean_j + shear * branches[:, 1:]), axis=1) / 2
    losses = jnp.zeros_like(masses).at[contacts.i].add(half_loss).at[contacts.j].add(half_loss)

    def at(point: Array) -> Fields:
        """Velocities u = c − γ̇ d_y x̂ are relative to the mean flow at the point: so images at a
        separation d need no correction, and no digits cancel far from the origin.
        """
        d = displacement(point[None], before.positions, side, tilt)
        weights = jnp.exp(-jnp.sum(d**2, axis=1) / (2 * width**2)) / (2 * jnp.pi * width**2)
        carried, u = masses * weights, after.velocities - shear * d[:, 1:]
        density = jnp.sum(carried)
        u_mean = carried @ u / jnp.where(density > 0, density, 1)
        apart = u - u_mean[None]
        carried_heat = (carried * jnp.sum(apart**2, axis=1)) @ apart / 2

        d = displacement(point[None], middles, side, tilt)
        line = jnp.where(loaded, _over_branches(d, contacts.normals, lengths, width), 0)
        transferred = line[:, None] * branches
        working = (mean_i + mean_j) / 2 - shear * d[:, 1:] - u_mean[None]
        return Fields(
            density=density,
            number_density=jnp.sum(weights),
            velocity=u_mean + shear[0] * point[1],
            kinetic_stress=(carried[:, None] * apart).T @ apart,
            contact_stress=transferred.T @ forces,
            heat_flux=carried_heat + jnp.sum(forces * working, axis=1) @ transferred,
            dissipation=losses @ weights,
        )

    with jax.default_matmul_precision("highest"):
        return lax.map(at, points, batch_size=max(1, min(points.shape[0], _POINTS_AT_ONCE)))


def _over_branches(
    d: Float[Array, "n 2"], normals: Float[Array, "n 2"], lengths: Float[Array, " n"], width: Array
) -> Float[Array, " n"]:
    """∫₀¹ G along branches, from the separations of a point from their middles, in 1/σ²."""
    along = jnp.sum(normals * d, axis=1)
    across = normals[:, 0] * d[:, 1] - normals[:, 1] * d[:, 0]
    start, end = ((along + side * lengths / 2) / (np.sqrt(2.0).item() * width) for side in (-1, 1))
    line = jnp.exp(-((across / width) ** 2) / 2) / (np.sqrt(8 * np.pi).item() * width)
    return line * (erf(end) - erf(start)) / lengths
