"""Overlap-free initial configurations at a packing fraction.

Random positions are relaxed by the overlap energy ½ Σ (overlap)² of slightly inflated discs with the FIRE method
(Bitzek et al., Phys. Rev. Lett. 97, 170201, 2006). Below jamming (0.8386 for this size distribution) the energy falls
to zero; as soon as the inflated discs overlap by less than the inflation, the true ones do not overlap at all.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int

from jaxgran.contact.near_pairs import (
    Frame,
    PairLists,
    consumed_skin,
    pair_lists,
    present,
    refresh,
    separations_now,
    widest_skin,
)
from jaxgran.model.cell import cell_side
from jaxgran.model.checks import InputError, require_key
from jaxgran.model.control_flow import any_replica, where_active
from jaxgran.model.flow import ShearFlow, require_flow
from jaxgran.model.grains import Grains, polydisperse, require_grains
from jaxgran.model.state import State

INFLATION = 5e-4
_NARROWEST_SKIN = 0.2  # σ, of the lists of near pairs
_ATTEMPTS = 10
_ITERATIONS = 20_000
_SHORTEST_STEP, _LONGEST_STEP = 0.1, 0.5  # FIRE's time step; overlap stiffness and masses are one


class _Fire(NamedTuple):
    hood: PairLists
    velocities: Array
    step: Array
    mixing: Array
    downhill: Array
    overlap: Array
    iterations: Array
    attempts: Array


def pack(flow: ShearFlow, key: Array, grains: Grains | None = None) -> tuple[State, Bool[Array, ""]]:
    """A random packing of discs at rest without overlap, and whether it was found.

    Args:
      flow: number of grains, polydispersity and packing fraction.
      key: JAX random key.
      grains: discs of one's own, in mean diameters (see ``own_grains``); None for those of ``polydisperse``.

    Returns:
      The state, with zero velocities and no tilt, and False where ten random starts all got stuck, which below
      the largest accepted packing fraction 0.83 is not expected.

    Raises:
      InputError: (a ValueError) the grains are not as many as the flow's, not in mean diameters, or one is too large
        for the cell.
    """
    require_flow(flow)
    require_key(key)
    size_key, place_key = jax.random.split(key)
    generated = grains is None
    if grains is None:
        grains = polydisperse(flow.grains, flow.polydispersity, size_key)
    else:
        require_room(flow, grains)
        grains = Grains(*(jnp.asarray(x, float) for x in (grains.radii, grains.masses)))
    side = cell_side(grains.radii, flow.packing_fraction)
    inflated = Grains(grains.radii * (1 + INFLATION), grains.masses)
    allowed = INFLATION * 2 * jnp.min(grains.radii)
    still = jnp.zeros((flow.grains, 2), side.dtype)

    def start(attempt: Int[Array, ""]) -> _Fire:
        places = jax.random.uniform(jax.random.fold_in(place_key, attempt), still.shape, side.dtype) * side
        hood = pair_lists(places, inflated, side, jnp.zeros_like(side))
        step, mixing = jnp.asarray(_SHORTEST_STEP, side.dtype), jnp.asarray(0.1, side.dtype)
        return _Fire(hood, still, step, mixing, jnp.int32(0), jnp.full_like(side, jnp.inf), jnp.int32(0), attempt + 1)

    def unfinished(now: _Fire):
        return ~(now.overlap < allowed) & (now.attempts <= _ATTEMPTS)

    def iterate(now: _Fire) -> _Fire:
        go = unfinished(now)
        stuck = go & (now.iterations >= _ITERATIONS)
        now = lax.cond(any_replica(stuck), lambda: where_active(stuck, start(now.attempts), now), lambda: now)
        return where_active(go, _fire_step(now, inflated, side, allowed), now)

    end = lax.while_loop(lambda now: any_replica(unfinished(now)), iterate, start(jnp.int32(0)))
    positions, tilt = present(end.hood, side)
    found = end.overlap < allowed
    return State(grains, positions, still, side, tilt), found if generated else found & (widest_skin(grains, side) > 0)


def require_room(flow: ShearFlow, grains: Grains) -> None:
    """Raise an InputError unless these are the grains of the flow, and none is too large for the lists of near pairs.

    Nearest images are unique where the cell is two largest diameters wide; and the search of more than 512 grains is
    made for grains of similar size: the largest diameter may be 2.5 times the root mean square at ν = 0.83, and more in
    looser flows. Traced numbers are not judged here: ``pack`` then says that no packing was found.
    """
    require_grains(grains, flow.grains)
    if any(isinstance(x, Tracer) for x in (grains.radii, flow.packing_fraction)):
        return
    radii = jnp.asarray(grains.radii, float)
    room = float(widest_skin(Grains(radii, radii), cell_side(radii, flow.packing_fraction)))
    if room < _NARROWEST_SKIN:
        largest, typical = 2 * float(jnp.max(radii)), 2 * float(jnp.sqrt(jnp.mean(radii**2)))
        raise InputError(
            f"the largest diameter must be at most {(largest + room - _NARROWEST_SKIN) / typical:.3g} times the root "
            f"mean square of all in a flow of {flow.grains} grains at packing fraction "
            f"{float(flow.packing_fraction):g}, not {largest / typical:.3g}."
        )


def _overlap_forces(hood: PairLists, grains: Grains) -> tuple[Float[Array, "grains 2"], Float[Array, ""]]:
    """Forces of the overlap energy, and the largest overlap (infinite while the list is incomplete)."""
    pairs = hood.near
    separations = separations_now(pairs, hood.frame)
    distances = jnp.maximum(jnp.sqrt(jnp.sum(separations**2, axis=-1)), 1e-6)
    overlaps = jnp.maximum(pairs.reach - distances, 0)
    push = separations * (overlaps / distances)[:, None]
    largest = jnp.where(pairs.overflow, jnp.inf, jnp.max(overlaps))
    return jnp.zeros_like(hood.positions).at[pairs.i].add(push).at[pairs.j].add(-push), largest


def _fire_step(now: _Fire, grains: Grains, side: Array, allowed: Array) -> _Fire:
    """One step of FIRE: follow the forces with inertia, stop dead when they point backwards.

    Where the overlap is allowed already nothing moves, so that the packing returned is the one that was measured.
    """
    frame = now.hood.frame
    stale = ~(consumed_skin(frame, now.hood.near_frame, 2 * jnp.max(grains.radii)) <= now.hood.near.skin)
    hood = lax.cond(any_replica(stale), lambda: refresh(now.hood, grains, side, stale), lambda: now.hood)
    forces, overlap = _overlap_forces(hood, grains)
    forward = jnp.sum(forces * now.velocities) > 0
    aligned = jnp.linalg.norm(now.velocities) / jnp.maximum(jnp.linalg.norm(forces), 1e-30) * forces
    mixed = jnp.where(forward, (1 - now.mixing) * now.velocities + now.mixing * aligned, 0)
    downhill = jnp.where(forward, now.downhill + 1, 0)
    faster = downhill > 5
    step = jnp.where(forward, jnp.where(faster, jnp.minimum(now.step * 1.1, _LONGEST_STEP), now.step), now.step * 0.5)
    step = jnp.maximum(step, 1e-3)
    mixing = jnp.where(forward, jnp.where(faster, now.mixing * 0.99, now.mixing), 0.1).astype(now.mixing.dtype)
    velocities = mixed + step * forces
    stride = jnp.where(overlap < allowed, 0, step)
    moved = Frame(hood.frame.displacements + stride * velocities, hood.frame.strain)
    hood = PairLists(hood.outer, hood.near, moved, hood.near_frame, hood.positions, hood.tilt)
    return _Fire(hood, velocities, step, mixing, downhill, overlap, now.iterations + 1, now.attempts)
