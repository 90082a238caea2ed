"""Random packings without overlap at a given packing fraction.

The discs are slightly inflated. FIRE (Bitzek et al., Phys. Rev. Lett. 97, 170201, 2006) minimises
their overlap energy ½ Σ (overlap)² from random positions. Below jamming (0.8386 for this size
distribution) the energy falls to zero. When the inflated discs overlap by less than the inflation,
the true discs do not overlap.
"""

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
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
from jaxgran.model.checks import InputError, is_traced, require_key
from jaxgran.model.control_flow import any_replica, where_active
from jaxgran.model.flow import ShearFlow, require_flow
from jaxgran.model.grains import Grains, polydisperse, require_grains
from jaxgran.model.state import State

INFLATION = 5e-4  # of the diameters, relative
_NARROWEST_SKIN = 0.2  # σ; skin of the lists of near pairs
_ATTEMPTS = 10  # random starts
_ITERATIONS = 20_000  # of FIRE, for each start
_FIRST_STEP = 0.1  # time step of FIRE at each start; overlap stiffness and masses are one
_LONGEST_STEP = 0.5  # largest time step of FIRE


class _Fire(NamedTuple):
    """One iterate of FIRE."""

    neighbours: PairLists
    velocities: Array  # (grains, 2)
    step: Array  # time step
    mixing: Array  # fraction of the velocity that is aligned with the forces
    downhill: Array  # iterations since the forces last opposed the velocities
    overlap: Array  # largest overlap of the inflated discs, σ
    iterations: Array  # since the last random start
    attempts: Array  # random starts so far


