"""A collection of contact networks made from seeds, on which methods for the contact problem are
compared.

Some networks are met in a shear flow, some are built to be hard in one respect: long chains, size
and mass ratios, more contacts than degrees of freedom, and a jammed set that has no solution. The
same call always gives the same collection. Units as everywhere: lengths in σ, masses in m,
velocities in σγ̇.
"""

from dataclasses import replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jaxgran as jg
from jaxgran.contact.network import Contacts
from jaxgran.dynamics.snapshots import contacts_now

SLOTS, GRAINS = (
    (32, 128, 256, 768, 3072),
    256,
)  # sizes of the buffers of contacts and grains: few shapes to compile
FLOWS = (
    (0.80, 0.0),
    (0.82, 0.0),
    (0.835, 0.0),
    (0.82, 0.9),
    (0.6, 0.5),
)  # packing fraction, restitution
CHAINS = (8, 16, 32, 64, 128, 256)
INFEASIBLE = "jammed, infeasible"
TIMESTEP = 1e-3  # of the flows
_STRAIN_BETWEEN, _FEWEST_APPROACHING = 0.05, 3
_FREE = (1e9, 1e9)  # sides of a cell so large that it is none


class Network(NamedTuple):
    """Contacts of a set of grains.

    ========  =================  ====  ================================================
    field     shape              unit  meaning
    ========  =================  ====  ================================================
    contacts  Contacts           –     padded to one of the sizes ``SLOTS``
    grains    number             –     at least ``GRAINS``: those without a contact do not matter
    masses    (grains,)          m     their masses
    feasible  flag               –     False where no impulses stop all contacts
    ========  =================  ====  ================================================
    """

    contacts: Contacts
    grains: int
    masses: np.ndarray
    feasible: bool = True


def collection(quick: bool) -> dict[str, list[Network]]:
    """All networks by group; the quick collection has fewer of them and smaller flows."""
    grains, count = (64, 2) if quick else (256, 6)
    seeds = range(2 if quick else 4)
    flows = {
        f"flow ν {nu:g}, α {alpha:g}": flow_networks(nu, alpha, grains, count)
        for nu, alpha in FLOWS
    }
    return flows | {
        "static packing ν 0.83": [static_packing(grains, seed) for seed in seeds],
        "chains": [chain(discs) for discs in CHAINS],
        "size ratio 10": [size_ratio(big, seed) for seed in seeds for big in (1, 2, 3)],
        "mass ratio 10⁴": [mass_ratio(side, seed) for seed in seeds for side in (4, 8)],
        "hexagonal cluster": [
            hexagonal(rings, struck) for rings in (1, 2, 3, 4) for struck in (True, False)
        ],
        INFEASIBLE: [jammed_row(discs) for discs in (3, 10, 40)]
        + [jammed_lattice(side) for side in (4, 8)],
    }


def flow_networks(
    packing_fraction: float, restitution: float, grains: int, count: int
) -> list[Network]:
    """Networks that a shear flow meets after a strain of two, each at a step with approaching
    contacts.
    """
    state, networks = sheared(packing_fraction, restitution, grains, 2.0), []
    masses = np.asarray(state.grains.masses)
    while len(networks) < count:
        state = further(packing_fraction, restitution, state, _STRAIN_BETWEEN)
        while (
            np.sum((contacts := _network_now(state)).used & (contacts.approach < 0))
            < _FEWEST_APPROACHING
        ):
            state = further(packing_fraction, restitution, state, TIMESTEP)
        fields = {
            name: np.asarray(values)[np.asarray(contacts.used)]
            for name, values in vars(contacts).items()
        }
        networks.append(_network(masses, **fields))
    return networks


def sheared(
    packing_fraction: float, restitution: float, grains: int, strain: float, seed: int = 0
) -> jg.State:
    """A flow after a strain from a packing with random velocities; it need not be steady."""
    state = moving(_packed(grains, jnp.asarray(packing_fraction), jax.random.key(seed)), seed)
    return further(packing_fraction, restitution, state, strain)


def moving(state: jg.State, seed: int) -> jg.State:
    """The packing with random velocities."""
    return replace(state, velocities=jnp.asarray(_random(seed, len(state.velocities)) / 2))


def further(
    packing_fraction: float, restitution: float, state: jg.State, strain: float
) -> jg.State:
    """The flow after a further strain."""
    steps = jnp.int32(round(strain / TIMESTEP))
    return _advanced(state, jnp.asarray(packing_fraction), jnp.asarray(restitution), steps)


def _flow(grains: int, packing_fraction: jax.Array, restitution: jax.Array) -> jg.ShearFlow:
    """Traced numbers are not judged: one of the flows is denser than a user may ask for."""
    return jg.ShearFlow(grains, restitution, packing_fraction, TIMESTEP)


@partial(jax.jit, static_argnums=0)
def _packed(grains: int, packing_fraction: jax.Array, key: jax.Array) -> jg.State:
    return jg.pack(_flow(grains, packing_fraction, jnp.zeros_like(packing_fraction)), key)[0]


@jax.jit
def _advanced(
    state: jg.State, packing_fraction: jax.Array, restitution: jax.Array, steps: jax.Array
) -> jg.State:
    """The solver is named, so that the networks stay what they are when the default changes."""
    flow = _flow(state.grains.radii.size, packing_fraction, restitution)
    return jg.advance(flow, state, steps, solver=jg.Nesterov())[0]


