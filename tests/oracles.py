"""Independent answers: brute force over images and pairs."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxgran.contact.near_pairs import Frame, PairLists, consumed_skin, pair_lists, present, refresh
from jaxgran.model.grains import Grains


def images_of(side: float, tilt: float, rows: int = 2) -> np.ndarray:
    """Lattice vectors of the sheared cell around the origin."""
    a, b = np.meshgrid(np.arange(-rows - 1, rows + 2), np.arange(-rows, rows + 1))
    return np.stack([a.ravel() * side + b.ravel() * tilt * side, b.ravel() * side], axis=-1)


def nearest_image(separations: np.ndarray, side: float, tilt: float) -> np.ndarray:
    """The shortest of all images of every separation; positions must lie in the cell."""
    candidates = separations[..., None, :] + images_of(side, tilt)
    best = np.argmin(np.sum(candidates**2, axis=-1), axis=-1)
    return np.take_along_axis(candidates, best[..., None, None], axis=-2)[..., 0, :]


def gaps_of(positions, radii, side, tilt) -> np.ndarray:
    """Gaps of all pairs (grains, grains); infinite on and below the diagonal."""
    positions, radii = np.asarray(positions), np.asarray(radii)
    separations = nearest_image(positions[:, None] - positions[None, :], float(side), float(tilt))
    gaps = np.linalg.norm(separations, axis=-1) - radii[:, None] - radii[None, :]
    return np.where(np.triu(np.ones(gaps.shape, bool), 1), gaps, np.inf)


def kinetic_energy(masses, velocities) -> float:
    """½ Σ m v²."""
    return float(np.sum(np.asarray(masses)[:, None] * np.asarray(velocities) ** 2) / 2)


# Pair lists that move with a flow

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
    pairs = [
        tuple(sorted(pair))
        for pair in zip(i[reach > 0].tolist(), j[reach > 0].tolist(), strict=True)
    ]
    assert len(pairs) == len(set(pairs))
    assert all(i != j for i, j in pairs)
    return set(pairs)


def pairs_within(gap: float, positions, radii, side, tilt) -> set:
    return set(
        zip(
            *(axis.tolist() for axis in np.nonzero(gaps_of(positions, radii, side, tilt) <= gap)),
            strict=True,
        )
    )
