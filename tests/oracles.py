"""Independent answers: brute force over images and pairs, dense matrices, exact solutions of small
contact problems.
"""

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.exact_contacts import certified_impulses, incidence
from jaxgran.contact.near_pairs import Frame, PairLists, consumed_skin, pair_lists, present, refresh
from jaxgran.contact.network import Contacts
from jaxgran.model.grains import Grains

MAX_DISCS, MAX_CONTACTS = 60, 192


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


def delassus(network: Contacts, masses: np.ndarray) -> np.ndarray:
    """W = H M⁻¹ Hᵀ as a dense matrix."""
    matrix = incidence(network, len(masses))
    return matrix / np.repeat(masses, 2) @ matrix.T


def exact_velocities(network: Contacts, masses: np.ndarray, velocities: np.ndarray) -> np.ndarray:
    """Velocities (grains, 2) after the contact law at restitution zero.

    They are the projection, in the norm of the kinetic energy, of the velocities before on those
    that let no contact
    approach: v + M⁻¹Hᵀp with p = argmin ‖M^½ v + M^-½ Hᵀ p‖ over p ≥ 0, by a method whose answers
      are certified.
    """
    matrix, roots = (
        incidence(network, len(masses))[np.asarray(network.used)],
        np.repeat(np.sqrt(masses), 2),
    )
    impulses = certified_impulses(matrix / roots, matrix @ velocities.ravel())
    assert impulses is not None  # grains at rest satisfy all contacts
    return velocities + (matrix.T @ impulses / roots**2).reshape(-1, 2)


def kinetic_energy(masses, velocities) -> float:
    """½ Σ m v²."""
    return float(np.sum(np.asarray(masses)[:, None] * np.asarray(velocities) ** 2) / 2)


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
    a, b = (axis.ravel() for axis in np.meshgrid(np.arange(-6, 7), np.arange(-6, 7)))
    sites = np.stack([a + b / 2, b * np.sqrt(3) / 2], axis=-1)
    sites = sites[np.argsort(np.sum(sites**2, axis=1), kind="stable")[:MAX_DISCS]]
    i, j = np.nonzero(np.triu(np.linalg.norm(sites[:, None] - sites[None, :], axis=-1) < 1.1, 1))
    keep = (j < discs) & (rng.random(len(i)) < rng.uniform(0.4, 1))
    i, j = i[keep], j[keep]
    sites = sites + rng.uniform(-0.15, 0.15, sites.shape)
    masses = heaviest ** rng.uniform(0, 1, MAX_DISCS)
    velocities = (
        rng.normal(size=(MAX_DISCS, 2)) - rng.uniform(0, 2) * sites
    )  # some of them rush together
    normals = sites[i] - sites[j]
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    approach = np.sum(normals * (velocities[i] - velocities[j]), axis=1)
    order = rng.permutation(len(i))
    network = padded_network(i[order], j[order], normals[order], approach[order], masses)
    return network, masses, velocities


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
