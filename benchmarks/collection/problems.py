"""The problems of the collection, made from seeds: networks of ``benchmarks.networks``, larger
ones, and real flows.

Constructed networks are the same on every machine up to the last bits of a square root. Instants of
flows repeat bit for bit on one machine. Another processor may round differently, and a dense flow
then takes another course: the instants differ, the statistics do not.
"""

from collections.abc import Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jaxgran as jg
from benchmarks import networks
from benchmarks.collection.certificates import Problem
from benchmarks.networks import Network
from jaxgran.contact.network import Contacts
from jaxgran.dynamics.snapshots import contacts_now

POINTS = (  # restitution, packing fraction and time step of the flows
    (0.1, 0.60, 1e-3),
    (0.5, 0.60, 1e-3),
    (0.1, 0.70, 1e-4),
    (0.5, 0.70, 1e-3),
    (0.9, 0.70, 1e-3),
    (0.1, 0.80, 1e-5),
    (0.1, 0.80, 1e-4),
    (0.5, 0.80, 1e-4),
    (0.9, 0.80, 1e-3),
    (0.1, 0.82, 1e-5),
    (0.5, 0.82, 1e-4),
    (0.9, 0.82, 1e-3),
)
SIZES = ((64, 4), (256, 4), (1500, 2))  # grains of the flows, and instants of each
_COARSE, _SHEAR, _RELAX, _BETWEEN = 1e-3, 2.0, 0.1, 0.02  # 1/γ̇, and strains
_FEWEST = 2  # contacts of an instant


class Made(NamedTuple):
    """A problem with its family and how it was made."""

    family: str
    origin: str
    problem: Problem


def problems(quick: bool) -> Iterator[Made]:
    """All problems, smallest parts first; the quick collection has few of each kind."""
    yield from constructed(quick)
    yield from met_in_flows(quick)
    yield from instants(POINTS[:2] if quick else POINTS, ((64, 1),) if quick else SIZES)


def constructed(quick: bool) -> Iterator[Made]:
    """Networks that are hard in one respect, and those that have no solution."""
    seeds = range(1 if quick else 4)
    for discs in (2 + 1, 8, 32) if quick else (3, *networks.CHAINS, 1000, 3000):
        yield _made("chain", f"chain of {discs} discs, the first one hit", networks.chain(discs))
    for seed in seeds:
        for big in (1,) if quick else (1, 2, 3):
            yield _made(
                "size ratio 10", f"{big} large discs, seed {seed}", networks.size_ratio(big, seed)
            )
    for seed in seeds:
        for side in (4,) if quick else (4, 8):
            yield _made(
                "mass ratio 10000",
                f"{side} x {side} discs, seed {seed}",
                networks.mass_ratio(side, seed),
            )
    for side in () if quick else (16, 32):
        yield _made(
            "mass ratio 10000", f"{side} x {side} discs, seed 0", networks.mass_ratio(side, 0)
        )
    for rings in (1, 2) if quick else (1, 2, 3, 4, 9, 18):
        for struck in (True, False):
            words = (
                f"hexagon of {rings} rings, "
                f"{'struck at a corner' if struck else 'pressed from all sides'}"
            )
            yield _made("hexagonal cluster", words, networks.hexagonal(rings, struck))
    for grains, number in ((64, 1),) if quick else ((256, 4), (1500, 1)):
        for seed in range(number):
            words = f"{grains} grains at packing fraction 0.83, seed {seed}"
            yield _made("static packing", words, networks.static_packing(grains, seed))
    for discs in (3, 10) if quick else (3, 10, 40, 1000):
        yield _made("jammed row", f"{discs} discs in a closed row", networks.jammed_row(discs))
    for side in (4,) if quick else (4, 8, 30):
        yield _made(
            "jammed lattice", f"{side} x {side} discs in a full cell", networks.jammed_lattice(side)
        )


def met_in_flows(quick: bool) -> Iterator[Made]:
    """The flow networks of ``benchmarks.networks``, one of which is denser than a user may ask
    for.
    """
    grains, count = (64, 1) if quick else (256, 6)
    for nu, alpha in networks.FLOWS[:2] if quick else networks.FLOWS:
        for number, network in enumerate(networks.flow_networks(nu, alpha, grains, count)):
            words = (
                f"N = {grains}, restitution {alpha:g}, packing fraction {nu:g}, dt = 0.001, "
                f"number {number}"
            )
            yield _made("sheared", words, network)


def instants(points: tuple, sizes: tuple) -> Iterator[Made]:
    """Networks of steps that flows of this program solve: sheared at dt = 1e-3, then at the time
    step of the point.
    """
    for restitution, packing_fraction, timestep in points:
        for grains, count in sizes:
            flow = jg.ShearFlow(grains, restitution, packing_fraction, timestep)
            coarse = jg.ShearFlow(grains, restitution, packing_fraction, _COARSE)
            state = networks.moving(_packed(coarse, jax.random.key(grains)), grains)
            state = _advanced(coarse, state, _steps(_SHEAR, _COARSE))
            state = _advanced(flow, state, _steps(_RELAX, timestep))
            for number in range(count):
                state = _advanced(flow, state, _steps(_BETWEEN, timestep))
                while not _is_worth_keeping(contacts := _contacts(flow, state)):
                    state = _advanced(flow, state, jnp.int32(1))
                words = (
                    f"N = {grains}, restitution {restitution:g}, packing fraction "
                    f"{packing_fraction:g}, dt = {timestep:g}, number {number}"
                )
                yield Made("flow", words, compact(contacts, np.asarray(state.grains.masses)))


_packed = jax.jit(lambda flow, key: jg.pack(flow, key)[0])
_advanced = jax.jit(lambda flow, state, steps: jg.advance(flow, state, steps)[0])
_contacts = jax.jit(lambda flow, state: contacts_now(flow, state)[0])


def _steps(strain: float, timestep: float) -> jax.Array:
    return jnp.int32(round(strain / timestep))


def _is_worth_keeping(contacts: Contacts) -> bool:
    used = np.asarray(contacts.used)
    return np.sum(used) >= _FEWEST and bool(np.any(used & (np.asarray(contacts.approach) < 0)))


def _made(family: str, origin: str, network: Network) -> Made:
    return Made(family, origin, compact(network.contacts, network.masses))


def compact(contacts: Contacts, masses: np.ndarray) -> Problem:
    """The problem without unused slots and without grains that have no contact."""
    used = np.asarray(contacts.used)
    ends = np.stack([np.asarray(contacts.i), np.asarray(contacts.j)], axis=1)[used]
    grains, ends = np.unique(ends, return_inverse=True)
    normals, approach = np.asarray(contacts.normals)[used], np.asarray(contacts.approach)[used]
    return Problem(
        ends.reshape(-1, 2).astype(np.int32), normals, np.asarray(masses)[grains], approach
    )
