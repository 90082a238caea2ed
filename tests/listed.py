"""Pair lists that move with a flow, and the pairs that they hold."""

import jax
import jax.numpy as jnp
import numpy as np
from oracles import gaps_of

from jaxgran.contact.near_pairs import Frame, PairLists, consumed_skin, pair_lists, present, refresh
from jaxgran.model.grains import Grains

build = jax.jit(pair_lists)


@jax.jit
def move(hood: PairLists, grains: Grains, side, displacements, strain):
    """The pair_lists after a motion, with new lists where the old ones would no longer be valid."""
    moved = Frame(hood.frame.displacements + displacements, hood.frame.strain + strain)
    valid = consumed_skin(moved, hood.near_frame, 2 * jnp.max(grains.radii)) <= hood.near.skin
    now = PairLists(hood.outer, hood.near, moved, hood.near_frame, hood.positions, hood.tilt)
    now = jax.lax.cond(valid, lambda: now, lambda: refresh(now, grains, side, jnp.asarray(True)))
    return now, ~valid, *present(now, side)


def listed_pairs(listed) -> set:
    """The pairs of a list, each once."""
    i, j, reach = (np.asarray(x) for x in (listed.i, listed.j, listed.reach))
    found = [tuple(sorted(pair)) for pair in zip(i[reach > 0].tolist(), j[reach > 0].tolist(), strict=True)]
    assert len(found) == len(set(found))
    assert all(i != j for i, j in found)
    return set(found)


def pairs_within(gap: float, positions, radii, side, tilt) -> set:
    return set(zip(*(axis.tolist() for axis in np.nonzero(gaps_of(positions, radii, side, tilt) <= gap)), strict=True))