def pack(
    flow: ShearFlow, key: Array, grains: Grains | None = None
) -> tuple[State, Bool[Array, ""]]:
    """A random packing of discs at rest without overlap, and whether it was found.

    Args:
      flow: number of grains, polydispersity and packing fraction.
      key: JAX random key.
      grains: given discs, in mean diameters, see ``own_grains``; None for those of
        ``polydisperse``.

    Returns:
      The state, with zero velocities and no tilt, and whether one of ten random starts succeeded,
      as is expected up to the largest accepted packing fraction, 0.83.

    Raises:
      InputError: (a ValueError) the number of grains is not that of the flow, their mean diameter
        is not 1, or a grain is too large for the cell.
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
    at_rest = jnp.zeros((flow.grains, 2), side.dtype)

    def start(attempt: Int[Array, ""]) -> _Fire:
        positions = (
            jax.random.uniform(jax.random.fold_in(place_key, attempt), at_rest.shape, side.dtype)
            * side
        )
        neighbours = pair_lists(positions, inflated, side, jnp.zeros_like(side))
        step, mixing = jnp.asarray(_FIRST_STEP, side.dtype), jnp.asarray(0.1, side.dtype)
        overlap = jnp.full_like(side, jnp.inf)
        return _Fire(
            neighbours, at_rest, step, mixing, jnp.int32(0), overlap, jnp.int32(0), attempt + 1
        )

    def unfinished(now: _Fire):
        return ~(now.overlap < allowed) & (now.attempts <= _ATTEMPTS)

    def iterate(now: _Fire) -> _Fire:
        active = unfinished(now)
        stuck = active & (now.iterations >= _ITERATIONS)
        now = lax.cond(
            any_replica(stuck), lambda: where_active(stuck, start(now.attempts), now), lambda: now
        )
        return where_active(active, _fire_step(now, inflated, side, allowed), now)

    # the loop also makes the first start, so the search for pairs, half of this program, is
    # compiled once
    nothing = jax.tree.map(
        lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(start, jnp.int32(0))
    )
    before = nothing._replace(
        overlap=jnp.full_like(side, jnp.inf), iterations=jnp.int32(_ITERATIONS)
    )
    end = lax.while_loop(lambda now: any_replica(unfinished(now)), iterate, before)
    positions, tilt = present(end.neighbours, side)
    packed = end.overlap < allowed
    fit = packed if generated else packed & (widest_skin(grains, side) > 0)
    return State(grains, positions, at_rest, side, tilt), fit


def require_room(flow: ShearFlow, grains: Grains) -> None:
    """Raise an InputError unless the grains suit the flow and none is too large for the lists of
    near pairs.

    Nearest images are unique if the cell is at least two of the largest diameters wide. The search
    of more than 512 grains assumes similar sizes: the largest diameter may be 2.5 times the root
    mean square at ν = 0.83, and more at smaller ν. Traced numbers are not checked here: ``pack``
    then returns that no packing was found.
    """
    require_grains(grains, flow.grains)
    if is_traced(grains.radii, flow.packing_fraction):
        return
    radii = np.asarray(grains.radii, float)
    with jax.ensure_compile_time_eval():  # the grains are known, also inside of ``jax.jit``
        sizes = jnp.asarray(radii, float)
        room = float(widest_skin(Grains(sizes, sizes), cell_side(sizes, flow.packing_fraction)))
    if room < _NARROWEST_SKIN:
        largest, typical = 2 * float(np.max(radii)), 2 * float(np.sqrt(np.mean(radii**2)))
        raise InputError(
            "the largest diameter must be at most "
            f"{(largest + room - _NARROWEST_SKIN) / typical:.3g} times the root "
            f"mean square of all in a flow of {flow.grains} grains at packing fraction "
            f"{float(flow.packing_fraction):g}, not {largest / typical:.3g}."
        )


def _overlap_forces(neighbours: PairLists) -> tuple[Float[Array, "grains 2"], Float[Array, ""]]:
    """Forces of the overlap energy, and the largest overlap in σ, infinite if the list of pairs is
    incomplete.
    """
    pairs = neighbours.near
    separations = separations_now(pairs, neighbours.frame)
    distances = jnp.maximum(jnp.sqrt(jnp.sum(separations**2, axis=-1)), 1e-6)
    overlaps = jnp.maximum(pairs.reach - distances, 0)
    forces = separations * (overlaps / distances)[:, None]
    largest = jnp.where(pairs.overflow, jnp.inf, jnp.max(overlaps))
    return jnp.zeros_like(neighbours.positions).at[pairs.i].add(forces).at[pairs.j].add(
        -forces
    ), largest


def _fire_step(now: _Fire, grains: Grains, side: Array, allowed: Array) -> _Fire:
    """One step of FIRE: the grains follow the forces with inertia, and stop when forces oppose
    velocities.

    If the overlap is already allowed, nothing moves: the returned packing is the one whose overlap
    was computed.
    """
    neighbours = now.neighbours
    used_skin = consumed_skin(neighbours.frame, neighbours.near_frame, 2 * jnp.max(grains.radii))
    stale = ~(used_skin <= neighbours.near.skin)
    neighbours = lax.cond(
        any_replica(stale),
        lambda: refresh(now.neighbours, grains, side, stale),
        lambda: now.neighbours,
    )
    forces, overlap = _overlap_forces(neighbours)
    forward = jnp.sum(forces * now.velocities) > 0
    aligned = jnp.linalg.norm(now.velocities) / jnp.maximum(jnp.linalg.norm(forces), 1e-30) * forces
    mixed = jnp.where(forward, (1 - now.mixing) * now.velocities + now.mixing * aligned, 0)
    downhill = jnp.where(forward, now.downhill + 1, 0)
    accelerate = downhill > 5
    step = jnp.where(
        forward,
        jnp.where(accelerate, jnp.minimum(now.step * 1.1, _LONGEST_STEP), now.step),
        now.step * 0.5,
    )
    step = jnp.maximum(step, 1e-3)
    mixing = jnp.where(forward, jnp.where(accelerate, now.mixing * 0.99, now.mixing), 0.1).astype(
        now.mixing.dtype
    )
    velocities = mixed + step * forces
    stride = jnp.where(overlap < allowed, 0, step)
    moved = Frame(neighbours.frame.displacements + stride * velocities, neighbours.frame.strain)
    return _Fire(
        replace(neighbours, frame=moved),
        velocities,
        step,
        mixing,
        downhill,
        overlap,
        now.iterations + 1,
        now.attempts,
    )
