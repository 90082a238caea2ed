"""Coarse-grained fields of a snapshot: density, velocity, stress, dissipation and heat flux at any
points.

A coarse-graining function G spreads every grain over the plane. Quantities carried by grains are
weighted by G(r − r_i), quantities transferred by contacts by ∫₀¹ G(r − r_i + s σ_ij) ds, the mean
of G over the branch σ_ij = r_i − r_j between the centres. With these weights the fields obey the
balance equations of mass, momentum and energy exactly, at every point and for every G:

    ∂ρ/∂t = −∇·(ρV),   ∂(ρV)/∂t = −∇·(ρVV + Σ),   ∂(ρe)/∂t = −∇·(ρeV + Σ·V + J_Q) − ζ.

A time step is an instantaneous collision followed by a flight. Quantities carried by grains use the
velocities after the collision; forces are impulses over dt. The fields of a snapshot are those of
the step that begins with it, over which the densities change by dt times the right-hand sides:
exactly for contacts, to first order in dt for flight.

Sources: Lois, Lemaître and Carlson for ρ, ρV and Σ (their energy equation has the opposite signs on
the right); Goldhirsch and Goldenberg, Eur. Phys. J. E 9, 245 (2002), for the line integral.
"""

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer
from jaxtyping import Array, Bool, Float

from jaxgran.analysis.coarse_graining import CoarseGraining
from jaxgran.dynamics.snapshots import Snapshot, collided
from jaxgran.model.batches import equal_values
from jaxgran.model.cell import displacement
from jaxgran.model.checks import InputError, as_array, require, short_repr
from jaxgran.model.state import State

_POINTS_AT_ONCE = 128  # points in one matrix product
_BRANCHES_AT_ONCE = 128  # branches in one matrix product
_dot = partial(jnp.dot, precision=lax.Precision.HIGHEST)


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
    velocity        (points, 2)     σγ̇       V = Σ m v G / ρ; the mean flow γ̇ y x̂ where ρ = 0
    kinetic_stress  (points, 2, 2)  mγ̇²      Σ m (v − V)(v − V) G
    contact_stress  (points, 2, 2)  mγ̇²      Σ σ F ∫G over the contacts; positive for pressure
    heat_flux       (points, 2)     mσγ̇³     J_Q = ½ Σ m |v − V|² (v − V) G + Σ σ F·((v̄_i +
                                             v̄_j)/2 − V) ∫G, with v̄ the
                                             mean of the velocities before and after the collision
    dissipation     (points,)       mγ̇³      ζ: energy lost in contacts, half of each loss at either
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
    def momentum(self) -> Float[Array, "points 2"]:
        """Momentum density ρV, in m γ̇/σ."""
        return self.density[:, None] * self.velocity

    @property
    def stress(self) -> Float[Array, "points 2 2"]:
        """Stress Σ, kinetic and contact, in mγ̇²."""
        return self.kinetic_stress + self.contact_stress

    @property
    def momentum_flux(self) -> Float[Array, "points 2 2"]:
        """ρVV + Σ, in mγ̇²."""
        return self.momentum[:, :, None] * self.velocity[:, None, :] + self.stress

    @property
    def temperature(self) -> Float[Array, " points"]:
        """Granular temperature tr Σ_k / (2 Σ G), in mσ²γ̇², with Σ_k the kinetic stress; zero where
        no grain is near.
        """
        number = jnp.where(self.number_density > 0, self.number_density, 1)
        return jnp.trace(self.kinetic_stress, axis1=1, axis2=2) / (2 * number)

    @property
    def energy(self) -> Float[Array, " points"]:
        """Energy density ρe = Σ ½ m v² G, in mγ̇²."""
        return (
            jnp.sum(self.momentum * self.velocity, axis=1)
            + jnp.trace(self.kinetic_stress, axis1=1, axis2=2)
        ) / 2

    @property
    def energy_flux(self) -> Float[Array, "points 2"]:
        """ρeV + Σ·V + J_Q, in mσγ̇³."""
        work = jnp.sum(self.stress * self.velocity[:, None, :], axis=2)
        return self.energy[:, None] * self.velocity + work + self.heat_flux