@jax.jit
def _network_now(state: jg.State) -> Contacts:
    return contacts_now(_flow(state.grains.radii.size, jnp.asarray(0.8), jnp.asarray(0.0)), state)[
        0
    ]


def static_packing(grains: int, seed: int) -> Network:
    """The touching grains of a packing just below jamming, with random velocities."""
    state = _packed(grains, jnp.asarray(0.83), jax.random.key(100 + seed))
    side, radii = float(state.side), np.asarray(state.grains.radii)
    return touching(
        np.asarray(state.positions), radii, _random(seed, grains), gap=5e-3, cell=(side, side)
    )


def chain(discs: int) -> Network:
    """Touching discs in a row, the first of which is hit."""
    positions = np.stack([np.arange(discs, dtype=float), np.zeros(discs)], axis=-1)
    velocities = np.zeros((discs, 2))
    velocities[0, 0] = 1
    return touching(positions, np.full(discs, 0.5), velocities)


def size_ratio(big: int, seed: int) -> Network:
    """Discs of diameter 10 in a row, each with a full ring of 34 discs of diameter 1, which touch
    where rings meet.
    """
    angles = 2 * np.pi * np.arange(34) / 34
    ring = np.concatenate([[[0.0, 0.0]], 5.5 * np.stack([np.cos(angles), np.sin(angles)], axis=-1)])
    positions = np.concatenate([ring + np.array([[12.0 * k, 0]]) for k in range(big)])
    radii = np.tile(np.repeat([5.0, 0.5], [1, 34]), big)
    velocities = _random(seed, len(positions)) - 0.2 * positions
    return touching(positions, radii, velocities, gap=0.02)


def mass_ratio(side: int, seed: int) -> Network:
    """A square of touching discs whose masses are 1 and 10⁴ in turn, as on a chessboard, with
    random velocities.
    """
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(side), np.arange(side)))
    masses = np.where((x + y) % 2, 1e4, 1.0)
    positions = np.stack([x, y], axis=-1).astype(float)
    return touching(positions, np.full(side**2, 0.5), _random(seed, side**2), masses=masses)


def hexagonal(rings: int, struck: bool) -> Network:
    """A hexagonal cluster of touching discs, struck at a corner by one more disc, or pressed
    together from all sides.

    It has more contacts than degrees of freedom: velocities after are unique, impulses are not.
    """
    a, b = (
        axis.ravel()
        for axis in np.meshgrid(np.arange(-rings, rings + 1), np.arange(-rings, rings + 1))
    )
    inside = np.abs(a + b) <= rings
    positions = np.stack([a + b / 2, b * np.sqrt(3) / 2], axis=-1)[inside]
    if struck:
        positions = np.concatenate([positions, [[rings + 1.0, 0.0]]])
    velocities = np.zeros_like(positions)
    velocities[-1, 0] = -1.0 if struck else 0.0
    return touching(
        positions, np.full(len(positions), 0.5), velocities, compression=0.0 if struck else 1.0
    )


def jammed_row(discs: int) -> Network:
    """A row of touching discs closed through the boundary and compressed: no impulses stop it."""
    positions = np.stack([np.arange(discs, dtype=float), np.zeros(discs)], axis=-1)
    row = touching(
        positions,
        np.full(discs, 0.5),
        _random(discs, discs),
        cell=(float(discs), _FREE[1]),
        compression=1.0,
    )
    return row._replace(feasible=False)


def jammed_lattice(side: int) -> Network:
    """A triangular lattice that fills its periodic cell, under compression from all sides."""
    a, b = (axis.ravel() for axis in np.meshgrid(np.arange(side), np.arange(side)))
    height = np.sqrt(3) / 2
    positions = np.stack([(a + b / 2) % side, b * height], axis=-1)
    lattice = touching(
        positions,
        np.full(side**2, 0.5),
        _random(side, side**2),
        cell=(float(side), side * height),
        compression=1.0,
    )
    return lattice._replace(feasible=False)


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
    masses = (2 * radii) ** 2 if masses is None else masses
    return _network(
        masses,
        i=i.astype(np.int32),
        j=j.astype(np.int32),
        normals=normals,
        distances=distances,
        approach=np.sum(normals * (velocities[i] - velocities[j]), axis=1)
        - compression * distances,
        inverse_mass_i=1 / masses[i],
        inverse_mass_j=1 / masses[j],
        used=np.ones(len(i), bool),
    )


def _random(seed: int, grains: int) -> np.ndarray:
    velocities = np.random.default_rng(seed).normal(size=(grains, 2))
    return velocities - velocities.mean(axis=0)


def _network(masses: np.ndarray, **fields: np.ndarray) -> Network:
    """The contacts with these fields in the smallest buffer that holds them."""
    slots = min(slots for slots in SLOTS if slots >= len(fields["used"]))

    def pad(values: np.ndarray) -> jax.Array:
        return jnp.asarray(
            np.pad(values, [(0, slots - len(values))] + [(0, 0)] * (values.ndim - 1))
        )

    masses = np.concatenate([masses, np.ones(max(0, GRAINS - len(masses)))])
    return Network(
        Contacts(**{name: pad(values) for name, values in fields.items()}), len(masses), masses
    )
