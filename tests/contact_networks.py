"""Contact networks made from seeds: random clusters, and some that are hard in one respect (long
chains, size and mass ratios, more contacts than degrees of freedom, and jammed sets).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jaxgran as jg
from jaxgran.contact.network import Contacts

MAX_DISCS, MAX_CONTACTS = 60, 192  # of random clusters
GRAINS, SLOTS = 256, 256  # of the others
_FREE = (1e9, 1e9)  # sides of a cell so large that it is none


class Network(NamedTuple):
    """Contacts in ``SLOTS`` slots, and the masses of ``GRAINS`` grains."""

    contacts: Contacts
    masses: np.ndarray


def padded_network(i, j, normals, approach, masses, slots: int = MAX_CONTACTS) -> Contacts:
    """A network of the given contacts in a buffer of a fixed size."""
    count = len(i)

    def pad(values, fill=0.0):
        values = np.asarray(values)
        return jnp.asarray(
            np.concatenate(
                [values, np.full((slots - count, *values.shape[1:]), fill, values.dtype)]
            )
        )

    i, j = np.asarray(i, np.int32), np.asarray(j, np.int32)
    masses = np.asarray(masses, float)
    return Contacts(
        i=pad(i),
        j=pad(j),
        normals=pad(np.asarray(normals, float)),
        distances=pad(np.ones(count), 1.0),
        approach=pad(np.asarray(approach, float)),
        inverse_mass_i=pad(1 / masses[i]),
        inverse_mass_j=pad(1 / masses[j]),
        used=pad(np.ones(count, bool), False),
    )


def random_network(
    seed: int, discs: int, heaviest: float = 100.0
) -> tuple[Contacts, np.ndarray, np.ndarray]:
    """Contacts of a cluster of discs with random masses and velocities.

    The discs are the first sites of a triangular lattice around the origin, displaced at random;
    contacts join the neighbours on it, some of them left out. So there are at most 3 contacts per
    disc, as between hard discs.

    Returns:
      The network, the masses (60,) and the velocities (60, 2) that its approach velocities come
      from.
    """
    rng = np.random.default_rng(seed)
    sites = _triangular(np.arange(-6, 7))
    sites = sites[np.argsort(np.sum(sites**2, axis=1), kind="stable")[:MAX_DISCS]]
    i, j = np.nonzero(np.triu(np.linalg.norm(sites[:, None] - sites[None, :], axis=-1) < 1.1, 1))
    keep = (j < discs) & (rng.random(len(i)) < rng.uniform(0.4, 1))
    i, j = i[keep], j[keep]
    sites = sites + rng.uniform(-0.15, 0.15, sites.shape)
    masses = heaviest ** rng.uniform(0, 1, MAX_DISCS)
    # some of them rush together
    velocities = rng.normal(size=(MAX_DISCS, 2)) - rng.uniform(0, 2) * sites
    normals = sites[i] - sites[j]
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    approach = np.sum(normals * (velocities[i] - velocities[j]), axis=1)
    order = rng.permutation(len(i))
    network = padded_network(i[order], j[order], normals[order], approach[order], masses)
    return network, masses, velocities


def chain(discs: int) -> Network:
    """Touching discs in a row, the first of which is hit."""
    velocities = np.zeros((discs, 2))
    velocities[0, 0] = 1
    return touching(_row(discs), np.full(discs, 0.5), velocities)


def size_ratio(big: int, seed: int) -> Network:
    """Discs of diameter 10 in a row, each with a full ring of 34 of diameter 1, which touch."""
    angles = 2 * np.pi * np.arange(34) / 34
    ring = np.concatenate([[[0.0, 0.0]], 5.5 * np.stack([np.cos(angles), np.sin(angles)], axis=-1)])
    positions = np.concatenate([ring + np.array([[12.0 * k, 0]]) for k in range(big)])
    radii = np.tile(np.repeat([5.0, 0.5], [1, 34]), big)
    velocities = _random(seed, len(positions)) - 0.2 * positions
    return touching(positions, radii, velocities, gap=0.02)


def mass_ratio(side: int, seed: int) -> Network:
    """A square of touching discs with masses 1 and 10⁴, as on a chessboard."""
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(side), np.arange(side)))
    masses = np.where((x + y) % 2, 1e4, 1.0)
    positions = np.stack([x, y], axis=-1).astype(float)
    return touching(positions, np.full(side**2, 0.5), _random(seed, side**2), masses=masses)


def hexagon(rings: int) -> np.ndarray:
    """Centres of touching discs in rings around the origin."""
    indices = np.arange(-rings, rings + 1)
    inside = np.abs(indices[:, None] + indices) <= rings
    return _triangular(indices)[inside.ravel()]


def hexagonal(rings: int, struck: bool) -> Network:
    """A hexagonal cluster, struck at a corner by one more disc, or pressed together from all sides.

    It has more contacts than degrees of freedom: velocities after are unique, impulses are not.
    """
    positions = hexagon(rings)
    if struck:
        positions = np.concatenate([positions, [[rings + 1.0, 0.0]]])
    velocities = np.zeros_like(positions)
    velocities[-1, 0] = -1.0 if struck else 0.0
    compression = 0.0 if struck else 1.0
    return touching(positions, np.full(len(positions), 0.5), velocities, compression=compression)


def jammed_row(discs: int) -> Network:
    """A row of touching discs closed through the boundary and compressed: no impulses stop it."""
    cell = (float(discs), _FREE[1])
    velocities = _random(discs, discs)
    return touching(_row(discs), np.full(discs, 0.5), velocities, cell=cell, compression=1.0)


def jammed_lattice(side: int) -> Network:
    """A triangular lattice that fills its periodic cell, under compression from all sides."""
    positions = _triangular(np.arange(side)) % np.array([side, np.inf])
    cell = (float(side), side * np.sqrt(3) / 2)
    velocities = _random(side, side**2)
    return touching(positions, np.full(side**2, 0.5), velocities, cell=cell, compression=1.0)


def static_packing(grains: int, seed: int) -> Network:
    """The touching grains of a packing just below jamming, with random velocities."""
    flow = jg.ShearFlow(grains, restitution=0.0, packing_fraction=0.83, timestep=1e-3)
    state, _ = jax.jit(jg.pack)(flow, jax.random.key(seed))
    cell = (float(state.side), float(state.side))
    positions, radii = np.asarray(state.positions), np.asarray(state.grains.radii)
    return touching(positions, radii, _random(seed, grains), gap=5e-3, cell=cell)


def touching(
    positions: np.ndarray,
    radii: np.ndarray,
    velocities: np.ndarray,
    gap: float = 1e-6,
    cell: tuple[float, float] = _FREE,
    masses: np.ndarray | None = None,
    compression: float = 0.0,
) -> Network:
    """The network of all pairs closer than a gap.

    Args:
      positions: (grains, 2) in σ.
      radii: (grains,) in σ.
      velocities: (grains, 2) in σγ̇.
      gap: largest distance of the surfaces.
      cell: sides of the periodic cell.
      masses: (grains,) in m; (2 radius)² by default.
      compression: rate at which separations shrink, besides the velocities.
    """
    i, j = np.nonzero(np.tri(len(radii), k=-1))
    separations = positions[i] - positions[j]
    separations -= np.asarray(cell) * np.round(separations / np.asarray(cell))
    distances = np.linalg.norm(separations, axis=1)
    near = distances < radii[i] + radii[j] + gap
    i, j, distances = i[near], j[near], distances[near]
    normals = separations[near] / distances[:, None]
    approach = np.sum(normals * (velocities[i] - velocities[j]), axis=1) - compression * distances
    given = (2 * radii) ** 2 if masses is None else masses
    padded_masses = np.concatenate([given, np.ones(GRAINS - len(given))])
    return Network(padded_network(i, j, normals, approach, padded_masses, SLOTS), padded_masses)


def _row(discs: int) -> np.ndarray:
    return np.stack([np.arange(discs, dtype=float), np.zeros(discs)], axis=-1)


def _triangular(indices: np.ndarray) -> np.ndarray:
    """Sites of a triangular lattice, with both indices from these."""
    a, b = (axis.ravel() for axis in np.meshgrid(indices, indices))
    return np.stack([a + b / 2, b * np.sqrt(3) / 2], axis=-1)


def _random(seed: int, grains: int) -> np.ndarray:
    velocities = np.random.default_rng(seed).normal(size=(grains, 2))
    return velocities - velocities.mean(axis=0)