class _Branches(NamedTuple):
    """Branches of contacts and the quantities transferred along them.

    ===========  =============  ====================================================================
    middles      (contacts, 2)  middle of the branch, σ
    normals      (contacts, 2)  unit vector along the branch
    lengths      (contacts,)    length of the branch, σ
    transferred  (contacts, 6)  the four components of σ F, and the two of σ (F·c̄); F is the force,
                                c̄ the mean
                                of the velocities of both grains before and after the collision
    loaded       (contacts,)    whether the contact carries an impulse
    ===========  =============  ====================================================================
    """

    middles: Float[Array, "contacts 2"]
    normals: Float[Array, "contacts 2"]
    lengths: Float[Array, " contacts"]
    transferred: Float[Array, "contacts 6"]
    loaded: Bool[Array, " contacts"]


def fields_at(
    snapshot: Snapshot, points: Float[Array, "points 2"], graining: CoarseGraining
) -> Fields:
    """Fields of a snapshot at any points of the plane; supports ``jit``, ``lax.map`` and
    differentiation.

    Args:
      snapshot: one snapshot.
      points: (points, 2) in σ, in the cell or any image of it, for example from ``grid``.
      graining: G. Its width is traced: another width needs no recompilation.

    Returns:
      Fields of the step that begins with the snapshot; ρ, V and Σ_k are those after its collision.

    Raises:
      InputError: the width is not positive, or G reaches beyond half the side minus the largest
        radius, so that two images of a grain would be within reach of a point. The reach of a
        Gaussian is six widths, where it has fallen to e⁻¹⁸ = 1.5e-8 of its peak.
    """
    if not isinstance(snapshot, Snapshot) or jnp.ndim(snapshot.state.positions) != 2:
        raise InputError(
            "snapshot must be a single Snapshot; series[-1] is the last one of a series."
        )
    if not isinstance(graining, CoarseGraining):
        raise InputError(f"graining must come from gaussian or lucy, not {short_repr(graining)}.")
    points, accepted = as_array(points), "an array (points, 2) of finite numbers"
    require(
        "points", points, lambda x: x.ndim == 2 and x.shape[1] == 2 and np.isfinite(x), accepted
    )
    _check(graining, snapshot.state)
    return _fields_at(snapshot, points, graining)


def grid(side: float | Array, count: int) -> Float[Array, "points 2"]:
    """A regular grid of points (count², 2) in the cell, row by row: ``reshape(count, count)`` gives
    axes (y, x).

    The square [0, L)² is one cell of the sheared lattice at any tilt.
    """
    ticks = (jnp.arange(count, dtype=jnp.result_type(side, float)) + 0.5) * (side / count)
    return jnp.stack([jnp.tile(ticks, count), jnp.repeat(ticks, count)], axis=-1)


def _check(graining: CoarseGraining, state: State) -> None:
    limit = np.inf
    if not isinstance(state.side, Tracer) and not isinstance(state.grains.radii, Tracer):
        limit = (
            float(state.side) / 2 - np.max(np.asarray(state.grains.radii))
        ) / graining.kernel.reach
    accepted = f"positive and at most {limit:.4g} in this cell"
    require(
        "the width of the coarse-graining",
        graining.width,
        lambda w: (w > 0) & (w <= limit),
        accepted,
    )


@jax.jit
def _fields_at(snapshot: Snapshot, points: Array, graining: CoarseGraining) -> Fields:
    before, after, contacts = snapshot.state, collided(snapshot), snapshot.contacts
    mean = (before.velocities + after.velocities) / 2
    velocity_i, velocity_j = mean[contacts.i], mean[contacts.j]
    branches = contacts.normals * contacts.distances[:, None]
    forces = contacts.normals * (snapshot.impulses / snapshot.timestep)[:, None]

    power_lost = (
        -jnp.sum(forces * (velocity_i - velocity_j), axis=1)
        - snapshot.shear_rate * forces[:, 0] * branches[:, 1]
    )
    loss = power_lost / 2  # half of the loss goes to each of the two grains
    losses = jnp.zeros_like(before.grains.masses).at[contacts.i].add(loss).at[contacts.j].add(loss)

    stress = branches[:, :, None] * forces[:, None, :]
    work = branches * jnp.sum(forces * (velocity_i + velocity_j) / 2, axis=1)[:, None]
    transferred = jnp.concatenate([stress.reshape(-1, 4), work], axis=1)
    middles = before.positions[contacts.j] + branches / 2
    transfers = _Branches(
        middles, contacts.normals, contacts.distances, transferred, snapshot.impulses > 0
    )
    return _coarse_grained(
        after, losses, _in_blocks(transfers), snapshot.shear_rate, points, graining
    )


