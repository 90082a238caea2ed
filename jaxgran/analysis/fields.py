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

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.scipy.special import erf
from jaxtyping import Array, Float, Int

from jaxgran.dynamics.snapshot import Snapshot, collided
from jaxgran.model.cell import displacement
from jaxgran.model.checks import (
    InputError,
    as_array,
    at_most,
    concrete_or_none,
    require,
    require_number,
    require_whole,
)
from jaxgran.model.state import State
from jaxgran.model.values import Value

_REACH = 6.0  # widths, at which the Gaussian has fallen to e⁻¹⁸ = 1.5e-8 of its peak
_NEGLIGIBLE = 9.0  # widths, at which it is e⁻⁴⁰ = 3e-18 of its peak, below rounding
_MOST_POINTS = 10_000  # along each side of a grid
_BLOCK = 128  # points, grains or contacts


@dataclass(frozen=True, eq=False, repr=False)
class Fields(Value):
    """Coarse-grained fields at points of the plane, in the laboratory frame (mean velocity γ̇ y
    x̂).

    ==============  ==============  =======  =======================================================
    field           shape           unit     meaning
    ==============  ==============  =======  =======================================================
    density         (points,)       m/σ²     ρ = Σ m G
    number_density  (points,)       1/σ²     Σ G
    velocity        (points, 2)     σ/t      V = Σ m v G / ρ; the mean flow γ̇ y x̂ where ρ = 0
    kinetic_stress  (points, 2, 2)  m/t²     Σ m (v − V)(v − V) G; with the mean flow across the
                                             Gaussian, γ̇² w² ρ of xx where many grains are near
    temperature     (points,)       mσ²/t²   T = Σ m |c − C|² G / (2 Σ G), with the peculiar
                                             velocities c and C = Σ m c G / ρ: about the profile
                                             C + γ̇ y x̂, linear around the point; 0 where no grain is
                                             near
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
    temperature: Float[Array, " points"]
    contact_stress: Float[Array, "points 2 2"]
    heat_flux: Float[Array, "points 2"]
    dissipation: Float[Array, " points"]

    @property
    def stress(self) -> Float[Array, "points 2 2"]:
        """Stress Σ, kinetic and contact, in m/t²."""
        return self.kinetic_stress + self.contact_stress


def fields_at(snapshot: Snapshot, points: Float[Array, "points 2"], width: float | Array) -> Fields:
    """Fields of a snapshot at any points of the plane; supports ``jit``, ``lax.map`` and
    differentiation.

    Args:
      snapshot: one snapshot.
      points: (points, 2) in σ, in the cell or any image of it, for example from ``grid``.
      width: standard deviation w of the Gaussian, in σ. Another width needs no recompilation.
        Blocks of grains and contacts whose heights are more than nine widths away, where G is e⁻⁴⁰
        of its peak, are skipped, which changes nothing in double precision.

    Returns:
      Fields of the step that begins with the snapshot; ρ, V and Σ_k are those after its collision.

    Raises:
      InputError: the width is not positive, or six widths are more than half the side minus the
        largest radius, so that two images of a grain would be within reach of a point. Where JAX
        traces the width or the snapshot, all fields are NaN instead.
    """
    if not isinstance(snapshot, Snapshot) or jnp.ndim(snapshot.state.positions) != 2:
        raise InputError(
            "snapshot must be a single Snapshot; series[-1] is the last one of a series."
        )
    points, accepted = as_array(points), "an array (points, 2) of finite numbers"
    require(
        "points", points, lambda x: x.ndim == 2 and x.shape[1] == 2 and np.isfinite(x), accepted
    )
    widest = concrete_or_none(_widest(snapshot.state))
    accepted = "positive" if widest is None else f"positive and at most {widest:g} in this cell"
    limit = np.inf if widest is None else widest
    require_number("width", width, lambda x: (x > 0) & at_most(x, limit), accepted)
    return _fields_at(snapshot, points, width)


def grid(side: float | Array, count: int) -> Float[Array, "points 2"]:
    """A regular grid of points (count², 2) in the cell, row by row: ``reshape(count, count)`` gives
    axes (y, x).

    The square [0, ℓ)² is one cell of the sheared lattice at any tilt.
    """
    require_number("side", side, lambda x: (x > 0) & np.isfinite(x), "a positive number")
    require_whole("count", count, 1, _MOST_POINTS, "as memory is limited")
    ticks = (jnp.arange(count, dtype=jnp.result_type(side, float)) + 0.5) * (side / count)
    return jnp.stack([jnp.tile(ticks, count), jnp.repeat(ticks, count)], axis=-1)


def _widest(state: State) -> Array:
    """The largest width that fits into the cell."""
    return (state.side / 2 - state.grains.radii.max()) / _REACH


@jax.jit
def _fields_at(snapshot: Snapshot, points: Array, width: Array) -> Fields:
    before, after, contacts = snapshot.state, collided(snapshot), snapshot.contacts
    side, tilt, shear_rate = before.side, before.tilt, snapshot.shear_rate
    masses, (cx, cy) = before.grains.masses, after.velocities.T
    loaded = snapshot.impulses > 0
    lengths = jnp.where(loaded, contacts.distances, 1)
    branches = contacts.normals * contacts.distances[:, None]
    middles = before.positions[contacts.j] + branches / 2
    forces = contacts.normals * (snapshot.impulses / snapshot.timestep)[:, None]
    mean = (before.velocities + after.velocities) / 2
    mean_i, mean_j = mean[contacts.i], mean[contacts.j]
    power = jnp.sum(forces * (mean_i - mean_j), axis=1) + shear_rate * forces[:, 0] * branches[:, 1]
    losses = jnp.zeros_like(masses).at[contacts.i].add(-power / 2).at[contacts.j].add(-power / 2)
    carried = [masses, masses * cy, masses * cy**2, masses * cy**3, jnp.ones_like(masses), losses]
    stress = (branches[:, :, None] * forces[:, None]).reshape(-1, 4)
    work = branches * jnp.sum(forces * (mean_i + mean_j), axis=1, keepdims=True) / 2
    transferred = jnp.concatenate([stress, work], axis=1)

    grains = _in_blocks((before.positions, cx), jnp.stack(carried, axis=1), masses > 0, side)
    pairs = _in_blocks((middles, contacts.normals, lengths), transferred, loaded, side)
    reach = _NEGLIGIBLE * width

    def of_grains(points: Array, positions: Array, cx: Array) -> Array:
        d = displacement(points[:, None], positions[None], side, tilt)
        g = jnp.exp(-jnp.sum(d**2, axis=2) / (2 * width**2)) / (2 * jnp.pi * width**2)
        ux = cx[None] - shear_rate * d[..., 1]
        return jnp.stack([g, g * ux, g * ux**2, g * ux**3, g * cx[None], g * cx[None] ** 2])

    def of_branches(points: Array, middles: Array, normals: Array, lengths: Array) -> Array:
        d = displacement(points[:, None], middles[None], side, tilt)
        nx, ny, half = normals[None, :, 0], normals[None, :, 1], lengths[None] / 2
        along, across = nx * d[..., 0] + ny * d[..., 1], nx * d[..., 1] - ny * d[..., 0]
        start, end = ((along + x) / (np.sqrt(2.0).item() * width) for x in (-half, half))
        g = jnp.exp(-((across / width) ** 2) / 2) / (np.sqrt(8 * np.pi).item() * width)
        line = g * (erf(end) - erf(start)) / lengths[None]  # the mean of G over the branch
        return jnp.stack([line, line * d[..., 1]])

    def at(points: Array) -> Fields:
        """By moments of velocities u = c − γ̇ d_y x̂ relative to the mean flow at the point: so
        images at a separation d need no correction, and no digits cancel far from the origin.
        """
        moments = _sums_nearby(of_grains, 6, points, grains, reach, side)
        (rho, y, yy, yyy, number, loss), (x, xy, xyy, *_), (xx, xxy, *_), (xxx, *_) = moments[:4]
        (cx, *_), (cxx, *_) = moments[4:]
        farther = reach + jnp.max(lengths) / 2
        transferred, by_height = _sums_nearby(of_branches, 2, points, pairs, farther, side)
        mass = jnp.where(rho > 0, rho, 1)
        u = jnp.stack([x, y], axis=1) / mass[:, None]
        peculiar = cxx + yy - (cx**2 + y**2) / mass
        second = jnp.stack([xx, xy, xy, yy], axis=1).reshape(-1, 2, 2)
        kinetic_stress = second - rho[:, None, None] * u[:, :, None] * u[:, None]
        contact_stress = transferred[:4].T.reshape(-1, 2, 2)
        carried_energy = jnp.stack([xxx + xyy, xxy + yyy]) / 2
        energy_flux = carried_energy + transferred[4:] - shear_rate * by_height[:4:2]
        worked = jnp.sum((kinetic_stress + contact_stress) * u[:, None], axis=2)
        return Fields(
            density=rho,
            number_density=number,
            velocity=u + jnp.stack([shear_rate * points[:, 1], jnp.zeros_like(rho)], axis=1),
            kinetic_stress=kinetic_stress,
            temperature=peculiar / (2 * jnp.where(number > 0, number, 1)),
            contact_stress=contact_stress,
            heat_flux=energy_flux.T - (xx + yy)[:, None] / 2 * u - worked,
            dissipation=loss,
        )

    blocks = _by_height(points[:, 1] / side % 1)
    place = jnp.argsort(blocks.ravel())[: len(points)]
    fields = lax.map(at, points[blocks])
    known = jnp.where((width > 0) & at_most(width, _widest(before)), 1.0, jnp.nan)
    return jax.tree.map(lambda x: known * x.reshape(-1, *x.shape[2:])[place], fields)


class _Block(NamedTuple):
    """Sources of fields at similar heights; or all of them in such blocks, with a leading axis."""

    low: Array  # heights in units of the side, in [0, 1)
    high: Array
    sources: tuple[Array, ...]
    amounts: Float[Array, "*blocks n amounts"]


def _in_blocks(sources: tuple[Array, ...], amounts: Array, used: Array, side: Array) -> _Block:
    """The sources, of which positions come first, in blocks; those that are not used come last."""
    height = jnp.where(used, sources[0][:, 1] / side % 1, 1)
    index = _by_height(height)
    heights = height.at[index].get(mode="fill", fill_value=1)
    low, high = jnp.min(heights, axis=1), jnp.max(jnp.where(heights < 1, heights, 0), axis=1)
    amounts = amounts.at[index].get(mode="fill", fill_value=0)
    return _Block(low, high, tuple(x[index] for x in sources), amounts)


def _by_height(height: Float[Array, " n"]) -> Int[Array, "blocks size"]:
    """Indices in blocks of increasing height, filled up by the index n, beyond the last."""
    n, size = height.size, max(1, min(height.size, _BLOCK))
    return jnp.pad(jnp.argsort(height), (0, -n % size), constant_values=n).reshape(-1, size)


def _sums_nearby(
    weights: Callable, count: int, points: Array, blocks: _Block, reach: Array, side: Array
) -> Float[Array, "count amounts points"]:
    """Weighted sums of amounts over the blocks whose heights are within reach of some points."""
    height = points[:, 1] / side % 1
    bottom, top = jnp.min(height), jnp.max(height)

    def add(sums: Array, block: _Block) -> tuple[Array, None]:
        def added() -> Array:
            weight = weights(points, *block.sources)
            return sums + jnp.einsum("kpn,na->kap", weight, block.amounts, precision="highest")

        apart = jnp.abs(block.low + block.high - bottom - top) / 2
        extent = reach / side + (block.high - block.low + top - bottom) / 2
        return lax.cond(jnp.minimum(apart, 1 - apart) < extent, added, lambda: sums), None

    zeros = jnp.zeros((count, blocks.amounts.shape[-1], len(points)), height.dtype)
    return lax.scan(add, zeros, blocks)[0]
