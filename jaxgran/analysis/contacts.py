"""Loaded contacts of snapshots, the clusters they form, and the forces between pairs of grains.

A contact is *loaded* if it carries an impulse. A *cluster* is a set of grains connected by loaded
contacts.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxgran.analysis.series import Measured, by_time, ratio, series, with_errors
from jaxgran.contact.clusters import cluster_labels
from jaxgran.dynamics.snapshot import Snapshot
from jaxgran.model.cell import centred


class LoadedContacts(NamedTuple):
    """The loaded contacts of all snapshots, as one list."""

    time: Int[np.ndarray, " loaded"]  # number of the snapshot
    i: Int[np.ndarray, " loaded"]
    j: Int[np.ndarray, " loaded"]
    force: Float[np.ndarray, " loaded"]  # J/dt, in mσ/t²
    normals: Float[np.ndarray, "loaded 2"]  # from grain j to grain i
    distances: Float[np.ndarray, " loaded"]  # of the centres, in σ


class Clusters(NamedTuple):
    """The cluster of each grain at each time."""

    labels: Int[np.ndarray, "times grains"]  # unique over all times
    sizes: Int[np.ndarray, "times grains"]  # 1 without loaded contacts


class PairForces(NamedTuple):
    """Pairs of grains in loaded contact at any time of a series, and their forces."""

    pairs: Int[np.ndarray, "pairs 2"]  # i < j
    force: Float[np.ndarray, " pairs"]  # mean of J/dt over all snapshots, loaded or not, in mσ/t²
    cluster_share: Float[np.ndarray, " pairs"]  # of the force, within clusters of three or more


class ForceNetwork(NamedTuple):
    """The grains of a flow at one time, and the forces between them over one or more snapshots."""

    positions: Float[np.ndarray, "grains 2"]  # in σ, in the sheared cell whose centre is the origin
    radii: Float[np.ndarray, " grains"]
    speed: Float[np.ndarray, " grains"]  # |c|, the peculiar speed, in σγ̇
    pairs: Int[np.ndarray, "pairs 2"]  # i < j
    force: Float[np.ndarray, " pairs"]  # in mσγ̇²
    clustered: Bool[np.ndarray, " pairs"]  # whether most of it acts in clusters of three or more
    side: float
    tilt: float


class ClusterShare(NamedTuple):
    """Shares of loaded contacts, and of their force, pressure and shear stress, in clusters of
    three or more grains.

    Each is a scalar over the whole series. The contact pressure is Σ tr(σF)/2, the contact shear
    stress −Σ σ^x F^y. In a cluster of two, a binary collision, F = F_bc exactly: only larger ones
    raise the force ratio above 1.
    """

    contacts: Measured
    force: Measured
    pressure: Measured
    shear_stress: Measured


def loaded_contacts(snapshots: Snapshot) -> LoadedContacts:
    """The contacts that carry an impulse, of all snapshots."""
    frames = series(snapshots)
    time, slot = np.nonzero(frames.impulses > 0)
    contacts = frames.contacts
    force = frames.impulses[time, slot] / frames.timestep[time]
    i, j, normals, distances = (
        x[time, slot] for x in (contacts.i, contacts.j, contacts.normals, contacts.distances)
    )
    return LoadedContacts(time, i, j, force, normals, distances)


def clusters(snapshots: Snapshot) -> Clusters:
    """Clusters of grains connected by loaded contacts, at each time."""
    times, grains = series(snapshots).state.positions.shape[:2]
    load = loaded_contacts(snapshots)
    first = load.time * grains
    labels, sizes = cluster_labels(first + load.i, first + load.j, times * grains)
    return Clusters(labels.reshape(times, grains), sizes.reshape(times, grains))


def pair_forces(snapshots: Snapshot) -> PairForces:
    """Mean force of each pair over a series; with a snapshot every time step, its impulse over the
    elapsed time.
    """
    load, sizes = loaded_contacts(snapshots), clusters(snapshots).sizes
    ends = np.sort(np.stack([load.i, load.j], axis=-1), axis=-1)
    pairs, pair = np.unique(ends, axis=0, return_inverse=True)
    total, clustered = (
        np.bincount(pair.ravel(), load.force * weight, minlength=len(pairs))
        for weight in (1, sizes[load.time, load.i] > 2)
    )
    return PairForces(pairs, total / len(sizes), ratio(clustered, total))


def force_network(snapshots: Snapshot) -> ForceNetwork:
    """The forces of a snapshot; or those of a series, averaged, with the grains of its middle."""
    frames = series(snapshots)
    middle, forces = frames[len(frames) // 2], pair_forces(frames)
    state, rate = middle.state, middle.shear_rate.item()
    side, tilt = state.side.item(), state.tilt.item()
    return ForceNetwork(
        positions=centred(state.positions, side, tilt),
        radii=state.grains.radii,
        speed=np.hypot(*state.velocities.T) / rate,
        pairs=forces.pairs,
        force=forces.force / rate**2,
        clustered=forces.cluster_share > 0.5,
        side=side,
        tilt=tilt,
    )


def cluster_share(snapshots: Snapshot) -> ClusterShare:
    """Shares of clusters of three or more grains in the contacts, forces and contact stress."""
    load, sizes = loaded_contacts(snapshots), clusters(snapshots).sizes
    pressure = load.force * load.distances / 2  # n is a unit vector
    shear = -load.force * load.distances * load.normals[:, 0] * load.normals[:, 1]
    carried = np.stack([np.ones_like(load.force), load.force, pressure, shear], axis=-1)
    in_cluster = (sizes[load.time, load.i] > 2)[:, None]
    sums = {
        "all": by_time(len(sizes), load.time, carried),
        "many": by_time(len(sizes), load.time, carried * in_cluster),
    }
    share = with_errors(lambda s: {"share": ratio(s["many"], s["all"])}, sums)["share"]
    return ClusterShare(*map(Measured, *share))