def _in_blocks(branches: _Branches) -> _Branches:
    """The branches in blocks (blocks, size), loaded ones first."""
    order = jnp.argsort(~branches.loaded)
    size = min(order.size, _BRANCHES_AT_ONCE)
    order = jnp.pad(order, (0, -order.size % size), constant_values=order.size).reshape(-1, size)
    ordered = jax.tree.map(lambda x: x[jnp.minimum(order, branches.loaded.size - 1)], branches)
    loaded = ordered.loaded & (order < branches.loaded.size)
    return ordered._replace(
        loaded=loaded, transferred=jnp.where(loaded[:, :, None], ordered.transferred, 0)
    )


def _coarse_grained(
    state: State,
    losses: Array,
    blocks: _Branches,
    shear_rate: Array,
    points: Array,
    graining: CoarseGraining,
) -> Fields:
    """The fields, written for one point; ``lax.map`` evaluates batches of points as matrix
    products.

    Sums are taken in the frame of the mean flow at the point, where an image at the separation d
    has the velocity w = c − γ̇ d_y x̂: images need no correction, and no digits cancel far from the
    origin.
    """
    masses, (cx, cy) = state.grains.masses, state.velocities.T
    carried = jnp.stack(
        [masses, masses * cy, masses * cy**2, masses * cy**3, jnp.ones_like(cy), losses], axis=1
    )

    def transferred_at(point: Array) -> Float[Array, "2 6"]:
        def add_block(sums: Array, block: _Branches) -> tuple[Array, None]:
            def added() -> Array:
                d = displacement(point[None], block.middles, state.side, state.tilt)
                g = graining.segment(d, block.normals, block.lengths)
                return sums + _dot(jnp.stack([g, g * d[:, 1]]), block.transferred)

            return lax.cond(jnp.any(block.loaded), added, lambda: sums), None

        zeros = jnp.zeros((2, 6), masses.dtype)
        return lax.scan(add_block, zeros, blocks)[0]

    def fields(point: Array) -> Fields:
        d = displacement(point[None], state.positions, state.side, state.tilt)
        g, wx = graining.value(d), cx - shear_rate * d[:, 1]
        moments = _dot(jnp.stack([g, g * wx, g * wx**2, g * wx**3]), carried)
        (rho, y, yy, yyy, number, loss), (x, xy, xyy, *_), (xx, xxy, *_), (xxx, *_) = moments
        transferred, first_moment = transferred_at(point)  # weighted by G, and by G d_y

        w = jnp.stack([x, y]) / jnp.where(rho > 0, rho, 1)
        kinetic_stress = jnp.stack([xx, xy, xy, yy]).reshape(2, 2) - rho * w[:, None] * w[None, :]
        contact_stress = transferred[:4].reshape(2, 2)
        energy_flux = (
            jnp.stack([xxx + xyy, xxy + yyy]) / 2
            + transferred[4:]
            - shear_rate * first_moment[0:4:2]
        )
        heat_flux = energy_flux - (xx + yy) / 2 * w - _dot(kinetic_stress + contact_stress, w)
        velocity = w + shear_rate * jnp.stack([point[1], jnp.zeros_like(rho)])
        return Fields(rho, number, velocity, kinetic_stress, contact_stress, heat_flux, loss)

    return lax.map(fields, points, batch_size=max(1, min(points.shape[0], _POINTS_AT_ONCE)))
